"""The connected parts of a map's free space."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def connected_parts(free):  # type: ignore[no-untyped-def]
    """(height, width) int32 number of each free cell's part, from 1 by first cell; 0 if blocked.

    Moves to the sides tell parts: a diagonal move needs both cells beside it. Not scipy's, whose
    import would take a fifth of the time until a command's first result.
    """
    height, width = free.shape
    part_of = np.zeros((height, width), dtype=np.int32)
    waiting = np.empty(free.size, dtype=np.int64)
    parts = np.int32(0)
    for first in range(free.size):
        if not free[first // width, first % width] or part_of[first // width, first % width] > 0:
            continue
        parts += np.int32(1)
        part_of[first // width, first % width] = parts
        waiting[0] = first
        count = 1
        while count > 0:
            count -= 1
            y, x = waiting[count] // width, waiting[count] % width
            for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                near_y, near_x = y + dy, x + dx
                if not (0 <= near_y < height and 0 <= near_x < width):
                    continue
                if free[near_y, near_x] and part_of[near_y, near_x] == 0:
                    part_of[near_y, near_x] = parts
                    waiting[count] = near_y * width + near_x
                    count += 1
    return part_of
