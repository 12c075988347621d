"""The subgoals as a route: in the order visited, each heading for the next."""

from __future__ import annotations

import math
from itertools import pairwise

from bnirl_ros.inference.summary import Subgoal, Summary
from bnirl_ros.maps import GridMap
from bnirl_ros.views.messages import Path, PoseStamped
from bnirl_ros.views.stamped import header_of, pose_of


def subgoals_in_order(summary: Summary) -> tuple[Subgoal, ...]:
    """The subgoals in the order in which the demonstrator first visited them."""
    of_rank = {subgoal.rank: subgoal for subgoal in summary.subgoals}
    return tuple(of_rank[rank] for rank in summary.visit_sequence)


def headings(summary: Summary) -> dict[int, float]:
    """Yaw [rad] in the map frame with which each rank is left for the next one visited.

    The last one keeps the direction in which it was reached, or heads for the first where the
    visits go round; a subgoal alone, or one that is not in the visit sequence, heads along the x
    axis of the frame.
    """
    order = subgoals_in_order(summary)
    yaw = dict.fromkeys((subgoal.rank for subgoal in summary.subgoals), 0.0)
    for here, there in pairwise(order):
        yaw[here.rank] = yaw[there.rank] = _direction(here, there)
    if summary.repetitions > 1:
        yaw[order[-1].rank] = _direction(order[-1], order[0])
    return yaw


def _direction(here: Subgoal, there: Subgoal) -> float:
    (x, y), (next_x, next_y) = here.position, there.position
    return math.atan2(next_y - y, next_x - x)


def waypoint_path(summary: Summary, grid_map: GridMap, stamp_ns: int) -> Path:
    """The subgoals in the order visited, each pose heading for the next, as Nav2 takes them.

    Args:
        summary: the posterior; positions are in the map frame [m].
        grid_map: the map, for its frame.
        stamp_ns: stamp of the message and of each pose [ns].
    """
    yaw = headings(summary)
    return Path(
        header=header_of(grid_map.frame_id, stamp_ns),
        poses=[
            PoseStamped(
                header=header_of(grid_map.frame_id, stamp_ns),
                pose=pose_of(subgoal.position, yaw[subgoal.rank]),
            )
            for subgoal in subgoals_in_order(summary)
        ],
    )
