"""The order in which a wave that runs out from goals reaches the cells of a map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

STRAIGHT, DIAGONAL = 8, 9
"""What a move costs the wave. By the order of values a diagonal move is a little dearer: the
noise on the way does less harm beside it than before and behind."""

EVERYWHERE = 2**31 - 1
"""More than any way costs; it stands for what the wave has not come near, too."""

_BUCKETS = 16  # more than the dearest move; the wave's front is kept in so many lists by cost


class Wave(NamedTuple):
    """Where a wave has come, in arrays over the S states of a map that are used again.

    Attributes:
        order: (S,) int32 the cells that are reached, in their order.
        place: (S,) int32 each cell's place in the order; -1 where it is not reached.
        cost: (S,) int32 what it costs to reach it.
        following, before: (S,) int32 its neighbours in the list in which it waits.
    """

    order: npt.NDArray[np.int32]
    place: npt.NDArray[np.int32]
    cost: npt.NDArray[np.int32]
    following: npt.NDArray[np.int32]
    before: npt.NDArray[np.int32]

    @classmethod
    def at_rest(cls, state_count: int) -> Wave:
        """One that has not begun."""
        order, following, before = np.empty((3, state_count), dtype=np.int32)
        place = np.full(state_count, -1, dtype=np.int32)
        cost = np.full(state_count, EVERYWHERE, dtype=np.int32)
        return cls(order, place, cost, following, before)


@njit(nogil=True, cache=True)
def spread(open_moves, offsets, costs, sources, sought, left, margin, limit, wave):  # type: ignore[no-untyped-def]
    """Let a wave run out from some cells; returns how many it reaches.

    Dial's algorithm: cells that wait are in a ring of linked lists, one for each cost. The wave
    ends where no cell is left, or `margin` beyond the last of `left` cells that are sought, or at
    `limit`.

    Args:
        open_moves: (S,) bit sets of the moves that are not blocked; 0 for a blocked cell.
        offsets: tuple of what each action adds to the state number; staying is the first.
        costs: tuple of what each of them costs the wave.
        sources: state numbers, each once.
        sought: (S,) bool.
        left: how many of them the wave is to reach; 0 to go everywhere.
        margin, limit: costs.
        wave: one at rest.
    """
    order, place, cost, following, before = wave
    first = np.full(_BUCKETS, -1, dtype=np.int32)
    for source in sources:
        cost[source] = 0
        following[source] = first[0]
        before[source] = -1
        if first[0] >= 0:
            before[first[0]] = source
        first[0] = source
    reached, waiting, now = 0, sources.shape[0], 0
    while waiting > 0 and now <= limit:
        state = first[now % _BUCKETS]
        if state < 0:
            now += 1
            continue
        after = following[state]
        first[now % _BUCKETS] = after
        if after >= 0:
            before[after] = -1
        waiting -= 1
        place[state] = reached
        order[reached] = state
        reached += 1
        if sought[state]:
            left -= 1
            if left == 0:
                limit = min(limit, now + margin)
        bits = np.int64(open_moves[state])
        for action in range(1, len(offsets)):
            if not (bits >> action) & 1:
                continue
            outcome = state + offsets[action]
            through = now + costs[action]
            if through >= cost[outcome]:
                continue
            if cost[outcome] == EVERYWHERE:
                waiting += 1
            else:
                _leave(outcome, first, cost, following, before)
            cost[outcome] = through
            head = first[through % _BUCKETS]
            following[outcome] = head
            before[outcome] = -1
            if head >= 0:
                before[head] = outcome
            first[through % _BUCKETS] = outcome
    for head in first:  # those that wait are as if the wave had not come near
        while head >= 0:
            cost[head] = EVERYWHERE
            head = following[head]
    return reached


@njit(nogil=True, cache=True)
def _leave(state, first, cost, following, before):  # type: ignore[no-untyped-def]
    """Take a cell out of the list in which it waits."""
    left, right = before[state], following[state]
    if left >= 0:
        following[left] = right
    else:
        first[cost[state] % _BUCKETS] = right
    if right >= 0:
        before[right] = left


def rest(wave: Wave, reached: int) -> None:
    """Make a wave that has reached so many cells ready for the next."""
    order = wave.order[:reached]
    wave.place[order] = -1
    wave.cost[order] = EVERYWHERE
