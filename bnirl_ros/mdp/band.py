"""Sweeps over a band of a map's cells that moves out from the goals: the kernels.

Cells are rows here, in the order in which the wave of `bnirl_ros.mdp.wave` reaches them, with a
value for each goal in each of them, in the lanes of vectors. One more row stands for all that the
wave did not reach. How it works is told in `bnirl_ros.mdp.first_passage`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from bnirl_ros.mdp.wave import STRAIGHT

FINEST = 2e-15
"""Changes by this factor are rounding."""
LEAST = 1e-280
"""Smaller values are as good as none."""

_DEPTH = 40 * STRAIGHT  # the band reaches so far ahead of the cells that are settled
_BACK = 10 * STRAIGHT  # and so far back behind the first that is not
_PATIENCE = 300  # sweeps in which the band does not move, after which none is over-relaxed
_NO_NAN = {"nnan", "ninf", "nsz"}  # nothing that changes a value: the order of sums is kept


class Law(NamedTuple):
    """How values follow from those of the neighbours, as the kernels take it.

    Attributes:
        chosen, other: gamma times what the chosen action's outcome is the more probable, and gamma
            times the probability of each other one. The mean over the outcomes n_b of action a is,
            with gamma in it, chosen n_a + other sum_b n_b.
        discount: gamma, above 0.
        fades: for each move, about what it takes of a value; its length is what the compiler has
            to know.
        omega: by how much sweeps over-relax.
    """

    chosen: float
    other: float
    discount: float
    fades: tuple[float, ...]
    omega: float


@njit(nogil=True, cache=True)
def amplification(least, discount):  # type: ignore[no-untyped-def]
    """How much larger the relative error can be than the relative change in a sweep.

    Let h be values of which the least is `least`, and the operator T change them by no more than
    d h; after a sweep that changed no value by a larger part than d that is so, since what changed
    after a cell had its turn is only a part of its mean. For every policy gamma P h <= (1 + d) h,
    and so by Jensen's inequality gamma P w <= gamma ** t (1 + d) ** (1 - t) w with
    w = h ** (1 - t) for any t in (0, 1]: in the norm weighted by w, T is a contraction. Hence
    |h* - h| <= d w / (1 - gamma ** t), but for terms of the order d ** 2, and relative to h that
    is d h ** -t / (1 - gamma ** t). With t = 1 it is the common bound on the absolute error, over
    the least value; far from the goal a smaller t says much more.
    """
    steps = -math.log(max(least, LEAST))  # in nats, from the goal to the farthest cell
    t = 1.0 / max(1.0, steps)
    return math.exp(t * steps) / (1.0 - discount**t)


@njit(nogil=True, cache=True)
def neighbours_in_order(open_moves, offsets, order, place):  # type: ignore[no-untyped-def]
    """(rows, A - 1) rows to which the moves lead; one more than there are for what has none."""
    neighbours = np.empty((order.shape[0], len(offsets) - 1), dtype=np.uint32)
    for row in range(order.shape[0]):
        state = order[row]
        bits = np.int64(open_moves[state])
        for action in range(1, len(offsets)):
            outcome = row
            if (bits >> action) & 1:
                outcome = place[state + offsets[action]]
                if outcome < 0:
                    outcome = order.shape[0]
            neighbours[row, action - 1] = outcome
    return neighbours


@njit(nogil=True, cache=True)
def settle(law, neighbours, distance, rows_of_goals, tolerance, residual, wanted, outer, value):  # type: ignore[no-untyped-def]
    """Bring `value` to h.

    Args:
        law: a `Law`.
        neighbours: from `neighbours_in_order`.
        distance: (rows,) what each row costs the wave.
        rows_of_goals: (L,) of each lane.
        tolerance: bound on the relative error of all values above `LEAST`.
        residual: it is enough, too, that no value differs from gamma max_a E[h] by more than this
            part of itself.
        wanted: by how much of itself a value may change in a row that is settled, to begin with.
        outer: so many rows have values already.
        value: ((rows + 1) L,) of which the last row is kept; zero from row `outer` on.
    """
    rows, lane_count = distance.shape[0], rows_of_goals.shape[0]
    goals_end = 0
    for lane in range(lane_count):
        value[rows_of_goals[lane] * lane_count + lane] = 1.0
        goals_end = max(goals_end, rows_of_goals[lane] + 1)
    scratch = np.empty(lane_count)
    inner, front, farthest, waited = 0, 0, 0, 0
    omega, enough, last = law.omega, wanted, False
    while True:
        entered = outer
        while outer < rows and distance[outer] <= distance[front] + _DEPTH:
            _enter(lane_count, neighbours, law.fades, outer, outer, value)
            outer += 1
        if entered == 0 and lane_count > 1:
            _fill(lane_count, neighbours, law.fades, outer, value)
        omega_now, wanted_now = (1.0, enough) if last else (omega, wanted)
        front = _sweep(
            law,
            neighbours,
            rows_of_goals,
            goals_end,
            inner,
            outer,
            omega_now,
            wanted_now,
            scratch,
            value,
        )
        if last and front == rows:
            return
        if last:
            wanted, last = max(FINEST, 0.5 * min(wanted, enough)), False
        elif front == rows:  # all are settled: does a last sweep over all agree?
            least = 1.0
            for index in range(rows * lane_count):
                least = min(least, value[index])
            enough = max(FINEST, residual, tolerance / amplification(least, law.discount))
            inner, last = 0, True
            continue
        front = min(front, rows - 1)
        while inner < front and distance[inner] < distance[front] - _BACK:
            inner += 1
        waited = 0 if front > farthest else waited + 1
        farthest = max(farthest, front)
        if waited > _PATIENCE:
            omega = 1.0


@njit(nogil=True, cache=True)
def _enter(lane_count, neighbours, fades, row, outer, value):  # type: ignore[no-untyped-def]
    """Raise a row of values to what its neighbours before `outer` lend it."""
    count = np.uint64(lane_count)
    start = np.uint64(row) * count
    for move in range(neighbours.shape[1]):
        if neighbours[row, move] < outer:
            fade = fades[move]
            other_start = np.uint64(neighbours[row, move]) * count
            for index in range(lane_count):
                lane = np.uint64(index)
                lent = fade * value[other_start + lane]
                if lent > value[start + lane]:
                    value[start + lane] = lent


@njit(nogil=True, cache=True)
def _fill(lane_count, neighbours, fades, outer, value):  # type: ignore[no-untyped-def]
    """Give values to all lanes of the first rows: in most, their goal does not come first."""
    before = lane_count * outer + 1
    while True:
        for row in range(outer - 1, -1, -1):
            _enter(lane_count, neighbours, fades, row, outer, value)
        for row in range(outer):
            _enter(lane_count, neighbours, fades, row, outer, value)
        without = 0
        for index in range(lane_count * outer):
            without += value[index] == 0.0
        if without == 0 or without >= before:
            return
        before = without


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_NO_NAN)
def _sweep(  # type: ignore[no-untyped-def]
    law, neighbours, rows_of_goals, goals_end, inner, outer, omega, wanted, scratch, value
):
    """Over-relax the rows from `inner` to `outer`; returns the first that is not settled.

    That is one in which a value and gamma max_a E[h] differ by more than its part `wanted`;
    `outer` where there is none.
    """
    if rows_of_goals.shape[0] == 1:
        return _sweep_of_one(law, neighbours, inner, outer, omega, wanted, value)
    lane_count = rows_of_goals.shape[0]
    count = np.uint64(lane_count)
    first = outer
    for row in range(inner, outer):
        start = np.uint64(row) * count
        unsettled = 0
        a, b, c, d = _starts(neighbours, row, 0, count)
        if len(law.fades) == 8:
            e, f, g, h = _starts(neighbours, row, 4, count)
        for index in range(lane_count):
            lane = np.uint64(index)
            old = value[start + lane]
            total, best = _gathered(value, a + lane, b + lane, c + lane, d + lane, old, old)
            if len(law.fades) == 8:
                total, best = _gathered(value, e + lane, f + lane, g + lane, h + lane, total, best)
            new = law.other * total + law.chosen * best
            unsettled += abs(new - old) > wanted * new + LEAST
            # Written only when all is read: else the compiler would not use vectors.
            scratch[lane] = old + omega * (new - old)
        if row < goals_end:  # their own lanes are not to change
            for lane in range(lane_count):
                if rows_of_goals[lane] == row:
                    difference = (1.0 - scratch[lane]) / omega
                    unsettled -= difference > wanted * (1.0 - difference) + LEAST
                    scratch[lane] = 1.0
        for index in range(lane_count):
            lane = np.uint64(index)
            value[start + lane] = scratch[lane]
        if unsettled > 0 and row < first:
            first = row
    return first


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_NO_NAN)
def _sweep_of_one(law, neighbours, inner, outer, omega, wanted, value):  # type: ignore[no-untyped-def]
    """`_sweep` of a single goal, which comes first in the order."""
    first, one = outer, np.uint64(1)
    for row in range(max(inner, 1), outer):
        old = value[row]
        a, b, c, d = _starts(neighbours, row, 0, one)
        total, best = _gathered(value, a, b, c, d, old, old)
        if len(law.fades) == 8:
            a, b, c, d = _starts(neighbours, row, 4, one)
            total, best = _gathered(value, a, b, c, d, total, best)
        new = law.other * total + law.chosen * best
        if abs(new - old) > wanted * new + LEAST and row < first:
            first = row
        value[row] = old + omega * (new - old)
    return first


@njit(nogil=True, cache=True, inline="always")
def _starts(neighbours, row, move, count):  # type: ignore[no-untyped-def]
    """Where the values of four neighbours begin."""
    return (
        np.uint64(neighbours[row, move]) * count,
        np.uint64(neighbours[row, move + 1]) * count,
        np.uint64(neighbours[row, move + 2]) * count,
        np.uint64(neighbours[row, move + 3]) * count,
    )


@njit(nogil=True, cache=True, inline="always", error_model="numpy", fastmath=_NO_NAN)
def _gathered(value, a, b, c, d, total, best):  # type: ignore[no-untyped-def]
    """Four more values added to a sum, and to a maximum."""
    at_a, at_b, at_c, at_d = value[a], value[b], value[c], value[d]
    total += (at_a + at_b) + (at_c + at_d)
    return total, max(max(max(at_a, at_b), max(at_c, at_d)), best)
