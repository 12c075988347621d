"""The messages of a demonstration, taken in whatever library made them: rclpy's or a bag's."""

from __future__ import annotations

from typing import Any

from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.maps.occupancy import map_from_occupancy, yaw_of

TOPIC_TYPES = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "action": "geometry_msgs/msg/Vector3Stamped",
    "map": "nav_msgs/msg/OccupancyGrid",
}
"""Message type of each topic from which a demonstration is taken."""


def take_pose(recorder: Recorder, message: Any) -> str | None:
    """Hand a geometry_msgs/PoseStamped to a recorder; returns its fault, or None."""
    position = message.pose.position
    return recorder.add_pose(stamp_of(message), message.header.frame_id, position.x, position.y)


def take_action(recorder: Recorder, message: Any) -> str | None:
    """Hand a geometry_msgs/Vector3Stamped to a recorder; returns its fault, or None."""
    return recorder.add_action(stamp_of(message), message.vector.x, message.vector.y)


def map_of(message: Any, source: str) -> GridMap:
    """The map in a nav_msgs/OccupancyGrid.

    Args:
        message: the grid.
        source: the topic or file, for the error's sentence.

    Raises:
        InputError: it is no map that can be used.
    """
    origin = message.info.origin
    turn = origin.orientation
    yaw = yaw_of(turn.x, turn.y, turn.z, turn.w, source)
    return map_from_occupancy(
        message.data,
        width=message.info.width,
        height=message.info.height,
        resolution=message.info.resolution,
        origin=(origin.position.x, origin.position.y, yaw),
        frame_id=message.header.frame_id,
        source=source,
    )


def stamp_of(message: Any) -> int:
    """The header stamp of a message [ns]."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
