"""A demonstration as the topics `pose` and `action` carry it."""

from __future__ import annotations

from bnirl_ros.demonstrations.motion import Visit
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.views.messages import Message, PoseStamped, Vector3, Vector3Stamped
from bnirl_ros.views.stamped import header_of, pose_of


def pose_message(grid_map: GridMap, cell: tuple[int, int], stamp_ns: int) -> PoseStamped:
    """The discretised pose: the centre of the cell (x, y) in the map frame, without rotation."""
    x, y = grid_map.centres_of([cell])[0]
    return PoseStamped(header=header_of(grid_map.frame_id, stamp_ns), pose=pose_of((x, y)))


def visit_messages(visit: Visit, frame_id: str) -> list[Message]:
    """What tells of a visit, in this order: the action that led to it, if any, and its pose."""
    pose = PoseStamped(header=header_of(frame_id, visit.stamp), pose=pose_of(visit.position))
    if visit.led_by is None:
        return [pose]
    stamp, action = visit.led_by
    return [action_message(action, stamp, frame_id), pose]


def action_message(action_index: int, stamp_ns: int, frame_id: str) -> Vector3Stamped:
    """The action's unit step (dx, dy) in map axes, stamped [ns] as the pose it was chosen in."""
    dx, dy = STEPS[action_index]
    return Vector3Stamped(
        header=header_of(frame_id, stamp_ns), vector=Vector3(x=float(dx), y=float(dy))
    )
