"""First-passage values of a grid world, in sweeps along the wave that runs out from each goal.

The discounted first-passage value h(s) of a goal g is the mean of gamma ** (steps until g) under
the policy that makes it largest: h(g) = 1, and h(s) = gamma max_a E[h(s')] elsewhere.

A Gauss-Seidel sweep that takes the cells in the order in which a wave from the goal reaches them
settles the near ones, but carries little of that further: where the cells behind the wave have
changed by a factor, those before it still have their old values, and hold it back. It is the
ratios of neighbours that are nearly right, not the values. So every other sweep takes the cells
not reached yet as if they were to change by the same factor as the cell itself: with U the part
of E[h] that lies behind the wave and D the old part before it,

    h = U + D h / h_old,  or  h = U / (1 - D / h_old).

Its fixed point is the same. The sweeps between, which are plain ones, tell how far off the values
can be at most: see `_amplification`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

STRAIGHT, DIAGONAL = 8, 9
"""What a move costs the wave. By the order of values a diagonal move is a little dearer: the
noise on the way does less harm beside it than before and behind."""

_BUCKETS = 16  # more than the dearest move; the wave's front is kept in so many lists by cost
_FAR = np.int32(2**31 - 1)
_FINEST = 2e-15  # changes by this factor are rounding
_LEAST = 1e-280  # smaller values are as good as none
_STEADIEST = 0.3  # the least 1 - D / h_old that is divided by
_NO_NAN = {"nnan", "ninf", "nsz"}  # nothing that changes a value: the order of sums is kept
_PATIENCE = 20  # sweeps in which no further cell settles, after which all are plain ones


@njit(nogil=True, cache=True, error_model="numpy")
def first_passage_values(  # type: ignore[no-untyped-def]
    open_moves, offsets, costs, success, spread, discount, goals, tolerance
):
    """(S, L) h of each of the goals (L,), with an error of at most h times `tolerance`.

    Zero where a goal cannot be reached from.

    Args:
        open_moves: (S,) bit sets of the moves that are not blocked; 0 for a blocked cell.
        offsets: tuple of what each action adds to the state number; staying is the first.
        costs: tuple of what each of them costs the wave.
        success, spread: probability of the chosen action's outcome, and of each other one; the
            first is the larger.
        discount: gamma, above 0.
        goals: state numbers.
        tolerance: bound on the relative error of all values above 1e-280; rounding comes on top.
    """
    state_count = open_moves.shape[0]
    values = np.zeros((state_count, goals.shape[0]))
    value = np.empty(state_count)
    order = np.empty(state_count, dtype=np.int32)
    behind = np.empty(state_count, dtype=np.uint16)
    place, cost, following, before = np.empty((4, state_count), dtype=np.int32)
    chosen, other = discount * (success - spread), discount * spread
    decay = _decay(chosen, other, len(offsets))
    for lane in range(goals.shape[0]):
        reached = _wave(
            open_moves, offsets, costs, goals[lane], order, behind, place, cost, following, before
        )
        for number in range(reached):
            state = order[number]
            value[state] = math.exp(decay * cost[state])
        _relax(
            open_moves,
            offsets,
            chosen,
            other,
            discount,
            order[:reached],
            behind,
            tolerance,
            value,
        )
        for number in range(reached):
            values[order[number], lane] = value[order[number]]
    return values


@njit(nogil=True, cache=True)
def _decay(chosen, other, actions):  # type: ignore[no-untyped-def]
    """By how much log h falls for each unit of the wave's cost, far from everything."""
    sides = 3 if actions > 5 else 1  # outcomes that go on, and as many that go back
    step = 0.9
    for _ in range(100):
        step = chosen + other * (sides * (1.0 + step * step) + (actions - 2 * sides) * step)
    return math.log(max(step, _LEAST)) / STRAIGHT


@njit(nogil=True, cache=True)
def _wave(  # type: ignore[no-untyped-def]
    open_moves, offsets, costs, goal, order, behind, place, cost, following, before
):
    """The order in which a wave from the goal reaches cells; returns how many it reaches.

    Dial's algorithm: cells that wait are in a ring of linked lists, one for each cost.

    Args:
        open_moves, offsets, costs, goal: as above.
        order: (S,) the cells that are reached, in their order.
        behind: (S,) for each of them the bit set of moves to cells that were reached before.
        place: (S,) each cell's place in the order; -1 where it is not reached.
        cost: (S,) what it costs to reach it.
        following, before: (S,) its neighbours in the list in which it waits.
    """
    first = np.full(_BUCKETS, -1, dtype=np.int32)
    place[:] = -1
    cost[:] = _FAR
    cost[goal] = 0
    first[0] = goal
    following[goal] = before[goal] = -1
    reached, waiting, now = 0, 1, 0
    while waiting > 0:
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
        bits = np.int64(open_moves[state])
        behind_bits = 0
        for action in range(1, len(offsets)):
            if not (bits >> action) & 1:
                continue
            outcome = state + offsets[action]
            if place[outcome] >= 0:
                behind_bits |= 1 << action
                continue
            through = now + costs[action]
            if through >= cost[outcome]:
                continue
            if cost[outcome] == _FAR:
                waiting += 1
            else:
                left, right = before[outcome], following[outcome]
                if left >= 0:
                    following[left] = right
                else:
                    first[cost[outcome] % _BUCKETS] = right
                if right >= 0:
                    before[right] = left
            cost[outcome] = through
            head = first[through % _BUCKETS]
            following[outcome] = head
            before[outcome] = -1
            if head >= 0:
                before[head] = outcome
            first[through % _BUCKETS] = outcome
        behind[reached] = behind_bits
        reached += 1
    return reached


@njit(nogil=True, cache=True, error_model="numpy")
def _relax(  # type: ignore[no-untyped-def]
    open_moves, offsets, chosen, other, discount, order, behind, tolerance, value
):
    """Bring `value` (S,) to h, within h times `tolerance`."""
    wanted, fewest, stuck = tolerance, order.shape[0] + 1, 0
    while True:
        if stuck < _PATIENCE:
            _rescaling_sweep(open_moves, offsets, chosen, other, discount, order, behind, value)
        change, least, unsettled = _plain_sweep(
            open_moves, offsets, chosen, other, order, wanted, value
        )
        wanted = max(_FINEST, tolerance / _amplification(least, discount))
        if change <= wanted:
            return
        if unsettled < fewest:
            fewest, stuck = unsettled, 0 if stuck < _PATIENCE else stuck
        else:
            stuck += 1


@njit(nogil=True, cache=True)
def _amplification(least, discount):  # type: ignore[no-untyped-def]
    """How much larger the relative error can be than the relative change in a plain sweep.

    Let h be values of which the least is `least`, and the operator T change them by no more than
    d h; after a sweep that changed no value by a larger part than d that is so, since what changed
    after a cell had its turn is only a part of its mean. For every policy gamma P h <= (1 + d) h,
    and so by Jensen's inequality gamma P w <= gamma ** t (1 + d) ** (1 - t) w with
    w = h ** (1 - t) for any t in (0, 1]: in the norm weighted by w, T is a contraction. Hence
    |h* - h| <= d w / (1 - gamma ** t), but for terms of the order d ** 2, and relative to h that
    is d h ** -t / (1 - gamma ** t). With t = 1 it is the common bound on the absolute error, over
    the least value; far from the goal a smaller t says much more.
    """
    steps = -math.log(max(least, _LEAST))  # in nats, from the goal to the farthest cell
    t = 1.0 / max(1.0, steps)
    return math.exp(t * steps) / (1.0 - discount**t)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_NO_NAN)
def _rescaling_sweep(  # type: ignore[no-untyped-def]
    open_moves, offsets, chosen, other, discount, order, behind, value
):
    """A sweep in which what lies before the wave changes as the cell itself does."""
    all_open = (1 << len(offsets)) - 1
    for number in range(1, order.shape[0]):
        state = order[number]
        bits, behind_bits = np.int64(open_moves[state]), np.int64(behind[number])
        old = value[state]
        total_behind, best_behind = 0.0, 0.0
        total_before, best_before = old, old
        if bits == all_open:
            for action in range(1, len(offsets)):
                outcome_value = value[state + offsets[action]]
                if (behind_bits >> action) & 1:
                    total_behind += outcome_value
                    best_behind = max(best_behind, outcome_value)
                else:
                    total_before += outcome_value
                    best_before = max(best_before, outcome_value)
        else:  # the same where some moves stay; testing each costs as much as all the rest
            for action in range(1, len(offsets)):
                step = offsets[action] if (bits >> action) & 1 else 0
                outcome_value = value[state + step]
                if (behind_bits >> action) & 1:
                    total_behind += outcome_value
                    best_behind = max(best_behind, outcome_value)
                else:
                    total_before += outcome_value
                    best_before = max(best_before, outcome_value)
        left = old - other * total_before
        if best_before > best_behind or left <= _STEADIEST * old:
            best = max(best_before, best_behind)
            value[state] = other * (total_behind + total_before) + chosen * best
        else:
            # No mean over outcomes is more than the largest of them.
            largest = discount * best_behind
            rescaled = (other * total_behind + chosen * best_behind) * old / left
            value[state] = min(rescaled, largest)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_NO_NAN)
def _plain_sweep(  # type: ignore[no-untyped-def]
    open_moves, offsets, chosen, other, order, wanted, value
):
    """A sweep of Gauss and Seidel.

    Returns:
        The largest relative change, the least value, and how many changed by more than `wanted`.
    """
    all_open = (1 << len(offsets)) - 1
    change, least, unsettled = 0.0, 1.0, 0
    for number in range(1, order.shape[0]):
        state = order[number]
        bits = np.int64(open_moves[state])
        old = value[state]
        total, best = old, old
        if bits == all_open:
            for action in range(1, len(offsets)):
                outcome_value = value[state + offsets[action]]
                total += outcome_value
                best = max(best, outcome_value)
        else:
            for action in range(1, len(offsets)):
                step = offsets[action] if (bits >> action) & 1 else 0
                outcome_value = value[state + step]
                total += outcome_value
                best = max(best, outcome_value)
        new = other * total + chosen * best
        difference = abs(new - old)
        if difference > change * new and new > _LEAST:
            change = difference / new
        unsettled += difference > wanted * new
        least = min(least, new)
        value[state] = new
    return change, least, unsettled
