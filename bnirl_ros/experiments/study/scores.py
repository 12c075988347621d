"""How subgoals that were found are held against true ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise

import numpy as np
import numpy.typing as npt

Cell = tuple[int, int]


def top_hits(ranked: Sequence[Cell], truth: Iterable[Cell]) -> int:
    """How many of k true cells are among the first k of a ranking, which may be shorter."""
    true_cells = set(truth)
    return len(true_cells & set(ranked[: len(true_cells)]))


def matches(truth: Iterable[Cell], found: Iterable[Cell], reach: int) -> int:
    """How many true cells have one that was found no more than `reach` cells away, or diagonally.

    True cells lie further apart than twice `reach`, so that no cell that was found counts twice.
    Over the number of true cells it is the recall; over the number of those found the precision,
    for which a second one beside the same true cell is wrong.
    """
    near = list(found)
    return sum(any(apart(cell, other) <= reach for other in near) for cell in truth)


def apart(one: Cell, other: Cell) -> int:
    """Moves from one cell to another on an open map with diagonals."""
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]))


def nearest_within(
    positions: npt.ArrayLike, places: npt.ArrayLike, reach: float
) -> list[int | None]:
    """Which of the places (P, 2) is nearest to each of the positions (M, 2); None beyond reach.

    Args:
        positions, places: in one frame [m].
        reach: largest distance, itself included [m].
    """
    here = np.asarray(positions, dtype=np.float64).reshape(-1, 1, 2)
    distances = np.linalg.norm(here - np.asarray(places, dtype=np.float64), axis=2)
    return [int(row.argmin()) if row.min() <= reach else None for row in distances]


def visits(places: Iterable[int | None]) -> list[int]:
    """The places visited, in order: without what is none, and without repeats in a row."""
    return [place for place, _ in groupby(place for place in places if place is not None)]


def goes_round(visited: Sequence[int], cycle: Sequence[int]) -> bool:
    """Whether visits go round a cycle, from anywhere and as often as they like.

    Places of the cycle that are never visited are left out of it: each visit must be followed by
    the next place in the cycle that is visited at all.
    """
    left = [place for place in cycle if place in visited]
    follower = dict(zip(left, [*left[1:], *left[:1]], strict=True))
    return all(follower.get(place) == following for place, following in pairwise(visited))
