"""Live tf, where ROS brings it: tf2_ros knows the tree of frames, and this asks it."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from rclpy.node import Node
from rclpy.time import Time


def tf_is_installed() -> bool:
    """Whether there is a tf2_ros to ask."""
    return find_spec("tf2_ros") is not None


class LiveTransforms:
    """What tf tells while a node runs."""

    def __init__(self, node: Node) -> None:
        """Hear tf from now on; tf2_ros has to be installed."""
        self._tf = import_module("tf2_ros")
        self._buffer = self._tf.Buffer()
        self._listener = self._tf.TransformListener(self._buffer, node)

    def look_up(self, target: str, source: str, stamp: int | None) -> Any:
        """The geometry_msgs/TransformStamped that takes `source` to `target`.

        Args:
            target, source: frames.
            stamp: when [ns]; None: the latest that is known.

        Returns:
            None while tf does not tell.
        """
        try:
            return self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp or 0))
        except self._tf.TransformException:
            return None

    def clear(self) -> None:
        """Forget all, as time has jumped back."""
        self._buffer.clear()

    def close(self) -> None:
        """Hear no more of it."""
        self._listener.unregister()
