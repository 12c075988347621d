"""A general finite MDP: any transition probabilities, as sparse as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.mdp.process import first_passage_by_sweeps


@dataclass(frozen=True, eq=False)
class FiniteMDP:
    """A finite MDP without reward: the transition function T of section 2.1, and the discount.

    Build one with `FiniteMDP.from_transitions`. The fields are the rows T(s, a, .) in compressed
    form: row a S + s holds `successors` and `probabilities` from `row_starts[a S + s]` on.

    Attributes:
        row_starts: (A S + 1,) int64.
        successors: (Z,) int64 state numbers.
        probabilities: (Z,) float64, above 0.
        action_count: number of actions A.
        discount: gamma of equation (1), in [0, 1).
    """

    row_starts: npt.NDArray[np.int64]
    successors: npt.NDArray[np.int64]
    probabilities: npt.NDArray[np.float64]
    action_count: int
    discount: float

    @classmethod
    def from_transitions(cls, transitions: Any, discount: float) -> FiniteMDP:
        """From transition probabilities of shape (A, S, S), indexed [action, state, next state].

        Args:
            transitions: a three-dimensional scipy sparse array, a numpy array, or a sequence of A
                sparse or dense arrays (S, S).
            discount: gamma, in [0, 1).

        Raises:
            ValueError: the shape is no (A, S, S), a probability is negative or not finite, or
                those of a state and action do not sum to one within 1e-9.
        """
        if not 0.0 <= discount < 1.0:
            raise ValueError(f"discount must be at least 0 and below 1, not {discount}")
        row, column, probability, (action_count, state_count) = _coordinates(transitions)
        if not np.all(np.isfinite(probability) & (probability >= 0.0)):
            raise ValueError("transition probabilities must be finite and not negative")
        sums = np.bincount(row, weights=probability, minlength=action_count * state_count)
        if np.abs(sums - 1.0).max(initial=0.0) > 1e-9:
            action, state = divmod(int(np.abs(sums - 1.0).argmax()), state_count)
            raise ValueError(
                f"transition probabilities of action {action} in state {state} "
                f"sum to {sums[action * state_count + state]:g}, not to 1"
            )
        occurs = probability > 0.0
        order = np.lexsort((column[occurs], row[occurs]))
        counts = np.bincount(row[occurs], minlength=action_count * state_count)
        return cls(
            row_starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            successors=column[occurs][order].astype(np.int64),
            probabilities=probability[occurs][order].astype(np.float64),
            action_count=action_count,
            discount=discount,
        )

    @property
    def actions(self) -> npt.NDArray[np.int64]:
        """Indices (A,) of the actions: simply 0 to A - 1."""
        return np.arange(self.action_count)

    @property
    def state_count(self) -> int:
        """Number of states S."""
        return (len(self.row_starts) - 1) // self.action_count

    def same_action(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U, A) the first action with the same outcomes and, but for rounding, probabilities."""
        same = np.empty((len(states), self.action_count), dtype=np.int64)
        for index, state in enumerate(states):
            first: dict[bytes, int] = {}
            for action in self.actions:
                row = slice(*self.row_starts[action * self.state_count + state :][:2])
                outcomes, entry = np.unique(self.successors[row], return_inverse=True)
                # Sums of the same shares in another order differ in their last bits.
                shares = np.round(np.bincount(entry, self.probabilities[row]), 12)
                key = outcomes.tobytes() + shares.tobytes()
                same[index, action] = first.setdefault(key, int(action))
        return same

    def parts_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U,) number of the part in which each state lies: transitions tie all into one."""
        return np.zeros(len(states), dtype=np.int64)

    def places_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(U, 2) where each state lies: nobody knows, so far away from every other."""
        return np.stack([1000 * states, np.zeros_like(states)], axis=1)

    def transitions(self) -> list[Any]:
        """Transition probabilities, an array (S, S) in compressed sparse rows for each action."""
        from scipy.sparse import csr_array  # here, since only this conversion needs it

        rows = csr_array(
            (self.probabilities, self.successors, self.row_starts),
            shape=(self.action_count * self.state_count, self.state_count),
        )
        return [rows[action * self.state_count :][: self.state_count] for action in self.actions]

    @property
    def _motion(self) -> tuple[Any, ...]:
        """What the kernels take of the process."""
        return self.row_starts, self.successors, self.probabilities, self.action_count

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
        """See `bnirl_ros.mdp.process.MarkovDecisionProcess.first_passage`."""
        return first_passage_by_sweeps(self, goals, tolerance)

    def expected_values(
        self, values: npt.NDArray[np.float64], states: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """(U, A, L) the mean of values (S, L) after each action in each of the states (U,)."""
        return _expected_values(*self._motion, values, states)


_Coordinates = tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], tuple[int, int]]


def _coordinates(transitions: Any) -> _Coordinates:
    """Row a S + s, next state, probability of each entry, and (A, S)."""
    shape = getattr(transitions, "shape", None)
    if shape is not None and len(shape) == 3:
        if hasattr(transitions, "tocoo"):
            entries = transitions.tocoo()
            (action, state, column), probability = entries.coords, entries.data
        else:
            dense = np.asarray(transitions, dtype=np.float64)
            action, state, column = np.nonzero(dense)
            probability = dense[action, state, column]
    elif isinstance(transitions, Sequence) and len({m.shape for m in transitions}) == 1:
        shape = (len(transitions), *transitions[0].shape)
        layers = [m.tocoo() if hasattr(m, "tocoo") else _DenseEntries(m) for m in transitions]
        action = np.repeat(np.arange(len(layers)), [len(layer.data) for layer in layers])
        state = np.concatenate([layer.row for layer in layers])
        column = np.concatenate([layer.col for layer in layers])
        probability = np.concatenate([layer.data for layer in layers])
    else:
        shape = ()
    if len(shape) != 3 or shape[1] != shape[2] or 0 in shape:
        raise ValueError("transitions must have the shape (A, S, S)")
    row = action.astype(np.int64) * shape[1] + state
    return row, column, np.asarray(probability, dtype=np.float64), (int(shape[0]), int(shape[1]))


class _DenseEntries:
    """The entries of a dense matrix under the names that scipy's COO arrays have."""

    def __init__(self, matrix: npt.ArrayLike) -> None:
        dense = np.asarray(matrix, dtype=np.float64)
        self.row, self.col = np.nonzero(dense)
        self.data = dense[self.row, self.col]


@njit(nogil=True, cache=True)
def _solve(  # type: ignore[no-untyped-def]
    row_starts,
    successors,
    probabilities,
    action_count,
    discount,
    rewards,
    goals,
    tolerance,
    values,
):
    """As the grid world's: Gauss-Seidel value iteration, the states forth and back in turn."""
    state_count = (row_starts.shape[0] - 1) // action_count
    lanes = goals.shape[0]
    same_reward = rewards.shape[0] == 1
    mean = np.empty(lanes)
    best = np.empty(lanes)
    sweep = 0
    finest = 4e-16 * max(1.0, np.abs(rewards).max() / (1.0 - discount))
    largest_change = 0.0
    while sweep == 0 or largest_change * discount > max(tolerance * (1.0 - discount), finest):
        largest_change = 0.0
        for step in range(state_count):
            state = step if sweep & 1 == 0 else state_count - 1 - step
            reward = rewards[0 if same_reward else state]
            best[:] = -np.inf
            for action in range(action_count):
                row = action * state_count + state
                mean[:] = 0.0
                for entry in range(row_starts[row], row_starts[row + 1]):
                    for lane in range(lanes):
                        mean[lane] += probabilities[entry] * values[successors[entry], lane]
                for lane in range(lanes):
                    best[lane] = max(best[lane], mean[lane])
            for lane in range(lanes):
                if state != goals[lane]:
                    value = reward[lane] + discount * best[lane]
                    largest_change = max(largest_change, abs(value - values[state, lane]))
                    values[state, lane] = value
        sweep += 1


@njit(nogil=True, cache=True)
def _expected_values(  # type: ignore[no-untyped-def]
    row_starts, successors, probabilities, action_count, values, states
):
    """(U, A, L) the mean of values (S, L) after each action in each of the states (U,)."""
    state_count = (row_starts.shape[0] - 1) // action_count
    lanes = values.shape[1]
    expected = np.zeros((states.shape[0], action_count, lanes))
    for index in range(states.shape[0]):
        for action in range(action_count):
            row = action * state_count + states[index]
            for entry in range(row_starts[row], row_starts[row + 1]):
                for lane in range(lanes):
                    mean = probabilities[entry] * values[successors[entry], lane]
                    expected[index, action, lane] += mean
    return expected
