"""Goal values Q* for many goals at once, of any MDP, on as many cores as there are."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import numpy as np
import numpy.typing as npt

TOLERANCE = 1e-8
"""Default bound on the error of Q*; the values themselves reach from 0 to 1 / (1 - discount)."""

_GOALS_AT_ONCE = 16  # lanes: enough to fill the vector units, few enough to stay in the caches


class MarkovDecisionProcess(Protocol):
    """What the method needs of an MDP without reward.

    That is a discount, the values of goals, which actions do the same, which states lie in parts
    between which there is no way, and which lie near each other.
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

    def same_action(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...

    def parts_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...

    def places_of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]: ...


def goal_values(
    mdp: MarkovDecisionProcess,
    goals: npt.ArrayLike,
    states: npt.ArrayLike,
    tolerance: float = TOLERANCE,
) -> npt.NDArray[np.float64]:
    """Optimal action values Q*(s, a, R_g) of each goal g, with reward 1 at g (c = 1 in (6)).

    The goal does not absorb: the demonstrator may stay there and goes on collecting. For a goal
    that is a single state, V_g(s) = h_g(s) V_g(g) with the discounted first-passage value h_g,
    h_g(g) = 1: one fixed point with a boundary value, then one scalar. Memory is that of a few
    goals' values on the whole map, and of the result.

    Args:
        mdp: a `GridWorld` or a `FiniteMDP`.
        goals: (G,) state numbers.
        states: (U,) state numbers at which the values are wanted.
        tolerance: bound on the absolute error of the result.

    Returns:
        (U, A, G) float64; equal over a where g cannot be reached from s.

    Raises:
        ValueError: a state or goal is none of the MDP's.
    """
    goal_states = _checked(mdp, goals, "goal")
    observed_states = _checked(mdp, states, "state")
    # dQ <= V(g) dh + V(g)^2 dh with V(g) <= 1 / (1 - gamma): so an error dh of h is allowed.
    first_passage_tolerance = tolerance * (1.0 - mdp.discount) ** 2 / (2.0 - mdp.discount)
    values = np.empty((len(observed_states), len(mdp.actions), len(goal_states)))

    def solve(start: int) -> None:
        batch = slice(start, start + _GOALS_AT_ONCE)
        values[:, :, batch] = mdp.goal_values_of(
            goal_states[batch], observed_states, first_passage_tolerance
        )

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        try:
            list(threads.map(solve, range(0, len(goal_states), _GOALS_AT_ONCE)))
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)  # Ctrl-C waits for one batch only
            raise
    return values


def _checked(
    mdp: MarkovDecisionProcess, states: npt.ArrayLike, what: str
) -> npt.NDArray[np.int64]:
    numbers = np.asarray(states, dtype=np.int64).reshape(-1)
    if numbers.size and (numbers.min() < 0 or numbers.max() >= mdp.state_count):
        raise ValueError(f"a {what} lies outside the {mdp.state_count} states of the MDP")
    return numbers
