"""The planning map of a finer one: larger cells, with what a robot can pass kept free.

A cell of the planning map is free where the robot's centre can be somewhere in it. That alone
would lose the walls: one thinner than a cell has room for the robot on both sides within two cells
next to each other, and a planner would go through. So of the cells along a wall those are closed
without which all passages remain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap

_Cell = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Coarsened:
    """A planning map, and what of the finer one it cannot show.

    Attributes:
        grid_map: the planning map; it has the finer one's frame and, unless the cells of a map
            before it stay, its origin.
        through_walls: pairs of free cells, side by side, that have a wall between them: closing
            either would have closed a passage. A finer resolution has fewer.
    """

    grid_map: GridMap
    through_walls: int


def coarsen(
    grid_map: GridMap, resolution: float, robot_radius: float, before: GridMap | None = None
) -> Coarsened:
    """A map with larger cells on which a robot finds the ways that it has on the finer one.

    What is kept, of a disc of the robot's radius that moves without touching a blocked cell: from
    any free cell that it can be in, it can be driven over free cells alone to any other one that
    it can be driven to at all; and where it is in no free cell, it can go to one next to it. A
    place that it cannot leave for another cell may be closed. A map whose cells are as large
    already, or larger, stays as it is.

    Args:
        grid_map: the finer map; its features are left out.
        resolution: edge of the planning map's cells [m].
        robot_radius: [m].
        before: the planning map so far, if any: its cells stay where they are, if the new map has
            such cells in the same frame, turned as it is. So what was seen in the middle of a cell
            is not seen on an edge when the map has grown.

    Raises:
        InputError: the robot fits nowhere.
    """
    if resolution <= grid_map.resolution * (1.0 + 1e-9):
        return Coarsened(grid_map, 0)
    ratio = resolution / grid_map.resolution
    origin, (right, up) = _lattice(grid_map, float(resolution), before)
    places = _Places.of(_room_for(grid_map, robot_radius), ratio, (right * ratio, up * ratio))
    if not places.cell:
        raise InputError(
            f"the map has no place for a robot with a radius of {robot_radius:g} m; give the "
            "radius that it has"
        )
    places.close_along_walls()
    free = np.zeros(places.shape, dtype=np.bool_)
    x, y = np.array([places.cell[place] for place in places.kept]).T
    free[y, x] = True
    planning = GridMap(free, float(resolution), origin, grid_map.frame_id)
    return Coarsened(planning, sum(1 for _ in places.through_walls()) // 2)


def with_free(grid_map: GridMap, cells: Iterable[_Cell]) -> GridMap:
    """The map with these of its cells free."""
    free = grid_map.free.copy()
    for x, y in cells:
        free[y, x] = True
    return replace(grid_map, free=free)


def _lattice(
    grid_map: GridMap, resolution: float, before: GridMap | None
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """The origin of a planning map, and where on it the finer map's origin is [planning cells]."""
    origin = grid_map.origin
    if before is None or (before.frame_id, before.resolution, before.origin[2]) != (
        grid_map.frame_id,
        resolution,
        origin[2],
    ):
        return origin, (0.0, 0.0)
    (along,) = before.coordinates_of([origin[:2]])
    corner = np.floor(along + 1e-6)  # rounding must not add an empty row
    ((x, y),) = before.centres_of([corner - 0.5]).tolist()
    right, up = (along - corner).tolist()
    return (x, y, origin[2]), (right, up)


def _room_for(grid_map: GridMap, robot_radius: float) -> npt.NDArray[np.bool_]:
    """(height, width) the cells into which the centre of the robot's disc can get anywhere."""
    from scipy.ndimage import distance_transform_edt

    if grid_map.free.all():
        return grid_map.free
    # From a cell's centre to the nearest blocked cell's, which is half an edge more than to that
    # cell at the least; and a position in a cell is half a diagonal off its centre at the most.
    distance = distance_transform_edt(grid_map.free)
    needed = robot_radius / grid_map.resolution + 0.5 - math.sqrt(0.5) - 1e-9
    return grid_map.free & (distance >= needed)


@dataclass(eq=False)
class _Places:
    """Where the robot can be, as a graph: the connected parts of each cell, joined over borders.

    Attributes:
        shape: (height, width) of the planning map.
        cell: of each place.
        size: of each place, in cells of the finer map.
        near: the places to which each is joined, in cells side by side with its own.
        in_cell: the places of each cell that has any.
        kept: those that make their cells free.
    """

    shape: tuple[int, int]
    cell: list[_Cell]
    size: list[int]
    near: list[set[int]]
    in_cell: dict[_Cell, list[int]]
    kept: set[int]

    @classmethod
    def of(cls, room: npt.NDArray[np.bool_], ratio: float, shift: tuple[float, float]) -> _Places:
        """The places in the finer cells with room.

        Args:
            room: (height, width).
            ratio: how many of these cells a planning cell is wide.
            shift: how many of them to the right and up of the planning map's origin they begin.
        """
        from scipy.ndimage import label

        # The planning cell of each row and column is that of its centre.
        rows, columns = (
            np.floor((np.arange(length) + 0.5 + start) / ratio).astype(np.int64)
            for length, start in zip(room.shape, reversed(shift), strict=True)
        )
        # An empty line between planning cells keeps the parts of one from those of the next.
        apart = np.zeros((len(rows) + rows[-1], len(columns) + columns[-1]), dtype=np.bool_)
        lines = np.ix_(np.arange(len(rows)) + rows, np.arange(len(columns)) + columns)
        apart[lines] = room
        place = label(apart)[0][lines].astype(np.int64) - 1

        size = np.bincount(place[room])
        y, x = np.nonzero(room)
        first = np.unique(place[room], return_index=True)[1]
        cell = list(zip(columns[x[first]].tolist(), rows[y[first]].tolist(), strict=True))
        near: list[set[int]] = [set() for _ in cell]
        below, right = np.flatnonzero(np.diff(rows)), np.flatnonzero(np.diff(columns))
        for one, other in (
            (place[below].ravel(), place[below + 1].ravel()),
            (place[:, right].ravel(), place[:, right + 1].ravel()),
        ):
            both = (one >= 0) & (other >= 0)
            for a, b in np.unique(np.column_stack([one, other])[both], axis=0).tolist():
                near[a].add(b)
                near[b].add(a)
        in_cell: dict[_Cell, list[int]] = {}
        for number, where in enumerate(cell):
            in_cell.setdefault(where, []).append(number)
        shape = (int(rows[-1]) + 1, int(columns[-1]) + 1)
        return cls(shape, cell, size.tolist(), near, in_cell, set(range(len(cell))))

    def close_along_walls(self) -> None:
        """Keep no more places than needed of those with a wall between, the largest first."""
        for place in sorted(
            {place for pair in self.through_walls() for place in pair}, key=self._rank
        ):
            if any(True for _ in self._behind_walls(place)) and self._is_spare(place):
                self.kept.remove(place)

    def through_walls(self) -> Iterable[tuple[int, int]]:
        """Pairs of kept places, each in either order, between which a planner sees no wall."""
        for place in sorted(self.kept):
            for other in self._behind_walls(place):
                yield place, other

    def _rank(self, place: int) -> tuple[int, _Cell, int]:
        return self.size[place], self.cell[place], place

    def _behind_walls(self, place: int) -> Iterable[int]:
        """Kept places in the same cell or side by side, but not even round a corner from it."""
        x, y = self.cell[place]
        for where in ((x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)):
            for other in self.in_cell.get(where, ()):
                if other != place and other in self.kept and not self._is_close(place, other):
                    yield other

    def _is_close(self, place: int, other: int) -> bool:
        """Whether three steps lead from one to the other: round the end of a wall, no farther."""
        near = self.near[place] & self.kept
        if other in near or near & self.near[other]:
            return True
        return any(self.near[step] & self.kept & self.near[other] for step in near)

    def _is_spare(self, place: int) -> bool:
        """Whether all that is joined over a place would be so, and be next to a kept one, too."""
        near = self.near[place] & self.kept
        for closed in self.near[place] - self.kept:
            if not (self.near[closed] & self.kept) - {place}:
                return False
        if not near:
            return not self.near[place]
        x, y = self.cell[place]
        around = {
            other
            for dx in (-1, 0, 1)
            for dy in (-1, 0, 1)
            for other in self.in_cell.get((x + dx, y + dy), ())
            if other in self.kept and other != place
        }
        start = next(iter(near))
        reached, waiting = {start}, [start]
        while waiting:
            new = (self.near[waiting.pop()] & around) - reached
            reached |= new
            waiting.extend(new)
        return near <= reached
