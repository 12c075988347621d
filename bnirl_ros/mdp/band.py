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

from bnirl_ros.mdp.lanes import LANES, LEAST, raised_row, relaxed_row
from bnirl_ros.mdp.wave import STRAIGHT

FINEST = 2e-15
"""Changes by this factor are rounding."""

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
    for lane in range(lane_count):
        value[rows_of_goals[lane] * lane_count + lane] = 1.0
    inner, front, farthest, waited = 0, 0, 0, 0
    omega, enough, last = law.omega, wanted, False
    while True:
        entered = outer
        while outer < rows and distance[outer] <= distance[front] + _DEPTH:
            _enter(lane_count, neighbours, law.fades, outer, value)
            outer += 1
        if entered == 0 and lane_count > 1:
            _fill(neighbours, law.fades, outer, value)
        omega_now, wanted_now = (1.0, enough) if last else (omega, wanted)
        if lane_count == 1:
            front = _sweep_of_one(law, neighbours, inner, outer, omega_now, wanted_now, value)
        else:
            front = _sweep(
                law, neighbours, rows_of_goals, inner, outer, omega_now, wanted_now, value
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
def _enter(lane_count, neighbours, fades, row, value):  # type: ignore[no-untyped-def]
    """Raise a row of values to what its neighbours lend it; who has none yet lends none."""
    if lane_count > 1:
        raised_row(value, neighbours, row, fades)
    else:
        for move in range(neighbours.shape[1]):
            lent = fades[move] * value[neighbours[row, move]]
            value[row] = max(value[row], lent)


@njit(nogil=True, cache=True)
def _fill(neighbours, fades, outer, value):  # type: ignore[no-untyped-def]
    """Give values to all lanes of the first rows: in most, their goal does not come first."""
    before = LANES * outer + 1
    while True:
        for row in range(outer - 1, -1, -1):
            raised_row(value, neighbours, row, fades)
        for row in range(outer):
            raised_row(value, neighbours, row, fades)
        without = 0
        for index in range(LANES * outer):
            without += value[index] == 0.0
        if without == 0 or without >= before:
            return
        before = without


@njit(nogil=True, cache=True)
def _sweep(law, neighbours, rows_of_goals, inner, outer, omega, wanted, value):  # type: ignore[no-untyped-def]
    """Over-relax the rows from `inner` to `outer`; returns the first that is not settled.

    That is one in which a value and gamma max_a E[h] differ by more than its part `wanted`;
    `outer` where there is none.
    """
    first = outer
    for row in range(inner, outer):
        if relaxed_row(value, neighbours, row, rows_of_goals, law, omega, wanted) and row < first:
            first = row
    return first


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_NO_NAN)
def _sweep_of_one(law, neighbours, inner, outer, omega, wanted, value):  # type: ignore[no-untyped-def]
    """`_sweep` of a single goal, which comes first in the order."""
    first = outer
    for row in range(max(inner, 1), outer):
        old = value[row]
        total, best = _gathered(value, neighbours[row], 0, old, old)
        if len(law.fades) == 8:
            total, best = _gathered(value, neighbours[row], 4, total, best)
        new = law.other * total + law.chosen * best
        if abs(new - old) > wanted * new + LEAST and row < first:
            first = row
        value[row] = old + omega * (new - old)
    return first


@njit(nogil=True, cache=True, inline="always", error_model="numpy", fastmath=_NO_NAN)
def _gathered(value, neighbours, move, total, best):  # type: ignore[no-untyped-def]
    """The values of four more neighbours added to a sum, and to a maximum."""
    a, b = value[neighbours[move]], value[neighbours[move + 1]]
    c, d = value[neighbours[move + 2]], value[neighbours[move + 3]]
    total += (a + b) + (c + d)
    return total, max(max(max(a, b), max(c, d)), best)
