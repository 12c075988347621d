"""How a node runs and ends: with status 0 on SIGINT and SIGTERM, never with a traceback."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from bnirl_ros.errors import InputError
from bnirl_ros.terminal_text import plain


def run(name: str, body: Callable[[], None], arguments: Sequence[str] | None = None) -> int:
    """Call `body` between rclpy's start and its end; returns the exit status.

    SIGINT and SIGTERM both raise KeyboardInterrupt in `body`. rclpy's own handlers would also shut
    its context down, at once and in a thread of their own: whatever `body` asks of rclpy from then
    on, to say what was done and to clean up, would raise an error.

    Args:
        name: for the error's sentence.
        body: makes nodes, lets them work, and destroys them.
        arguments: command line with `--ros-args`; the process's own when None.
    """
    _on_signals(signal.default_int_handler)
    try:
        rclpy.init(
            args=None if arguments is None else [name, *arguments],
            signal_handler_options=SignalHandlerOptions.NO,
        )
        body()
        return 0
    except KeyboardInterrupt:
        return 0
    except InputError as error:
        print(plain(f"{name}: {error}"), file=sys.stderr)
        return 1
    except rclpy_implementation.RCLError as error:
        if os.environ.get("ROS_SECURITY_ENABLE") != "true":
            raise
        reason = " ".join(str(error).split())
        print(
            f"{name}: was not let in by ROS's security ({reason}); check its enclave and its "
            "permissions, as docs/security.md tells",
            file=sys.stderr,
        )
        return 1
    finally:
        _on_signals(signal.SIG_IGN)  # `ros2 launch` and the terminal both send one
        rclpy.try_shutdown()


def separated(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """A command line without ROS's arguments, and these alone, each with its `--ros-args`.

    rclpy's own function also takes away what looks like a remapping anywhere else.
    """
    own: list[str] = []
    of_ros: list[str] = []
    here = own
    for argument in arguments:
        if argument == "--ros-args":
            here = of_ros
        here.append(argument)
        if argument == "--" and here is of_ros:
            here = own
    return own, of_ros


def spin(node: Any) -> None:
    """Serve a node's callbacks, one after the other, until it is told to end.

    The node needs a timer: a signal is noticed when the next callback is due. One thread: several
    take messages at a fraction of its speed (rclpy issue 1452).
    """
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()


def _on_signals(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)
