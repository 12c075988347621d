"""`bnirl record`: the same as record_node."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from typing import Any

NAME = "record"


def add(commands: Any) -> None:
    """The subcommand; its options are record_node's, which it reads itself."""
    commands.add_parser(NAME, help="record a demonstration, and what is inferred from it")


def run(arguments: Sequence[str]) -> int:
    """Record with these arguments; returns the exit status."""
    from bnirl_ros.nodes.start import require_ros

    require_ros()
    from bnirl_ros.nodes.record_node import main as record

    gc.enable()  # this may run for long
    return record(arguments, "bnirl record")
