"""The subgoal that is pursued now, as a pose, and how probable each is, as RViz draws it."""

from __future__ import annotations

from bnirl_ros.inference.intent import Intent
from bnirl_ros.inference.summary import Subgoal
from bnirl_ros.maps import GridMap
from bnirl_ros.views.colours import INK, colour_of
from bnirl_ros.views.markers import LABEL_ABOVE, SMALLEST, delete_all, opaque
from bnirl_ros.views.messages import (
    ColorRGBA,
    Header,
    Marker,
    MarkerArray,
    Point,
    PoseStamped,
    Vector3,
)
from bnirl_ros.views.stamped import header_of, pose_of
from bnirl_ros.views.waypoints import headings

LEAST_SHOWN = 0.01
"""Subgoals less probable than this have no markers."""


def current_subgoal(intent: Intent, stamp_ns: int) -> PoseStamped | None:
    """The most probable subgoal, heading as its waypoint does; None where there is no subgoal.

    Args:
        intent: positions are in the map frame [m].
        stamp_ns: of the demonstrator's latest pose [ns].
    """
    subgoal = intent.current
    if subgoal is None:
        return None
    return PoseStamped(
        header=header_of(intent.grid_map.frame_id, stamp_ns),
        pose=pose_of(subgoal.position, headings(intent.summary)[subgoal.rank]),
    )


def intent_markers(intent: Intent, stamp_ns: int) -> MarkerArray:
    """From the demonstrator to each subgoal an arrow, and a label half-way; the rank is the id.

    Namespaces are `intent` (ARROW, as wide and as opaque as the subgoal is probable: its `color.a`
    is the probability) and `intent_label` (TEXT_VIEW_FACING, `<rank> <probability>`). A subgoal in
    whose cell the demonstrator is has no arrow, and its label above itself. The label with the id
    0, above the demonstrator, is `another <probability>`: that it is none of the subgoals. The
    first marker is DELETEALL.

    Args:
        intent, stamp_ns: as in `current_subgoal`.
    """
    grid_map = intent.grid_map
    header = header_of(grid_map.frame_id, stamp_ns)
    size = max(grid_map.resolution, SMALLEST)
    x, y = grid_map.centres_of([intent.cell])[0].tolist()
    markers = [delete_all(header)]
    if intent.another >= LEAST_SHOWN:
        markers.append(_label(0, f"another {intent.another:.2f}", (x, y), size, header))
    for subgoal, probability in zip(
        intent.summary.subgoals, intent.probability.tolist(), strict=True
    ):
        if probability < LEAST_SHOWN:
            continue
        if subgoal.cell != intent.cell:  # an arrow without a length has no direction
            markers.append(_arrow((x, y), subgoal, min(1.0, probability), size, header))
        middle = ((x + subgoal.position[0]) / 2, (y + subgoal.position[1]) / 2)
        text = f"{subgoal.rank} {probability:.2f}"
        markers.append(_label(subgoal.rank, text, middle, size, header))
    return MarkerArray(markers=markers)


def no_intent(grid_map: GridMap, stamp_ns: int) -> MarkerArray:
    """The markers while nothing is known of the intent: DELETEALL alone."""
    return MarkerArray(markers=[delete_all(header_of(grid_map.frame_id, stamp_ns))])


def _arrow(
    start: tuple[float, float], subgoal: Subgoal, probability: float, size: float, header: Header
) -> Marker:
    red, green, blue = colour_of(subgoal.rank)
    width = (0.05 + 0.15 * probability) * size
    return Marker(
        header=header,
        ns="intent",
        id=subgoal.rank,
        type=Marker.ARROW,
        action=Marker.ADD,
        pose=pose_of((0.0, 0.0)),
        # Of an arrow between two points: diameter of shaft and head, length of the head.
        scale=Vector3(x=width, y=2 * width, z=0.3 * size),
        color=ColorRGBA(r=red, g=green, b=blue, a=probability),
        points=[Point(*start), Point(*subgoal.position)],
    )


def _label(
    number: int, text: str, position: tuple[float, float], size: float, header: Header
) -> Marker:
    return Marker(
        header=header,
        ns="intent_label",
        id=number,
        type=Marker.TEXT_VIEW_FACING,
        action=Marker.ADD,
        # Higher than the subgoals' own labels, which it may lie upon.
        pose=pose_of(position, z=2 * LABEL_ABOVE + 0.3 * size),
        scale=Vector3(z=0.4 * size),
        color=opaque(INK),
        text=text,
    )
