"""`bnirl replay`: the same as replay_node."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from typing import Any

NAME = "replay"


def add(commands: Any) -> None:
    """The subcommand; its options are replay_node's, which it reads itself."""
    commands.add_parser(NAME, help="play recorded demonstrations onto their topics")


def run(arguments: Sequence[str]) -> int:
    """Play with these arguments; returns the exit status."""
    from bnirl_ros.nodes.start import require_ros

    require_ros()
    from bnirl_ros.nodes.replay_node import main as replay

    gc.enable()  # this may run for long
    return replay(arguments, "bnirl replay")
