"""The executables of `ros2 run`: they end quietly also while what they need is being imported."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from importlib.util import find_spec

from bnirl_ros.errors import InputError


def subgoal_node() -> int:
    """Run the subgoal node; returns the exit status."""
    return _main_of("subgoal_node")


def discretiser_node() -> int:
    """Run the discretiser node; returns the exit status."""
    return _main_of("discretiser_node")


def replay_node() -> int:
    """Run the replay node; returns the exit status."""
    return _main_of("replay_node")


def record_node() -> int:
    """Run the record node; returns the exit status."""
    return _main_of("record_node")


def require_ros() -> None:
    """Say what to do where there is no rclpy.

    Raises:
        InputError: there is none.
    """
    if find_spec("rclpy") is None:
        raise InputError(
            "rclpy is not installed; source a ROS 2 installation, or pip install 'bnirl_ros[ros]'"
        )


def _main_of(module: str) -> int:
    # An exception can get lost in an import; and there is nothing yet to clean up. Each node's
    # main puts its own handlers in place of these.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    try:
        require_ros()
    except InputError as error:
        print(f"{module}: {error}", file=sys.stderr)
        return 1
    return int(import_module(f"bnirl_ros.nodes.{module}").main())
