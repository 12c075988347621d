"""The planning map of a robot's own map, or of none, and what is to be said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.maps.coarsening import coarsen
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.maps.occupancy import check_geometry


def planning_map(
    grid_map: GridMap, settings: Discretising, before: GridMap | None = None
) -> tuple[GridMap, str]:
    """The planning map of a robot's map, and a warning where it hides walls, or no words.

    Args:
        grid_map: the robot's map.
        settings: tell the frame, the resolution, and the robot's radius.
        before: the planning map so far, whose cells stay where they are if that can be.

    Raises:
        InputError: the robot fits nowhere.
    """
    if settings.map_frame:
        grid_map = replace(grid_map, frame_id=settings.map_frame)
    coarsened = coarsen(grid_map, settings.planning_resolution, settings.robot_radius, before)
    if not coarsened.through_walls:
        return coarsened.grid_map, ""
    return coarsened.grid_map, (
        "planning map: pairs of free cells with a wall between them that cells of "
        f"{coarsened.grid_map.resolution:g} m cannot show: {coarsened.through_walls}; take "
        "smaller cells (planning_resolution)"
    )


def open_space_round(
    positions: npt.NDArray[np.float64], resolution: float, frame_id: str, source: str
) -> GridMap:
    """A map without obstacles round positions (P, 2) [m], with a margin of a cell.

    Raises:
        InputError: it would be too large; the sentence begins with `source`.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # it is refused then
        low = np.floor(positions.min(axis=0) / resolution) - 1
        high = np.floor(positions.max(axis=0) / resolution) + 2
        width, height = (int(size) for size in np.nan_to_num(high - low))
        x, y = (low * resolution).tolist()
    check_geometry(width, height, resolution, (x, y, 0.0), source)
    return GridMap(np.ones((height, width), dtype=np.bool_), resolution, (x, y, 0.0), frame_id)


def on_opened(
    opened: Sequence[tuple[int, int]],
    planning: GridMap,
    positions: npt.NDArray[np.float64],
    grid_map: GridMap,
) -> str:
    """The sentence on cells that were opened since the robot was in them.

    Args:
        opened: the cells.
        planning: their map.
        positions: (P, 2) where the robot was [m].
        grid_map: the robot's map.
    """
    named = ", ".join(f"({x}, {y})" for x, y in opened[:5]) + (", ..." if len(opened) > 5 else "")
    sentence = (
        f"planning map: the robot was in {len(opened)} blocked cells of {planning.resolution:g} m,"
        f" which are open now: {named}"
    )
    where_free = positions[grid_map.is_free(grid_map.cells_of(positions))]
    closed = {(x, y) for x, y in planning.cells_of(where_free).tolist()} & set(opened)
    if closed:
        sentence += (
            f"; {len(closed)} of them only the coarsening had closed, for which robot_radius or "
            "planning_resolution is too large"
        )
    return sentence
