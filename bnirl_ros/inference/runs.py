"""Pursuits as they are told from subgoals: maximal runs of one subgoal within an episode.

A slip neither ends a run nor splits it, nor does drawing the same subgoal again.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit


def runs(
    subgoal_of: npt.ArrayLike, starts: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First and last explained observation (P,) of each run, in order.

    Args:
        subgoal_of: (N,) subgoal of each observation, in any numbers; negative for a slip.
        starts: (N,) bool which observations begin an episode.
    """
    explained = np.flatnonzero(np.asarray(subgoal_of) >= 0)
    subgoal = np.asarray(subgoal_of)[explained]
    episode = np.cumsum(starts)[explained]
    begins = np.ones(len(explained), dtype=np.bool_)
    begins[1:] = (np.diff(subgoal) != 0) | (np.diff(episode) != 0)
    ends = np.append(begins[1:], np.ones(min(len(begins), 1), dtype=np.bool_))
    return explained[begins], explained[ends]


@njit(nogil=True, cache=True)
def run_counts(subgoal_of, starts, candidates):  # type: ignore[no-untyped-def]
    """(D, G) int64 number of runs of each candidate in draws (D, N) int32."""
    counts = np.zeros((subgoal_of.shape[0], candidates), dtype=np.int64)
    for draw in range(subgoal_of.shape[0]):
        before = -1
        for t in range(starts.shape[0]):
            if starts[t]:
                before = -1
            subgoal = subgoal_of[draw, t]
            if subgoal >= 0 and subgoal != before:
                counts[draw, subgoal] += 1
                before = subgoal
    return counts
