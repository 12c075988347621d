"""The messages in which robots tell where they are and where they are told to go.

Taken in whatever library made them: rclpy's, or a bag's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from bnirl_ros.demonstrations.frames import frame_name, matrix_of, moved
from bnirl_ros.demonstrations.messages import stamp_of
from bnirl_ros.errors import InputError
from bnirl_ros.maps.occupancy import yaw_of

TF = "tf2_msgs/msg/TFMessage"

POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)
"""Message types that tell a pose, the preferred ones first: odometry is smooth and comes often."""

COMMAND_TYPES = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")
"""Message types that tell a velocity command."""

NO_MOTION = ("goal_pose", "initialpose", "clicked_point", "move_base_simple/goal")
"""Topics, by the end of their names, whose poses are not where a robot was: RViz's and Nav2's."""


class RawPose(NamedTuple):
    """A pose as it was told: stamp [ns], frame, position (x, y, z) [m] and heading [rad]."""

    stamp: int
    frame_id: str
    position: tuple[float, float, float]
    heading: float


class Command(NamedTuple):
    """A velocity command in the robot's axes, REP-103: forwards, left [m/s], rate [rad/s]."""

    forwards: float
    left: float
    rate: float


def pose_of(message: Any) -> RawPose:
    """The pose in a message of `POSE_TYPES`; its heading is NaN where the message has none."""
    pose = message.pose
    pose = getattr(pose, "pose", pose)  # with covariance it lies one deeper
    turn = pose.orientation
    try:
        heading = yaw_of(turn.x, turn.y, turn.z, turn.w, "pose")
    except InputError:
        heading = math.nan
    at = pose.position
    return RawPose(
        stamp_of(message), frame_name(message.header.frame_id), (at.x, at.y, at.z), heading
    )


def brought(pose: RawPose, transform: Any) -> RawPose:
    """A pose after a geometry_msgs/TransformStamped, in the frame of its header.

    Its position and heading are NaN where the transform is none.
    """
    ((x, y, heading),) = moved(
        matrix_of(transform.transform)[np.newaxis],
        np.array([[*pose.position, 1.0]]),
        np.array([pose.heading]),
    ).tolist()
    frame_id = frame_name(transform.header.frame_id)
    return RawPose(pose.stamp, frame_id, (x, y, 0.0), heading)


def command_of(message: Any) -> Command:
    """The command in a message of `COMMAND_TYPES`."""
    twist = getattr(message, "twist", message)
    return Command(twist.linear.x, twist.linear.y, twist.angular.z)
