"""The interface of a Markov decision process without reward, of whatever kind."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

TOLERANCE = 1e-8
"""Default bound on the error of values; those of a goal reach from 0 to 1 / (1 - discount)."""


class MarkovDecisionProcess(Protocol):
    """What the method needs of an MDP without reward.

    That is a discount, the fixed point of Bellman's equation and means after actions, the
    transition probabilities, which actions do the same, which states lie in parts between which
    there is no way, and which lie near each other.
    """

    @property
    def discount(self) -> float: ...

    @property
    def actions(self) -> npt.NDArray[np.int64]: ...

    @property
    def state_count(self) -> int: ...

    def solve(
        self,
        rewards: npt.NDArray[np.float64],
        goals: npt.NDArray[np.int64],
        tolerance: float,
        values: npt.NDArray[np.float64],
    ) -> None:
        """Bring values (S, L) to V(s) = R(s) + gamma max_a E[V(s')], but for V(goals[l]).

        Args:
            rewards: (S, L), or (1, L) for the same reward in all states.
            goals: (L,) state whose value is kept, in each lane; -1 for none.
            tolerance: bound on the absolute error.
            values: where to begin, and the result.
        """

    def first_passage(
        self,
        goals: npt.NDArray[np.int64],
        tolerance: float,
        residual: float = 0.0,
        states: npt.NDArray[np.int64] | None = None,
    ) -> npt.NDArray[np.float64]:
        """(S, L) discounted first-passage values of the goals (L,).

        h(g) = 1 and h(s) = gamma max_a E[h(s')]: the mean of gamma ** steps on the best way.

        Args:
            goals: state numbers.
            tolerance: bound on the error.
            residual: it is enough, too, that no value differs from gamma max_a E[h] by a larger
                part of itself than this.
            states: (U,) those from which the values after all actions are to be right, as from
                the goals; by default all.
        """
        ...

    def expected_values(
        self, values: npt.NDArray[np.float64], states: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """(U, A, L) the mean of values (S, L) after each action in each of the states (U,)."""
        ...

    def transitions(self) -> list[Any]: ...

    def same_action(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...

    def parts_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...

    def places_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...


def first_passage_by_sweeps(
    mdp: MarkovDecisionProcess, goals: npt.NDArray[np.int64], tolerance: float
) -> npt.NDArray[np.float64]:
    """First-passage values (S, L) of any MDP, with a bound on the absolute error."""
    values = np.zeros((mdp.state_count, len(goals)))
    values[goals, np.arange(len(goals))] = 1.0
    mdp.solve(np.zeros((1, len(goals))), goals, tolerance, values)
    return values


def checked_states(
    mdp: MarkovDecisionProcess, states: npt.ArrayLike, what: str
) -> npt.NDArray[np.int64]:
    """State numbers (U,).

    Raises:
        ValueError: one of them, which the sentence calls `what`, is none of the MDP's.
    """
    numbers = np.asarray(states, dtype=np.int64).reshape(-1)
    if numbers.size and (numbers.min() < 0 or numbers.max() >= mdp.state_count):
        raise ValueError(f"a {what} lies outside the {mdp.state_count} states of the MDP")
    return numbers
