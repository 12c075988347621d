"""The interface of a Markov decision process without reward, of whatever kind."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

TOLERANCE = 1e-8
"""Default bound on the error of values; those of a goal reach from 0 to 1 / (1 - discount)."""


class MarkovDecisionProcess(Protocol):
    """What the method needs of an MDP without reward.

    That is a discount, the values of goals and of rewards, which actions do the same, which states
    lie in parts between which there is no way, and which lie near each other.
    """

    @property
    def discount(self) -> float: ...

    @property
    def actions(self) -> npt.NDArray[np.int64]: ...

    @property
    def state_count(self) -> int: ...

    def goal_values_of(
        self, goals: npt.NDArray[np.int64], states: npt.NDArray[np.int64], tolerance: float
    ) -> npt.NDArray[np.float64]: ...

    def optimal_values_of(
        self,
        rewards: npt.NDArray[np.float64],
        start: npt.NDArray[np.float64],
        tolerance: float,
    ) -> npt.NDArray[np.float64]: ...

    def action_values_of(
        self,
        rewards: npt.NDArray[np.float64],
        values: npt.NDArray[np.float64],
        states: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.float64]: ...

    def same_action(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...

    def parts_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...

    def places_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...


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
