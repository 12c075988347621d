"""The parts that messages of every view share: stamped headers and poses in the plane."""

from __future__ import annotations

import math

from bnirl_ros.views.messages import Header, Point, Pose, Quaternion, Time

NANOSECONDS = 1_000_000_000


def header_of(frame_id: str, stamp_ns: int) -> Header:
    """Header for a frame and a time [ns]."""
    return Header(stamp=time_of(stamp_ns), frame_id=frame_id)


def time_of(stamp_ns: int) -> Time:
    """Time [ns] as seconds and nanoseconds."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanoseconds)


def pose_of(position: tuple[float, float], yaw: float = 0.0, z: float = 0.0) -> Pose:
    """Pose at (x, y) [m] and z [m], turned by yaw [rad] about z."""
    x, y = position
    return Pose(
        position=Point(x=float(x), y=float(y), z=float(z)),
        orientation=Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2)),
    )
