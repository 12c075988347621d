"""The subgoals as a route: in the order visited, each heading for the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from bnirl_ros.inference.summary import Subgoal, Summary
from bnirl_ros.maps import GridMap
from bnirl_ros.views.messages import Path, Pose, PoseStamped
from bnirl_ros.views.stamped import header_of, pose_of


@dataclass(frozen=True)
class Visits:
    """The subgoals in the order in which the demonstrator first visited them.

    Attributes:
        frame_id: the map frame, in which their positions are [m].
        subgoals: those that were visited, in order.
        go_round: whether the first one is visited again after the last.
    """

    frame_id: str
    subgoals: tuple[Subgoal, ...]
    go_round: bool = False

    @property
    def headings(self) -> tuple[float, ...]:
        """Yaw [rad] in the map frame with which each is left for the next.

        The last one keeps the direction in which it was reached, or heads for the first where the
        visits go round; a subgoal alone heads along the x axis of the frame.
        """
        if len(self.subgoals) < 2:
            return (0.0,) * len(self.subgoals)
        left = [_direction(here, there) for here, there in pairwise(self.subgoals)]
        last = _direction(self.subgoals[-1], self.subgoals[0]) if self.go_round else left[-1]
        return (*left, last)


@dataclass(frozen=True)
class Waypoints:
    """Poses to be visited one after the other.

    Attributes:
        frame_id: the frame in which they are.
        poses: in order.
    """

    frame_id: str
    poses: tuple[Pose, ...]


def visits_of(summary: Summary, frame_id: str) -> Visits:
    """The visits that a summary tells, in the map frame."""
    return visits_in_order(summary.subgoals, summary.visit_sequence, summary.repetitions, frame_id)


def visits_in_order(
    subgoals: Sequence[Subgoal], visit_sequence: Sequence[int], repetitions: int, frame_id: str
) -> Visits:
    """The visits by the fields of a `Summary` that tell them.

    Raises:
        KeyError: the sequence has a rank that no subgoal has.
    """
    of_rank = {subgoal.rank: subgoal for subgoal in subgoals}
    return Visits(frame_id, tuple(of_rank[rank] for rank in visit_sequence), repetitions > 1)


def headings(summary: Summary) -> dict[int, float]:
    """Yaw [rad] in the map frame of each rank: that of its visit; 0 for one never visited."""
    visits = visits_of(summary, "")
    yaw = dict.fromkeys((subgoal.rank for subgoal in summary.subgoals), 0.0)
    for subgoal, heading in zip(visits.subgoals, visits.headings, strict=True):
        yaw[subgoal.rank] = heading
    return yaw


def _direction(here: Subgoal, there: Subgoal) -> float:
    (x, y), (next_x, next_y) = here.position, there.position
    return math.atan2(next_y - y, next_x - x)


def waypoints_of(visits: Visits) -> Waypoints:
    """A pose at each subgoal visited, heading for the next one."""
    return Waypoints(
        visits.frame_id,
        tuple(
            pose_of(subgoal.position, heading)
            for subgoal, heading in zip(visits.subgoals, visits.headings, strict=True)
        ),
    )


def path_of(waypoints: Waypoints, stamp_ns: int) -> Path:
    """Waypoints as Nav2 takes them; the message and each of its poses has the stamp [ns]."""
    header = header_of(waypoints.frame_id, stamp_ns)
    return Path(header, [PoseStamped(header, pose) for pose in waypoints.poses])


def waypoint_path(summary: Summary, grid_map: GridMap, stamp_ns: int) -> Path:
    """The subgoals in the order visited, each pose heading for the next, as Nav2 takes them.

    Args:
        summary: the posterior; positions are in the map frame [m].
        grid_map: the map, for its frame.
        stamp_ns: stamp of the message and of each pose [ns].
    """
    return path_of(waypoints_of(visits_of(summary, grid_map.frame_id)), stamp_ns)
