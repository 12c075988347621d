"""`bnirl demo`: both nodes, a human bag, and what comes of it."""

from __future__ import annotations

import argparse
import gc
from pathlib import Path
from typing import Any


def add(commands: Any) -> None:
    """The subcommand and its options."""
    parser = commands.add_parser("demo", help="watch a human demonstration become subgoals")
    parser.add_argument("--bag", type=Path, help="another bag than the human demonstration")
    parser.add_argument(
        "--out", type=Path, default=Path("bnirl_out"), help="folder for the results (%(default)s)"
    )
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    """`bnirl demo`: both nodes, a human bag, and what comes of it."""
    from bnirl_ros.nodes.start import require_ros

    require_ros()
    from bnirl_ros.nodes.demo import main as demo

    gc.enable()  # this may run for long
    return demo(options.bag, options.out)
