"""Subgoals, and what is assigned to them, as RViz and Foxglove draw them.

RViz keys on (ns, id) and keeps what it is not told to delete, so each array starts with a
DELETEALL and then holds the complete set.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.inference.summary import Subgoal, Summary
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.views.colours import INK, Colour, colour_of
from bnirl_ros.views.messages import ColorRGBA, Header, Marker, MarkerArray, Point, Vector3
from bnirl_ros.views.stamped import header_of, pose_of
from bnirl_ros.views.waypoints import headings

SMALLEST = 0.1
"""Markers grow with the cells, but on fine maps stay as visible as with cells of this edge [m]."""

LABEL_ABOVE = 0.2
"""Height of a label above its sphere [m], as Nav2's waypoint markers have it."""

STEP_LENGTH = 0.4
"""Length of an assignment's line, in steps of its action: it ends within its cell."""

STAY_LENGTH = 0.25
"""Reach along x and y of the cross that stands for staying [cells]: out of a subgoal's sphere."""


_CELLS_OPACITY = 0.3  # of the cells of a feature subgoal: what lies on them is to be seen


def subgoal_markers(summary: Summary, grid_map: GridMap, stamp_ns: int) -> MarkerArray:
    """A sphere, a heading and a label for each subgoal, all with the rank as id.

    Namespaces are `subgoal` (SPHERE), `heading` (ARROW, towards the next subgoal visited, see
    `waypoints.headings`) and `label` (TEXT_VIEW_FACING, `wp_<rank> <probability>`). A feature
    subgoal has one more, `cells` (CUBE_LIST, flat and see-through), with all its cells; its sphere
    is in the middle one of them. The first marker is DELETEALL.

    Args:
        summary: the posterior; positions are in the map frame [m].
        grid_map: the map, for its frame and resolution.
        stamp_ns: stamp of every marker [ns].
    """
    header = header_of(grid_map.frame_id, stamp_ns)
    yaw = headings(summary)
    size = max(grid_map.resolution, SMALLEST)
    markers = [delete_all(header)]
    for subgoal in summary.subgoals:
        markers += _markers_of(subgoal, yaw[subgoal.rank], size, header)
        if subgoal.cells:
            markers.append(_cells_of(subgoal, grid_map, header))
    return MarkerArray(markers=markers)


def assignment_markers(summary: Summary, grid_map: GridMap, stamp_ns: int) -> MarkerArray:
    """For each subgoal one LINE_LIST over the distinct (cell, action) pairs assigned to it.

    A move is a line from the centre of its cell along the action, staying a small cross. The
    points are in the map frame, the namespace is `assignment`, the id is the rank, the first
    marker DELETEALL. Where observations are unexplained, one more, grey, has the id 0.

    Args:
        summary: the posterior.
        grid_map: the map on which the observations lie.
        stamp_ns: stamp of every marker [ns].
    """
    header = header_of(grid_map.frame_id, stamp_ns)
    markers = [delete_all(header)]
    unexplained = [0] if (summary.rank_of == 0).any() else []
    height, width = grid_map.free.shape
    shape = (width, height, len(STEPS))
    for rank in unexplained + [subgoal.rank for subgoal in summary.subgoals]:
        own = summary.observations[summary.rank_of == rank, 1:].reshape(-1, 3)
        # As numbers: to compare rows numpy takes long, and holds all other threads up meanwhile.
        numbers = np.unique(np.ravel_multi_index(tuple(own.T), shape))
        pairs = np.column_stack(np.unravel_index(numbers, shape))
        ends = grid_map.centres_of(_lines(pairs).reshape(-1, 2))
        markers.append(
            Marker(
                header=header,
                ns="assignment",
                id=rank,
                type=Marker.LINE_LIST,
                action=Marker.ADD,
                scale=Vector3(x=0.08 * grid_map.resolution),
                color=opaque(colour_of(rank)),
                points=[Point(x=x, y=y) for x, y in ends.tolist()],
            )
        )
    return MarkerArray(markers=markers)


def delete_all(header: Header) -> Marker:
    """The marker with which every array begins."""
    return Marker(header=header, action=Marker.DELETEALL)


def _markers_of(subgoal: Subgoal, yaw: float, size: float, header: Header) -> list[Marker]:
    """The three markers of one subgoal, for cells with an edge of `size` [m]."""
    radius = 0.3 * size
    colour = opaque(colour_of(subgoal.rank))
    return [
        Marker(
            header=header,
            ns="subgoal",
            id=subgoal.rank,
            type=Marker.SPHERE,
            action=Marker.ADD,
            pose=pose_of(subgoal.position),
            scale=Vector3(x=2 * radius, y=2 * radius, z=2 * radius),
            color=colour,
        ),
        Marker(
            header=header,
            ns="heading",
            id=subgoal.rank,
            type=Marker.ARROW,
            action=Marker.ADD,
            pose=pose_of(subgoal.position, yaw),
            scale=Vector3(x=size, y=0.15 * size, z=0.15 * size),
            color=colour,
        ),
        Marker(
            header=header,
            ns="label",
            id=subgoal.rank,
            type=Marker.TEXT_VIEW_FACING,
            action=Marker.ADD,
            pose=pose_of(subgoal.position, z=radius + LABEL_ABOVE),
            scale=Vector3(z=0.4 * size),
            # Seen from above the label lies on its sphere and on free space, which is light.
            color=opaque(INK),
            text=f"wp_{subgoal.rank} {subgoal.probability:.2f}",
        ),
    ]


def _cells_of(subgoal: Subgoal, grid_map: GridMap, header: Header) -> Marker:
    """All cells of a feature subgoal."""
    edge = grid_map.resolution
    red, green, blue = colour_of(subgoal.rank)
    return Marker(
        header=header,
        ns="cells",
        id=subgoal.rank,
        type=Marker.CUBE_LIST,
        action=Marker.ADD,
        pose=pose_of(grid_map.origin[:2], grid_map.origin[2]),
        scale=Vector3(x=edge, y=edge, z=0.02 * edge),
        color=ColorRGBA(r=red, g=green, b=blue, a=_CELLS_OPACITY),
        points=[Point(x=(x + 0.5) * edge, y=(y + 0.5) * edge) for x, y in subgoal.cells],
    )


def _lines(pairs: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Ends (M, 2, 2) [cells] of the lines that show the pairs (N, 3) of x, y and action index."""
    cells = pairs[:, :2].astype(np.float64)
    steps = STEPS[pairs[:, 2]]
    stays = ~steps.any(axis=1)
    moves = np.stack([cells, cells + STEP_LENGTH * steps], axis=1)[~stays]
    arms = STAY_LENGTH * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]])
    crosses = cells[stays][:, np.newaxis, np.newaxis, :] + arms
    return np.concatenate([moves, crosses.reshape(-1, 2, 2)])


def opaque(colour: Colour) -> ColorRGBA:
    """A colour through which nothing is seen."""
    red, green, blue = colour
    return ColorRGBA(r=red, g=green, b=blue, a=1.0)
