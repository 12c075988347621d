"""A planning map: free cells, and where they lie in the map frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """A discrete feature vector Phi of each cell of a map (section 3.5).

    Attributes:
        coordinates: (height, width, k) int64 feature coordinates, indexed [y, x].
        known: (height, width) bool which cells have any; the others belong to no feature subgoal.
        names: of some coordinates.
    """

    coordinates: npt.NDArray[np.int64]
    known: npt.NDArray[np.bool_]
    names: Mapping[tuple[int, ...], str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class GridMap:
    """Free space on a grid, as nav_msgs/OccupancyGrid places it, and what is known of its cells.

    Attributes:
        free: (height, width) bool, indexed [y, x]; (0, 0) is the lower left cell.
        resolution: edge of a cell [m].
        origin: (x, y, yaw) of the lower left corner of cell (0, 0) in the frame [m, m, rad].
        frame_id: the frame in which positions are given.
        features: of its cells, where subgoals are to be told by features; else None.
    """

    free: npt.NDArray[np.bool_]
    resolution: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame_id: str = "map"
    features: FeatureMap | None = None

    def is_same_as(self, other: GridMap) -> bool:
        """Whether another map has the same free space in the same place; features don't count."""
        return (
            (self.resolution, self.origin, self.frame_id)
            == (other.resolution, other.origin, other.frame_id)
        ) and np.array_equal(self.free, other.free)

    def cells_of(self, positions: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Cells (N, 2) in which the positions (N, 2) [m] lie; they may lie outside the map."""
        # Far positions would overflow int64 (undefined in C); a cell this far is outside any map.
        cells = np.nan_to_num(np.floor(self.coordinates_of(positions)), nan=np.inf)
        return np.asarray(np.clip(cells, -(2**62), 2**62), dtype=np.int64)

    def coordinates_of(self, positions: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """The positions (N, 2) [m] along the map's axes, in cells from its lower left corner."""
        x, y, yaw = self.origin
        offset = np.asarray(positions, dtype=np.float64).reshape(-1, 2) - (x, y)
        cosine, sine = np.cos(yaw), np.sin(yaw)
        with np.errstate(over="ignore", invalid="ignore"):  # it is too far away, and that is all
            turned = offset @ np.array([[cosine, -sine], [sine, cosine]])
            return np.asarray(turned / self.resolution)

    def centres_of(self, cells: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Centres (N, 2) of the cells (N, 2) in the frame [m]."""
        x, y, yaw = self.origin
        along = (np.asarray(cells, dtype=np.float64).reshape(-1, 2) + 0.5) * self.resolution
        cosine, sine = np.cos(yaw), np.sin(yaw)
        centres = along @ np.array([[cosine, sine], [-sine, cosine]]) + (x, y)
        return np.asarray(centres, dtype=np.float64)

    def contains(self, cells: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the cells (N, 2) lie on the map."""
        cells = np.asarray(cells, dtype=np.int64).reshape(-1, 2)
        height, width = self.free.shape
        x, y = cells[:, 0], cells[:, 1]
        return np.asarray((x >= 0) & (x < width) & (y >= 0) & (y < height))

    def is_free(self, cells: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the cells (N, 2) lie on the map and are free."""
        cells = np.asarray(cells, dtype=np.int64).reshape(-1, 2)
        free = self.contains(cells)
        free[free] = self.free[cells[free, 1], cells[free, 0]]
        return free

    def fault_of(self, cell: npt.ArrayLike) -> str | None:
        """Words on why nobody can be in a cell (x, y): it is outside, or blocked; else None."""
        x, y = np.asarray(cell).tolist()
        height, width = self.free.shape
        if not (0 <= x < width and 0 <= y < height):
            return f"cell ({x}, {y}) is outside the map of {width} x {height} cells"
        return None if self.free[y, x] else f"cell ({x}, {y}) is blocked on the map"
