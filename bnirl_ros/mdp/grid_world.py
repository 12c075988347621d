"""A grid world: the special case of a finite MDP that a map gives, with fast goal values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.mdp.actions import ACTION_SETS, STEPS
from bnirl_ros.mdp.first_passage import Motion, first_passage_values
from bnirl_ros.mdp.parts import connected_parts
from bnirl_ros.mdp.process import first_passage_by_sweeps
from bnirl_ros.mdp.wave import DIAGONAL, STRAIGHT


@dataclass(frozen=True, eq=False)
class GridWorld:
    """A robot that moves over the free cells of a grid, now and then another way than it meant.

    A state is a cell, numbered `y * width + x`; blocked cells are states that never occur. Each
    action names a neighbouring cell (or the cell itself). A move that is blocked stays; a diagonal
    move is blocked also where either of the two cells beside it is. With probability `success` the
    outcome is the one of the chosen action; the remainder is spread evenly over the outcomes of
    the other actions.

    Attributes:
        free: (height, width) bool, indexed [y, x], y up.
        moves: 8, or 4 for no diagonals; staying is possible in both.
        success: probability that the chosen action happens, in (0, 1].
        discount: gamma of equation (1), in [0, 1).

    Raises:
        ValueError: a parameter is out of its range, or no cell is free.
    """

    free: npt.NDArray[np.bool_]
    moves: int = 8
    success: float = 0.7
    discount: float = 0.99

    def __post_init__(self) -> None:
        if self.free.ndim != 2 or not self.free.any():
            raise ValueError("free must be a (height, width) array with at least one free cell")
        if self.moves not in ACTION_SETS:
            raise ValueError(f"moves must be 4 or 8, not {self.moves}")
        if not 0.0 < self.success <= 1.0:
            raise ValueError(f"success must be above 0 and at most 1, not {self.success}")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount must be at least 0 and below 1, not {self.discount}")

    @property
    def actions(self) -> npt.NDArray[np.int64]:
        """Indices (A,) into `ACTION_NAMES` of the actions of this world, ascending."""
        return np.array(ACTION_SETS[self.moves], dtype=np.int64)

    @property
    def state_count(self) -> int:
        """Number of states: all cells, the blocked ones included."""
        return int(self.free.size)

    def states_of(self, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """State numbers (N,) of the cells (N, 2)."""
        cells = np.asarray(cells, dtype=np.int64).reshape(-1, 2)
        return cells[:, 1] * self.free.shape[1] + cells[:, 0]

    def cells_of(self, states: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Cells (N, 2) of the state numbers (N,)."""
        y, x = np.divmod(np.asarray(states, dtype=np.int64).reshape(-1), self.free.shape[1])
        return np.stack([x, y], axis=1)

    @cached_property
    def open_moves(self) -> npt.NDArray[np.uint16]:
        """(height, width) bit sets: bit k tells that action k of `actions` is not blocked."""
        height, width = self.free.shape
        around = np.pad(self.free, 1)

        def free_at(dx: int, dy: int) -> npt.NDArray[np.bool_]:
            return around[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

        bits = np.zeros(self.free.shape, dtype=np.uint16)
        for position, (dx, dy) in enumerate(STEPS[self.actions].tolist()):
            passable = self.free & free_at(dx, dy) & free_at(dx, 0) & free_at(0, dy)
            bits |= passable.astype(np.uint16) << np.uint16(position)
        return bits

    @cached_property
    def offsets(self) -> npt.NDArray[np.int64]:
        """(A,) what each action adds to the state number where it is not blocked."""
        steps = STEPS[self.actions]
        return steps[:, 1] * self.free.shape[1] + steps[:, 0]

    def same_action(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U, A) position of the first action that does the same: a blocked move stays.

        Staying is the first action of every set.
        """
        bits = self.open_moves.reshape(-1)[states]
        positions = np.arange(len(self.offsets))
        return np.where((bits[:, None] >> positions) & 1, positions, 0)

    def parts_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U,) number of the connected part of the free space in which each state lies."""
        return np.asarray(self._part_of_state[states], dtype=np.int64)

    @cached_property
    def _part_of_state(self) -> npt.NDArray[np.int32]:
        return np.asarray(connected_parts(self.free).reshape(-1))

    def places_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U, 2) where each state lies: its cell."""
        return self.cells_of(states)

    def outcomes(self) -> npt.NDArray[np.int64]:
        """(S, A) state to which each action leads from each state when it succeeds."""
        return self._outcomes_of(np.arange(self.state_count))

    def _outcomes_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U, A) the same from each of the states (U,)."""
        is_open = (self.open_moves.reshape(-1)[states, None] >> np.arange(len(self.offsets))) & 1
        return np.where(is_open, states[:, None] + self.offsets, states[:, None])

    def transitions(self) -> list[Any]:
        """Transition probabilities, an array (S, S) in compressed sparse rows for each action."""
        from scipy.sparse import csr_array  # here, since only this conversion needs it

        outcomes = self.outcomes()
        state_count, action_count = outcomes.shape
        rows = np.repeat(np.arange(state_count), action_count)
        spread = (1.0 - self.success) / (action_count - 1)
        layers = []
        for action in range(action_count):
            weights = np.full((state_count, action_count), spread)
            weights[:, action] = self.success
            entries = (weights.reshape(-1), (rows, outcomes.reshape(-1)))
            layers.append(csr_array(entries, shape=(state_count, state_count)))
        return layers

    @property
    def _motion(self) -> tuple[Any, ...]:
        """What the kernels take of the world."""
        spread = (1.0 - self.success) / (len(self.offsets) - 1)
        return self.open_moves, self.offsets, self.success, spread

    def solve(
        self,
        rewards: npt.NDArray[np.float64],
        goals: npt.NDArray[np.int64],
        tolerance: float,
        values: npt.NDArray[np.float64],
    ) -> None:
        """See `bnirl_ros.mdp.process.MarkovDecisionProcess.solve`."""
        _solve(*self._motion, self.discount, rewards, goals, tolerance, values)

    def first_passage(
        self,
        goals: npt.NDArray[np.int64],
        tolerance: float,
        residual: float = 0.0,
        states: npt.NDArray[np.int64] | None = None,
    ) -> npt.NDArray[np.float64]:
        """See `bnirl_ros.mdp.process.MarkovDecisionProcess.first_passage`.

        The bound is on the relative error, unless an action leads elsewhere more often than where
        it is meant to. Of a large map only that part is solved which decides about `states` and
        the states around them and the goals; the other values are zero.
        """
        open_moves, offsets, success, spread = self._motion
        if success <= spread or self.discount == 0.0:
            return first_passage_by_sweeps(self, goals, tolerance)
        is_diagonal = STEPS[self.actions].all(axis=1)
        motion = Motion(
            open_moves=open_moves.reshape(-1),
            offsets=tuple(offsets.tolist()),
            costs=tuple(np.where(is_diagonal, DIAGONAL, STRAIGHT).tolist()),
            success=success,
            spread=spread,
            discount=self.discount,
        )
        asked = np.zeros(0, dtype=np.int64)
        if states is not None:
            asked = np.unique(self._outcomes_of(np.concatenate([states, goals])))
        each, column_of = np.unique(goals, return_inverse=True)
        values = first_passage_values(
            motion, each, tolerance, residual, asked, self._part_of_state
        )
        return values if np.array_equal(each, goals) else values[:, column_of]

    def expected_values(
        self, values: npt.NDArray[np.float64], states: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """(U, A, L) the mean of values (S, L) after each action in each of the states (U,)."""
        return _expected_values(*self._motion, values, states)


@njit(nogil=True, cache=True)
def _solve(open_moves, offsets, success, spread, discount, rewards, goals, tolerance, values):  # type: ignore[no-untyped-def]
    """Values (S, L) of V(s) = R(s) + gamma max_a E[V(s')], but for V(goals[l]), which is kept.

    With a goal, no reward and V(goal) = 1 they are the discounted first-passage values h of the
    goal. Without any (-1) they are V*.

    Gauss-Seidel value iteration, all lanes in the innermost loop, the cells in four alternating
    orders so that a wave is carried along whichever way it runs. A sweep is a contraction by
    gamma, so a largest change d leaves an error of at most d gamma / (1 - gamma). Ends when that
    is within `tolerance`, or where float64 resolves no more.

    The mean over the outcomes n_b of action a is (success - spread) n_a + spread sum_b n_b. Rows
    of `rewards`: one for each state, or a single one for all.
    """
    height, width = open_moves.shape
    lanes = goals.shape[0]
    advantage = success - spread
    same_reward = rewards.shape[0] == 1
    total = np.empty(lanes)
    best = np.empty(lanes)
    sweep = 0
    finest = 4e-16 * max(1.0, np.abs(rewards).max() / (1.0 - discount))
    largest_change = 0.0
    while sweep == 0 or largest_change * discount > max(tolerance * (1.0 - discount), finest):
        largest_change = 0.0
        for row in range(height):
            y = row if sweep & 2 == 0 else height - 1 - row
            for column in range(width):
                x = column if sweep & 1 == 0 else width - 1 - column
                bits = open_moves[y, x]
                if bits == 0:  # a blocked cell; in a free one, staying is always open
                    continue
                state = y * width + x
                reward = rewards[0 if same_reward else state]
                total[:] = 0.0
                best[:] = -np.inf
                for action in range(offsets.shape[0]):
                    outcome = state + offsets[action] if (bits >> action) & 1 else state
                    for lane in range(lanes):
                        value = values[outcome, lane]
                        total[lane] += value
                        best[lane] = max(best[lane], advantage * value)
                for lane in range(lanes):
                    if state != goals[lane]:
                        value = reward[lane] + discount * (best[lane] + spread * total[lane])
                        largest_change = max(largest_change, abs(value - values[state, lane]))
                        values[state, lane] = value
        sweep += 1


@njit(nogil=True, cache=True)
def _expected_values(open_moves, offsets, success, spread, values, states):  # type: ignore[no-untyped-def]
    """(U, A, L) the mean of values (S, L) after each action in each of the states (U,)."""
    bits = open_moves.reshape(-1)
    action_count = offsets.shape[0]
    lanes = values.shape[1]
    expected = np.empty((states.shape[0], action_count, lanes))
    for index in range(states.shape[0]):
        state = states[index]
        for lane in range(lanes):
            total = 0.0
            for action in range(action_count):
                outcome = state + offsets[action] if (bits[state] >> action) & 1 else state
                expected[index, action, lane] = values[outcome, lane]
                total += values[outcome, lane]
            for action in range(action_count):
                mean = (success - spread) * expected[index, action, lane] + spread * total
                expected[index, action, lane] = mean
    return expected
