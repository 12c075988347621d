"""First-passage values of a grid world, in a band of sweeps that moves out from the goals.

The discounted first-passage value h(s) of a goal g is the mean of gamma ** (steps until g) under
the policy that makes it largest: h(g) = 1, and h(s) = gamma max_a E[h(s')] elsewhere.

A sweep that takes the cells in the order in which a wave from the goal reaches them carries the
values outwards, but where the near ones are still wrong all that lies behind them is: over a whole
map it takes the more sweeps the larger the map. What lies farther out, on the other hand, hardly
acts on a cell: a demonstrator seldom goes back. So the sweeps go over a band of some tens of moves
only, which moves out as the cells at its inner edge settle. A cell that enters it is given the
value of its neighbours behind, less what a move costs. Some twenty sweeps pass over each cell,
whatever the size of the map, and the band fits into the caches.

A sweep is successive over-relaxation. Goals that lie near each other are solved in the lanes of
vectors, in one order. A last sweep without over-relaxation, over all cells, tells how far off the
values can be at most: see `bnirl_ros.mdp.band.amplification`.

Where only a part of a large map is asked for, the wave ends a margin behind it. The values are
then a lower bound, as if who leaves that part never came back; `_gap` finds an upper one. The
margin is widened until the two agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.mdp.band import FINEST, Law, amplification, neighbours_in_order, settle
from bnirl_ros.mdp.lanes import LANES, LEAST
from bnirl_ros.mdp.wave import DIAGONAL, EVERYWHERE, STRAIGHT, Wave, rest, spread

_TOGETHER = 40 * STRAIGHT  # goals solved together lie so near the first of them
_MARGIN = 32 * STRAIGHT  # at first, behind what is asked for
_BEYOND = 1.3  # h outside of what was reached is sought below so many times that at the edge
_MORE = 1.3  # over-relaxation, beyond 1, for Young's


class Motion(NamedTuple):
    """How the demonstrator moves on a map.

    Attributes:
        open_moves: (S,) uint16 bit sets of the moves that are not blocked; 0 for a blocked cell.
        offsets: what each action adds to the state number; staying is the first.
        costs: what each of them costs the wave.
        success, spread: probability of the chosen action's outcome, and of each other one; the
            first is the larger.
        discount: gamma, above 0.
    """

    open_moves: npt.NDArray[np.uint16]
    offsets: tuple[int, ...]
    costs: tuple[int, ...]
    success: float
    spread: float
    discount: float


@dataclass(frozen=True)
class _Rows:
    """Cells in the order of a wave.

    Attributes:
        neighbours: (rows, A - 1) from `neighbours_in_order`.
        distance: (rows,) int32 what each one costs the wave.
        rows_of_goals: (L,) of each lane.
    """

    neighbours: npt.NDArray[np.uint32]
    distance: npt.NDArray[np.int32]
    rows_of_goals: npt.NDArray[np.int64]

    @property
    def whole(self) -> bool:
        """Whether no move leads to where the wave has not come."""
        return not (self.neighbours == len(self.distance)).any()


def first_passage_values(
    motion: Motion,
    goals: npt.NDArray[np.int64],
    tolerance: float,
    residual: float,
    asked: npt.NDArray[np.int64],
    part_of: npt.NDArray[np.int32],
) -> npt.NDArray[np.float64]:
    """(S, L) h of each of the goals (L,).

    Zero where a goal cannot be reached from, and far from where it is asked for.

    Args:
        motion: how the demonstrator moves.
        goals: state numbers, each once.
        tolerance: bound on the relative error of all values above 1e-280; rounding comes on top.
        residual: where the whole map is solved it is enough, too, that no value differs from
            gamma max_a E[h] by more than this part of itself.
        asked: (U,) states whose values are asked for, each once; (0,) for all.
        part_of: (S,) number of the connected part of the map in which each state lies.
    """
    law = _law(motion)
    wave = Wave.at_rest(len(part_of))
    values = np.zeros((len(part_of), len(goals)))  # pages that nobody writes cost nothing
    column_of = dict(zip(goals.tolist(), range(len(goals)), strict=True))
    is_left = np.zeros(len(part_of), dtype=np.bool_)
    is_left[goals] = True
    is_asked = np.zeros(len(part_of), dtype=np.bool_)
    is_asked[asked] = True
    for goal in goals:
        if is_left[goal]:
            left_here = int((is_left[goals] & (part_of[goals] == part_of[goal])).sum())
            near = _near(motion, goal, is_left, min(left_here, LANES), wave)
            asked_here = int((part_of[asked] == part_of[goal]).sum())
            order, value = _solve(
                motion, law, near, tolerance, residual, is_asked, asked_here, wave
            )
            columns = [column_of[state] for state in near.tolist()]
            _put(order, np.array(columns), value, values)
            is_left[near] = False
    return values


@njit(nogil=True, cache=True)
def _put(order, columns, value, values):  # type: ignore[no-untyped-def]
    """Put rows into the order of the states, and lanes into their columns."""
    for row in range(order.shape[0]):
        for lane in range(columns.shape[0]):
            values[order[row], columns[lane]] = value[row, lane]


def _law(motion: Motion) -> Law:
    """How values follow from those of the neighbours."""
    chosen = motion.discount * (motion.success - motion.spread)
    other = motion.discount * motion.spread
    # Discounted probability that a straight move leads on and back; to each side, and nowhere, it
    # does with `other`.
    sides = 3 if len(motion.offsets) > 5 else 1
    onwards, back = chosen + sides * other, sides * other
    stays = other * (len(motion.offsets) - 2 * sides)
    step = 0.9  # what a straight move takes of h, far from everything
    for _ in range(100):
        step = onwards + back * step * step + stays * step
    decay = math.log(max(step, LEAST)) / STRAIGHT
    # Young's factor for a wave that runs straight on, far from everything. A little more was the
    # best in trials: over the first cells that count, distances shrink faster.
    radius = 2.0 * (math.sqrt(onwards * back) + other) / (1.0 - other)
    young = 2.0 / (1.0 + math.sqrt(max(0.0, 1.0 - radius * radius)))
    return Law(
        chosen=chosen,
        other=other,
        discount=motion.discount,
        fades=tuple(math.exp(decay * cost) for cost in motion.costs[1:]),
        omega=1.0 + _MORE * (young - 1.0),
    )


def _near(
    motion: Motion, goal: int, is_left: npt.NDArray[np.bool_], most: int, wave: Wave
) -> npt.NDArray[np.int64]:
    """A goal and those near it that are left, so many at most."""
    first = np.array([goal], dtype=np.int64)
    if most == 1:
        return first
    ways = motion.open_moves, motion.offsets, motion.costs
    reached = spread(*ways, first, is_left, most, 0, _TOGETHER, wave)
    order = wave.order[:reached]
    near = order[is_left[order]][:most].astype(np.int64)
    rest(wave, reached)
    return near


def _solve(
    motion: Motion,
    law: Law,
    goals: npt.NDArray[np.int64],
    tolerance: float,
    residual: float,
    is_asked: npt.NDArray[np.bool_],
    asked: int,
    wave: Wave,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """States (rows,) in the order of the wave, and h (rows, L) of each of the goals there.

    Args:
        motion, law: how the demonstrator moves, and what follows for values.
        goals: (1,) to (LANES,) state numbers, near each other.
        tolerance, residual: as above.
        is_asked: (S,) whether a state is asked for, and `asked` how many of this part of the map;
            0 for all.
        wave: one that is at rest, and will be again.
    """
    ways = motion.open_moves, motion.offsets, motion.costs
    lanes = np.arange(LANES if len(goals) > 1 else 1)
    goal_of_lane = goals[np.where(lanes < len(goals), lanes, 0)]
    margin = _MARGIN
    while True:
        reached = spread(*ways, goals, is_asked, asked, margin, EVERYWHERE, wave)
        order = wave.order[:reached].copy()
        rows = _Rows(
            neighbours_in_order(*ways[:2], order, wave.place),
            wave.cost[order],
            wave.place[goal_of_lane].astype(np.int64),
        )
        rest(wave, reached)
        value = np.zeros((reached + 1, len(lanes)))
        if rows.whole:
            _settle(law, rows, tolerance, residual, 0, value)
            return order, value[:-1]
        _settle(law, rows, tolerance / 2.0, 0.0, 0, value)
        rounding = FINEST * amplification(value[:-1].min(), law.discount)
        gap = _gap(law, rows, tolerance / 2.0, np.flatnonzero(is_asked[order]), value)
        if gap <= max(tolerance / 2.0, rounding):
            return order, value[:-1]
        margin += margin // 2


def _settle(
    law: Law,
    rows: _Rows,
    tolerance: float,
    residual: float,
    outer: int,
    value: npt.NDArray[np.float64],
) -> None:
    """Bring values (rows + 1, L) to h; the last row is kept, and the first `outer` are begun."""
    least = law.fades[0] ** (rows.distance[-1] / STRAIGHT)  # about that; the first is straight
    wanted = max(FINEST, residual, tolerance / amplification(least, law.discount))
    columns = rows.neighbours, rows.distance, rows.rows_of_goals
    settle(law, *columns, tolerance, residual, wanted, outer, value.reshape(-1))


def _gap(
    law: Law,
    rows: _Rows,
    tolerance: float,
    rows_asked: npt.NDArray[np.int64],
    value: npt.NDArray[np.float64],
) -> float:
    """By how much of itself h can be larger in some rows than where nothing lies farther out.

    Whoever leaves what was reached is so many moves away from every goal, at least: that bounds h
    there. Mostly a smaller M will do: if h is M outside, and then gamma h is at most M at the edge
    and so after every move from outside, M and that h satisfy h >= gamma max_a E[h] everywhere,
    and the true values are not above them.

    Args:
        law, rows: what was reached.
        tolerance: bound on the relative error of either bound.
        rows_asked: (U,).
        value: (rows + 1, L) h, where the last row, which is all that was not reached, is zero.
    """
    edge = (rows.neighbours == len(rows.distance)).any(axis=1)
    moves = math.ceil(rows.distance[-1] / DIAGONAL)
    farthest = law.discount**moves
    upper = value.copy()
    upper[-1] = np.minimum(_BEYOND * law.discount * value[:-1][edge].max(axis=0), farthest)
    _settle(law, rows, tolerance, 0.0, len(rows.distance), upper)
    at_edge = law.discount * upper[:-1][edge].max(axis=0)
    proved = (at_edge <= 0.99 * upper[-1]) | (upper[-1] == farthest)  # 0.01 for its own error
    if not proved.all():
        upper[-1] = np.where(proved, upper[-1], farthest)
        _settle(law, rows, tolerance, 0.0, len(rows.distance), upper)
    lower, upper = value[rows_asked], upper[rows_asked]
    return float(np.max(upper[lower > LEAST] / lower[lower > LEAST], initial=1.0)) - 1.0
