"""Quality of service between bags, which have it in rosbag2's words, and rclpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bnirl_ros.bags.qos import LATCHED, RELIABLE, QosProfile


def qos_profile(recorded: QosProfile) -> QoSProfile:
    """rclpy's form of a recorded profile; what it leaves open is as ROS does by default."""
    return QoSProfile(
        depth=recorded.depth or 10,
        history=HistoryPolicy.KEEP_ALL
        if recorded.history == "keep_all"
        else HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.BEST_EFFORT
        if recorded.reliability == "best_effort"
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if recorded.durability == "transient_local"
        else DurabilityPolicy.VOLATILE,
    )


def joint_offer(recorded: Sequence[QosProfile]) -> QosProfile:
    """What one publisher offers in place of several, so that all who heard them hear it."""
    if not recorded:
        return QosProfile()
    first, *others = sorted(recorded, key=lambda each: each.reliability == "best_effort")
    if any(each.durability != LATCHED.durability for each in others):
        return replace(first, durability="volatile")
    return first


def accepting(offered: Sequence[QoSProfile]) -> QoSProfile:
    """The most that all publishers of a topic offer; a subscriber asking for more hears nothing.

    Whoever latches is heard from the beginning only by one who asks for it.
    """
    reliable = all(each.reliability is ReliabilityPolicy.RELIABLE for each in offered)
    latched = all(each.durability is DurabilityPolicy.TRANSIENT_LOCAL for each in offered)
    return QoSProfile(
        depth=RELIABLE.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def recorded_profile(offered: QoSProfile) -> QosProfile:
    """A publisher's QoS in the bag's words. DDS tells neither history nor depth of others."""
    return QosProfile(
        reliability="reliable"
        if offered.reliability is ReliabilityPolicy.RELIABLE
        else "best_effort",
        durability="transient_local"
        if offered.durability is DurabilityPolicy.TRANSIENT_LOCAL
        else "volatile",
        history="unknown"
        if offered.history is HistoryPolicy.UNKNOWN
        else offered.history.name.lower(),
        depth=offered.depth,
    )
