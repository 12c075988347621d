"""Occupancy values, as nav_msgs/OccupancyGrid holds them, and the planning map they mean."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap

FREE = 0
"""Occupancy written for a free cell."""

OCCUPIED = 100
"""Occupancy written for a blocked cell."""

OCCUPIED_FROM = 50
"""Occupancy from which a cell counts as blocked; negative values (unknown) do too."""

MAX_CELLS = 50_000_000
"""Largest map that is accepted [cells]: 350 m square at 0.05 m, and 50 MB as bytes."""


def map_from_occupancy(
    data: npt.ArrayLike,
    width: int,
    height: int,
    resolution: float,
    origin: tuple[float, float, float],
    frame_id: str,
    source: str,
) -> GridMap:
    """The planning map that an occupancy grid means: 0-49 free, anything else blocked.

    Args:
        data: width * height occupancy values, row by row from the lowest y, as in the message.
        width, height: number of cells along x and y.
        resolution: edge of a cell [m].
        origin: (x, y, yaw) of the lower left corner of cell (0, 0) in the frame [m, m, rad].
        frame_id: the frame in which the origin is given.
        source: the topic or file, for the error's sentence.

    Raises:
        InputError: no free cell, zero or absurd size, data of another size, or a resolution or
            origin that is no usable number.
    """
    check_geometry(width, height, resolution, origin, source)
    occupancy = np.asarray(data).reshape(-1)
    if occupancy.size != width * height:
        raise InputError(
            f"{source}: the map says {width} x {height} cells but has {occupancy.size} values;"
            " publish or save it again"
        )
    free = ((occupancy >= 0) & (occupancy < OCCUPIED_FROM)).reshape(height, width)
    if not free.any():
        raise InputError(
            f"{source}: no cell of the map is free (occupancy 0-49);"
            " check its thresholds and whether it is inverted"
        )
    return GridMap(free, float(resolution), origin, frame_id)


def check_geometry(
    width: int,
    height: int,
    resolution: float,
    origin: tuple[float, float, float],
    source: str,
) -> None:
    """Refuse a size, resolution or origin that no map can have, before anything is allocated.

    Raises:
        InputError: as in `map_from_occupancy`.
    """
    if width <= 0 or height <= 0:
        raise InputError(
            f"{source}: the map has {width} x {height} cells; give one with at least one cell"
        )
    if width * height > MAX_CELLS:
        raise InputError(
            f"{source}: the map has {width} x {height} cells, more than the {MAX_CELLS} that are"
            " accepted; crop it or lower its resolution"
        )
    if not (math.isfinite(resolution) and resolution > 0):
        raise InputError(
            f"{source}: the map's resolution is {resolution} m;"
            " it must be a positive number of metres"
        )
    if not all(math.isfinite(value) for value in origin):
        raise InputError(
            f"{source}: the map's origin (x, y, yaw) is {tuple(origin)}; it must be finite numbers"
        )


def occupancy_of(grid_map: GridMap) -> npt.NDArray[np.int8]:
    """Occupancy (height * width,) of a planning map, as nav_msgs/OccupancyGrid orders it."""
    return np.where(grid_map.free, FREE, OCCUPIED).astype(np.int8).reshape(-1)


def yaw_of(x: float, y: float, z: float, w: float, source: str) -> float:
    """Yaw [rad] of a quaternion, normalised or not; all zeros, as many leave it, mean identity.

    Args:
        x, y, z, w: the quaternion's components.
        source: the topic or file, for the error's sentence.

    Raises:
        InputError: a component is NaN or infinite.
    """
    if not all(math.isfinite(value) for value in (x, y, z, w)):
        raise InputError(
            f"{source}: the orientation (x, y, z, w) is {(x, y, z, w)}; it must be finite numbers"
        )
    # Neither argument divides by the norm, so that any length will do; atan2(0, 0) is 0.
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
