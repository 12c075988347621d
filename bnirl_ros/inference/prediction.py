"""Which action comes next (section 3.4): equation (19), and the full posterior predictive.

Both foresee every action of a demonstration that the posterior does not know, from the actions
before it in its episode. The predictive averages over subgoals and draws; equation (19) decides on
one subgoal and takes its policy, so it is sure of itself where it should not be. Which of them
foresees better is measured in docs/inference.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.filtering import evenly_spaced_draws, foreseen, middle_of_draws
from bnirl_ros.inference.posterior import Posterior, grid_world, pursuit_model_of
from bnirl_ros.inference.pursuit_gibbs import LEAST_PROBABILITY
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.likelihood import action_log_likelihood
from bnirl_ros.model.pursuits import PursuitModel

NEW_SUBGOAL = -1
"""In the place of a candidate: a partition that no observation is in, so no subgoal is known."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a demonstrator is expected to do, at each of N observations, before it is seen.

    Actions that do the same, such as blocked moves and staying, are equally probable: what is
    known is the probability of what they do, and they share it evenly.

    Attributes:
        actions: (A,) int64 indices into `ACTION_NAMES`: what the columns stand for.
        probability: (N, A) of each action; each row sums to one.
        same: (N, A) int64 column of the first action that does the same.
        subgoal: (N,) int64 candidate index of the subgoal that it most probably pursues there;
            `NEW_SUBGOAL` where (19) chooses a new partition.
        subgoal_probability: (N,) how probably.
    """

    actions: npt.NDArray[np.int64]
    probability: npt.NDArray[np.float64]
    same: npt.NDArray[np.int64]
    subgoal: npt.NDArray[np.int64]
    subgoal_probability: npt.NDArray[np.float64]

    @property
    def most_probable(self) -> npt.NDArray[np.int64]:
        """(N,) index into `ACTION_NAMES` of the first action that does what is most probable."""
        return self.actions[by_outcome(self.probability, self.same).argmax(axis=1)]


def predict(posterior: Posterior, demonstration: Demonstration, grid_map: GridMap) -> Prediction:
    """The posterior predictive P(action t | actions before t in its episode) of a demonstration.

    Averaged over subgoals and draws of the posterior, which knows nothing of that demonstration.
    To the paper's model observations are exchangeable: the subgoal of the next one is g with the
    urn's probability (n_g + eta P(g)) / (N + eta), whatever the state and the episode's history,
    averaged over all draws; its action then comes from (7). The sequential model filters the
    episode so far, in 64 evenly spaced draws; slips are included.

    Args:
        posterior: of either model, with cells or features as candidates.
        demonstration: N observations in free cells of the map. The last one of an episode may have
            any action: what is foreseen there does not depend on it.
        grid_map: the map on which the posterior was inferred.

    Raises:
        InputError: a cell is not free or an action not one of the posterior's, or, for the
            sequential model, no candidate can be reached from a cell.
    """
    world = grid_world(grid_map, posterior.settings)
    _check(demonstration, grid_map, world)
    if posterior.settings.model == "sequential":
        _, probability, subgoals = _in_sequence(posterior, demonstration, grid_map)
        subgoal, likeliest = subgoals.argmax(axis=1), subgoals.max(axis=1)
    else:
        weights, count = _urn_weights(posterior), len(demonstration)
        probability = _mean_policy(posterior, demonstration, world, weights)
        subgoal, likeliest = np.full(count, weights.argmax()), np.full(count, weights.max())
    return _prediction(world, demonstration, probability, subgoal, likeliest)


def predict_from_mode(
    posterior: Posterior, demonstration: Demonstration, grid_map: GridMap
) -> Prediction:
    """Equation (19): the most likely subgoal before the action is seen, then its policy (7).

    For the paper's model, z_k is the most likely partition of an observation in s_k, marginalised
    over its action. By (11) to (14) that is the sum over a of P(z_k | z_-k) P(a | s_k, g_zk), and
    the policy of every subgoal sums to one: what is left are the weights of the Chinese restaurant
    process (5), n_j for a partition and eta for a new one. So z_k is the largest partition of the
    mode, whatever the state. Where eta exceeds its size it is a new one, whose subgoal is still a
    draw from P(g), and its policy the mean over P(g). The mode is `Posterior.mode`, which
    coordinate ascent reaches from the best draw of each chain; the paper's is the best of its
    samples, which lies below that.

    For the sequential model the most likely subgoal is that of the filter, given the actions
    before it in its episode; where there are none, the most likely next pursuit. Parameters and
    weights are the posterior's medians and means, and the policy has its slips.

    Args:
        posterior, demonstration, grid_map: as in `predict`.

    Raises:
        InputError: as in `predict`.
    """
    world = grid_world(grid_map, posterior.settings)
    _check(demonstration, grid_map, world)
    count, candidates = len(demonstration), len(posterior.candidates)
    if posterior.settings.model == "sequential":
        weights, parameters = middle_of_draws(posterior)
        model = _watched(posterior, demonstration, grid_map)
        subgoals = foreseen(model, weights, parameters)
        subgoal, likeliest = subgoals.argmax(axis=1), subgoals.max(axis=1)
        probability = model.action_likelihood(parameters)[model.state_of, :, subgoal]
    else:
        chosen, share = _most_likely_partition(posterior)
        weights = np.full(candidates, 1.0 / candidates)  # P(g)
        if chosen != NEW_SUBGOAL:
            weights = np.eye(candidates)[chosen]
        probability = _mean_policy(posterior, demonstration, world, weights)
        subgoal, likeliest = np.full(count, chosen), np.full(count, share)
    return _prediction(world, demonstration, probability, subgoal, likeliest)


def predict_at(posterior: Posterior, cells: npt.ArrayLike, grid_map: GridMap) -> Prediction:
    """What someone does who begins in each of the cells (U, 2): `predict` without a history.

    Raises:
        InputError: as in `predict`.
    """
    return predict(posterior, beginning_in(cells), grid_map)


def beginning_in(cells: npt.ArrayLike) -> Demonstration:
    """An episode of one observation in each of the cells (U, 2), for what is foreseen there.

    What is done there, staying, does not count: it is what is foreseen.
    """
    places = np.asarray(cells, dtype=np.int64).reshape(-1, 2)
    return Demonstration(
        episode=np.arange(len(places)),
        cells=places,
        action=np.zeros(len(places), dtype=np.int64),
        last_episode=np.empty(0, dtype=np.int64),
        last_cells=np.empty((0, 2), dtype=np.int64),
    )


def log_predictive(
    posterior: Posterior, held_out: Demonstration, grid_map: GridMap
) -> npt.NDArray[np.float64]:
    """Log P(action t | actions before t in its episode) (N,) of another demonstration.

    The sequential model's own probability of what was done: actions that do the same, such as
    blocked moves, are one action to it, but for the likelihood (7), to which each is its own.

    Raises:
        InputError: the posterior is not one of the sequential model, or as in `predict`.
    """
    _check(held_out, grid_map, grid_world(grid_map, posterior.settings))
    model, probability, _ = _in_sequence(posterior, held_out, grid_map)
    taken = probability[np.arange(len(held_out)), model.action_of]
    return np.log(np.maximum(taken, LEAST_PROBABILITY))


def by_outcome(
    probability: npt.NDArray[np.float64], same: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """(N, A) the probability of all actions that do the same, in the column of the first of them.

    The other columns are 0.

    Args:
        probability: (N, A) of each action.
        same: (N, A) column of the first action that does the same.
    """
    together = np.zeros_like(probability)
    np.add.at(together, (np.arange(len(same))[:, None], same), probability)
    return together


def shared_evenly(
    probability: npt.NDArray[np.float64], same: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """(N, A) with the probability of what actions do shared evenly by those that do the same."""
    size = by_outcome(np.ones_like(probability), same)
    mean = by_outcome(probability, same) / np.maximum(size, 1.0)
    return np.take_along_axis(mean, same, axis=1)


def _prediction(
    world: GridWorld,
    demonstration: Demonstration,
    probability: npt.NDArray[np.float64],
    subgoal: npt.NDArray[np.int64],
    subgoal_probability: npt.NDArray[np.float64],
) -> Prediction:
    same = world.same_action(world.states_of(demonstration.cells))
    return Prediction(
        actions=world.actions,
        probability=shared_evenly(probability, same),
        same=same,
        subgoal=subgoal.astype(np.int64),
        subgoal_probability=subgoal_probability,
    )


def _check(demonstration: Demonstration, grid_map: GridMap, world: GridWorld) -> None:
    """Refuse what lies beside the free space, or was done with other actions."""
    for cell in demonstration.cells[~grid_map.is_free(demonstration.cells)][:1]:
        raise InputError(f"{grid_map.fault_of(cell)}; correct it or give another map")
    for action in demonstration.action[~np.isin(demonstration.action, world.actions)][:1]:
        raise InputError(f"action {action}: is none of {', '.join(map(str, world.actions))}")


# The sequential model


def _watched(
    posterior: Posterior, demonstration: Demonstration, grid_map: GridMap
) -> PursuitModel:
    return pursuit_model_of(demonstration, posterior.candidates, grid_map, posterior.settings)


def _in_sequence(
    posterior: Posterior, demonstration: Demonstration, grid_map: GridMap
) -> tuple[PursuitModel, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The model of a demonstration, and what is foreseen, the mean over draws.

    (N, A) the probability of each action that differs to the model, and (N, G) of each subgoal.
    """
    draws = evenly_spaced_draws(posterior)
    model = _watched(posterior, demonstration, grid_map)
    probability = np.zeros((len(demonstration), model.cost.shape[1]))
    subgoals = np.zeros((len(demonstration), len(posterior.candidates)))
    for weights, parameters in zip(*draws, strict=True):
        now = foreseen(model, weights, parameters)
        _add_actions(model.action_likelihood(parameters), model.state_of, now, probability)
        subgoals += now
    count = len(draws[0])
    return model, probability / count, subgoals / count


@njit(nogil=True, cache=True)
def _add_actions(likelihood, state_of, subgoals, probability):  # type: ignore[no-untyped-def]
    """Add sum_g P(g) P(a | s, g) to probability (N, A), without an array (N, A, G)."""
    for t in range(state_of.shape[0]):
        for action in range(likelihood.shape[1]):
            row = likelihood[state_of[t], action]
            total = 0.0
            for candidate in range(row.shape[0]):
                total += subgoals[t, candidate] * row[candidate]
            probability[t, action] += total


# The paper's model


def _urn_weights(posterior: Posterior) -> npt.NDArray[np.float64]:
    """(G,) probability of the next observation's subgoal, the mean of the urn's over all draws."""
    drawn = posterior.draws.subgoal_of.reshape(-1)
    count, candidates = len(posterior.demonstration), len(posterior.candidates)
    counts = np.bincount(drawn, minlength=candidates) / (len(drawn) / count)
    eta = posterior.settings.fixed["eta"]
    return (counts + eta / candidates) / (count + eta)


def _most_likely_partition(posterior: Posterior) -> tuple[int, float]:
    """Candidate index of z_k's subgoal (19), or `NEW_SUBGOAL`, and the probability of z_k."""
    eta, mode = posterior.settings.fixed["eta"], posterior.mode
    sizes = np.bincount(mode.partition_of)
    total = sizes.sum() + eta
    if eta > sizes.max():
        return NEW_SUBGOAL, float(eta / total)
    first = int((mode.partition_of == sizes.argmax()).argmax())
    return int(mode.subgoal_of[first]), float(sizes.max() / total)


def _mean_policy(
    posterior: Posterior,
    demonstration: Demonstration,
    world: GridWorld,
    weights: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """(N, A) sum over g of w_g P(a | s, g), with (7) and the weights (G,) of the subgoals."""
    states, row_of = np.unique(world.states_of(demonstration.cells), return_inverse=True)
    values = goal_values(world, posterior.candidates.goals, states)
    log_policies = action_log_likelihood(values, posterior.settings.fixed["alpha"])
    return (np.exp(log_policies) @ weights)[row_of.reshape(-1)]
