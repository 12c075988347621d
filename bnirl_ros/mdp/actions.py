"""The actions of a grid world: eight moves and stay, in the order that is the index everywhere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

ACTION_NAMES = ("stay", "E", "NE", "N", "NW", "W", "SW", "S", "SE")
"""Names of the actions; the position in this tuple is the action index in files and arrays."""

STEPS: npt.NDArray[np.int64] = np.array(
    [[0, 0], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]]
)
"""Unit step (dx, dy) of each action, x to the right and y up; shape (9, 2)."""
STEPS.setflags(write=False)

ACTION_SETS: dict[int, tuple[int, ...]] = {4: (0, 1, 3, 5, 7), 8: tuple(range(9))}
"""Action indices by number of moves; stay is in both, the diagonals do not occur with 4 moves."""

_INDEX_OF_STEP = {(float(dx), float(dy)): index for index, (dx, dy) in enumerate(STEPS)}
_INDEX_OF_NAME = {name: index for index, name in enumerate(ACTION_NAMES)}


def action_of_step(dx: float, dy: float) -> int | None:
    """Index of the action with unit step (dx, dy), or None where that is no unit step."""
    return _INDEX_OF_STEP.get((dx, dy))


def action_of_name(name: str) -> int | None:
    """Index of the action called `name`, or None where no action is called so."""
    return _INDEX_OF_NAME.get(name)
