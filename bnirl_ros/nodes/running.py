"""How a node runs and ends: with status 0 on SIGINT and SIGTERM, never with a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.exceptions import ROSInterruptException
from rclpy.executors import ExternalShutdownException

from bnirl_ros.errors import InputError


def run(name: str, body: Callable[[], None], arguments: Sequence[str] | None = None) -> int:
    """Call `body` between rclpy's start and its end; returns the exit status.

    Args:
        name: for the error's sentence.
        body: makes nodes, lets them work, and destroys them.
        arguments: command line with `--ros-args`; the process's own when None.
    """
    try:
        rclpy.init(args=None if arguments is None else [name, *arguments])
        body()
        return 0
    except (KeyboardInterrupt, ExternalShutdownException, ROSInterruptException):
        return 0
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()


def spin(node: Any) -> None:
    """Serve a node's callbacks, one after the other, until it is told to end.

    One thread: several take messages at a fraction of its speed (rclpy issue 1452).
    """
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()
