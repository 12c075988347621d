"""Maps as occupancy grids: the free space, and where a subgoal is how probable."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.inference.summary import Summary
from bnirl_ros.maps import GridMap, occupancy_of
from bnirl_ros.views.messages import MapMetaData, OccupancyGrid
from bnirl_ros.views.stamped import header_of, pose_of, time_of


def belief_grid(summary: Summary, grid_map: GridMap, stamp_ns: int) -> OccupancyGrid:
    """Posterior probability that each cell is a subgoal, 0-100, blocked cells 0.

    Raises:
        ValueError: the summary belongs to a map of another size.
    """
    probability = summary.cell_probability
    if probability.shape != grid_map.free.shape:
        raise ValueError(f"belief over {probability.shape} cells, map of {grid_map.free.shape}")
    percent = np.rint(100.0 * np.clip(probability, 0.0, 1.0)).astype(np.int8)
    return _grid(percent.reshape(-1), grid_map, stamp_ns)


def map_message(grid_map: GridMap, stamp_ns: int) -> OccupancyGrid:
    """The planning map: free cells 0, blocked cells 100."""
    return _grid(occupancy_of(grid_map), grid_map, stamp_ns)


def _grid(data: npt.NDArray[np.int8], grid_map: GridMap, stamp_ns: int) -> OccupancyGrid:
    height, width = grid_map.free.shape
    x, y, yaw = grid_map.origin
    return OccupancyGrid(
        header=header_of(grid_map.frame_id, stamp_ns),
        info=MapMetaData(
            map_load_time=time_of(stamp_ns),
            resolution=grid_map.resolution,
            width=width,
            height=height,
            origin=pose_of((x, y), yaw),
        ),
        data=data,
    )
