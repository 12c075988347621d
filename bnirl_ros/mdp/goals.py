"""Goals: sets of states that are rewarded together, most often of one state each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Goals:
    """G goals: the state subgoals of Definition 1 and the feature subgoals of Definition 3.

    Build them with `Goals.of_states` or `Goals.of_sets`.

    Attributes:
        first: (G + 1,) int64; goal g is `states[first[g] : first[g + 1]]`, never empty.
        states: (M,) int64 state numbers, ascending within a goal.
    """

    first: npt.NDArray[np.int64]
    states: npt.NDArray[np.int64]

    @classmethod
    def of_states(cls, states: npt.ArrayLike) -> Goals:
        """A goal of one state each for the states (G,)."""
        numbers = np.asarray(states, dtype=np.int64).reshape(-1)
        return cls(np.arange(len(numbers) + 1), numbers)

    @classmethod
    def of_sets(cls, sets: Iterable[npt.ArrayLike]) -> Goals:
        """A goal for each set of states.

        Raises:
            ValueError: a set is empty.
        """
        members = [np.unique(np.asarray(states, dtype=np.int64)) for states in sets]
        if any(len(states) == 0 for states in members):
            raise ValueError("a goal must have at least one state")
        first = np.cumsum([0, *(len(states) for states in members)])
        return cls(first, np.concatenate([np.empty(0, dtype=np.int64), *members]))

    def __len__(self) -> int:
        return len(self.first) - 1

    def __getitem__(self, goal: int) -> npt.NDArray[np.int64]:
        """The states of one goal."""
        return self.states[self.first[goal] : self.first[goal + 1]]

    @cached_property
    def sizes(self) -> npt.NDArray[np.int64]:
        """(G,) number of states of each goal."""
        return np.diff(self.first)

    @cached_property
    def goal_of(self) -> npt.NDArray[np.int64]:
        """(M,) goal to which each of `states` belongs."""
        return np.repeat(np.arange(len(self)), self.sizes)

    def hold(self, states: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """(U, G) whether each of the states (U,) is one of each goal's."""
        distinct, row_of = np.unique(np.asarray(states, dtype=np.int64), return_inverse=True)
        held = np.zeros((len(distinct), len(self)), dtype=np.bool_)
        if len(distinct):
            rows = np.minimum(np.searchsorted(distinct, self.states), len(distinct) - 1)
            same = distinct[rows] == self.states
            held[rows[same], self.goal_of[same]] = True
        return np.asarray(held[row_of])

    def rewards(self, goals: npt.ArrayLike, state_count: int) -> npt.NDArray[np.float64]:
        """(S, L) the rewards (20) of some of the goals, with c = 1."""
        chosen = np.asarray(goals, dtype=np.int64)
        result = np.zeros((state_count, len(chosen)))
        for lane, goal in enumerate(chosen):
            result[self[goal], lane] = 1.0
        return result
