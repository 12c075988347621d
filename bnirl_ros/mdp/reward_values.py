"""Values of any rewards of the states, of several reward functions at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.mdp.process import TOLERANCE, MarkovDecisionProcess, checked_states


def optimal_values(
    mdp: MarkovDecisionProcess,
    rewards: npt.NDArray[np.float64],
    tolerance: float = TOLERANCE,
    start: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.float64]:
    """Optimal values V*(s, R) of several rewards: V = R + gamma max_a E[V], equations (1) to (3).

    Args:
        mdp: a `GridWorld` or a `FiniteMDP`.
        rewards: (S, L) float64 reward R(s) of each state, a column for each reward function.
        tolerance: bound on the absolute error of the result; what float64 does not resolve of the
            largest value comes on top.
        start: (S, L) values to begin from, such as those of rewards that differ little; where
            they are near, there is little to do.

    Returns:
        (S, L) float64; in blocked cells of a grid world, which are states that never occur, those
        of `start`.

    Raises:
        ValueError: a shape is not (S, L).
    """
    given = np.ascontiguousarray(rewards, dtype=np.float64)
    values = np.zeros_like(given) if start is None else np.array(start, dtype=np.float64)
    if given.ndim != 2 or len(given) != mdp.state_count or values.shape != given.shape:
        raise ValueError(f"rewards and start must both be ({mdp.state_count}, L)")
    mdp.solve(given, np.full(given.shape[1], -1), tolerance, values)
    return values


def action_values(
    mdp: MarkovDecisionProcess,
    rewards: npt.NDArray[np.float64],
    values: npt.NDArray[np.float64],
    states: npt.ArrayLike,
) -> npt.NDArray[np.float64]:
    """Q(s, a, R) (U, A, L) of state values (S, L) under rewards (S, L), at the states (U,)."""
    at = checked_states(mdp, states, "state")
    return rewards[at, np.newaxis] + mdp.discount * mdp.expected_values(values, at)
