"""Goal values Q* for many goals at once, of any MDP, on as many cores as there are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.process import TOLERANCE, MarkovDecisionProcess, checked_states
from bnirl_ros.mdp.reward_values import action_values, optimal_values
from bnirl_ros.threads import workers

_GOALS_AT_ONCE = 16  # lanes: enough to fill the vector units, few enough to stay in the caches


def goal_values(
    mdp: MarkovDecisionProcess,
    goals: npt.ArrayLike | Goals,
    states: npt.ArrayLike,
    tolerance: float = TOLERANCE,
) -> npt.NDArray[np.float64]:
    """Optimal action values Q*(s, a, R_g) of each goal g, its reward (6) or (20) with c = 1.

    The goal does not absorb: the demonstrator may stay there and goes on collecting. For a goal
    that is a single state, V_g(s) = h_g(s) V_g(g) with the discounted first-passage value h_g,
    h_g(g) = 1: one fixed point with a boundary value, then one scalar. For a larger goal that does
    not hold, and V = R + gamma max Q itself is solved. Memory is that of a few goals' values on
    the whole map, and of the result.

    Args:
        mdp: a `GridWorld` or a `FiniteMDP`.
        goals: the goals, or (G,) state numbers of goals of one state each.
        states: (U,) state numbers at which the values are wanted.
        tolerance: bound on the absolute error of the result. On a map the error of h is as much
            smaller as h itself: far away the ratios of values are as good as near the goal.

    Returns:
        (U, A, G) float64; equal over a where g cannot be reached from s.

    Raises:
        ValueError: a state or goal is none of the MDP's.
    """
    all_goals = goals if isinstance(goals, Goals) else Goals.of_states(goals)
    checked_states(mdp, all_goals.states, "goal")
    observed = checked_states(mdp, states, "state")
    # With V(g) <= 1 / (1 - gamma), dQ <= V(g) dh + V(g)^2 dh: so an error dh of h is allowed. And
    # if gamma max_a E[h] differs from h by r, R + gamma max_a E[V] differs from V by V(g) r.
    residual = tolerance * (1.0 - mdp.discount) ** 2
    first_passage_tolerance = residual / (2.0 - mdp.discount)
    values = np.empty((len(observed), len(mdp.actions), len(all_goals)))

    def solve(batch: npt.NDArray[np.int64]) -> None:
        if all_goals.sizes[batch[0]] == 1:
            single = all_goals.states[all_goals.first[batch]]
            values[:, :, batch] = _of_single_states(
                mdp, single, observed, first_passage_tolerance, residual
            )
        else:
            rewards = all_goals.rewards(batch, mdp.state_count)
            of_state = optimal_values(mdp, rewards, tolerance)
            values[:, :, batch] = action_values(mdp, rewards, of_state, observed)

    single = np.flatnonzero(all_goals.sizes == 1)
    places = mdp.places_of(all_goals.states[all_goals.first[single]])
    several = np.flatnonzero(all_goals.sizes > 1)
    batches = [single[near] for near in _near_together(places)]
    batches += np.split(several, range(_GOALS_AT_ONCE, len(several), _GOALS_AT_ONCE))
    batches = [batch for batch in batches if len(batch)]
    with workers(len(batches)) as threads:
        try:
            list(threads.map(solve, batches))
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)  # Ctrl-C waits for one batch only
            raise
    return values


def _of_single_states(
    mdp: MarkovDecisionProcess,
    goals: npt.NDArray[np.int64],
    states: npt.NDArray[np.int64],
    tolerance: float,
    residual: float,
) -> npt.NDArray[np.float64]:
    """Q* (U, A, L): V_g = h_g V_g(g), where V_g(g) = 1 + gamma V_g(g) max_a E[h_g]."""
    lanes = np.arange(len(goals))
    first_passage = mdp.first_passage(goals, tolerance, residual, states)
    from_goal = mdp.expected_values(first_passage, goals)[lanes, :, lanes].max(axis=1)
    goal_value = 1.0 / (1.0 - mdp.discount * from_goal)
    reward = (states[:, np.newaxis] == goals).astype(np.float64)
    expected = mdp.expected_values(first_passage, states)
    return np.asarray(reward[:, np.newaxis] + mdp.discount * goal_value * expected)


def _near_together(places: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Indices of places (N, 2) in groups that can be solved at once, each of near ones."""
    groups, whole = [], [np.arange(len(places))]
    while whole:
        group = whole.pop()
        if len(group) <= _GOALS_AT_ONCE:
            groups.append(group)
            continue
        extent = np.ptp(places[group], axis=0)
        group = group[np.argsort(places[group, extent.argmax()], kind="stable")]
        middle = -(-len(group) // (2 * _GOALS_AT_ONCE)) * _GOALS_AT_ONCE
        whole += [group[:middle], group[middle:]]
    return groups
