"""What the demonstrator is going for now: filtering, draw by draw.

Given the parameters and weights of a draw, the subgoal of a demonstrator that is being watched is
the state of a hidden Markov chain. Filtering costs O(G) an observation.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.posterior import Posterior, grid_world, pursuit_model_of
from bnirl_ros.inference.pursuit_gibbs import (
    forward_pass,
    kernel_model,
    softmax_table,
    switch_probability,
)
from bnirl_ros.inference.runs import run_counts
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.model.pursuits import ALPHA, ETA, PRIORS, PursuitModel

_DRAWS = 64  # of the posterior, over which a prediction is averaged


def filtered(
    model: PursuitModel,
    weights: npt.NDArray[np.float64],
    parameters: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """P(subgoal at t | actions up to t) (N, G), and P(action t | actions before t) (N,).

    Both within the episode of t, whose first subgoal is a draw from the weights.

    Args:
        model: of the demonstration that is watched.
        weights: (G,) probability that the next subgoal is each candidate, given that it lies in
            the part of the map where the demonstrator is.
        parameters: in the order of `PRIORS`.
    """
    kernel = kernel_model(model)
    chosen = softmax_table(kernel, parameters[ALPHA])
    belief = np.empty((len(model.state_of), len(weights)))
    evidence = np.empty(len(belief))
    bounds = [*np.flatnonzero(model.starts), len(belief)]
    for first, end in pairwise(bounds):
        here = model.candidate_part == model.state_part[model.state_of[first]]
        forward_pass(
            kernel,
            parameters,
            chosen,
            np.where(here, weights, 0.0),
            first,
            end,
            weights,  # not read
            belief[first:end],
            evidence[first:end],
        )
    return belief, evidence


def foreseen(
    model: PursuitModel,
    weights: npt.NDArray[np.float64],
    parameters: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """P(subgoal at t | actions before t in its episode) (N, G): before action t is seen.

    Args:
        model, weights, parameters: as in `filtered`.
    """
    result = filtered(model, weights, parameters)[0]
    _one_step_back(kernel_model(model), parameters, weights, result)
    return result


@njit(nogil=True, cache=True)
def _one_step_back(model, parameters, weights, belief):  # type: ignore[no-untyped-def]
    """Turn P(subgoal at t | actions up to t) into that given the actions before t, in place."""
    candidates = weights.shape[0]
    for t in range(belief.shape[0] - 1, -1, -1):  # the one before t is still as it was
        part = model.state_part[model.state_of[t]]
        switched = 0.0
        for candidate in range(candidates):
            if model.starts[t]:
                switched = 1.0
                belief[t, candidate] = 0.0
            else:
                rho = switch_probability(model, parameters, t, candidate)
                before = belief[t - 1, candidate]
                switched += rho * before
                belief[t, candidate] = (1.0 - rho) * before
        for candidate in range(candidates):
            if model.candidate_part[candidate] == part:
                belief[t, candidate] += switched * weights[candidate]


def weights_of_draws(
    posterior: Posterior, model: PursuitModel, draws: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """(D, G) probability that the next subgoal is each candidate, for some draws of all chains.

    The urn's, after the pursuits of the draw and the expected number of times that a subgoal was
    drawn again while it was pursued, which draws do not record.

    Args:
        posterior: draws of the sequential model.
        model: of the demonstration that the posterior is about.
        draws: (D,) numbers of the draws.
    """
    demonstration = posterior.demonstration
    subgoals = posterior.draws.subgoal_of.reshape(-1, len(demonstration))[draws]
    parameters = posterior.draws.parameters.reshape(-1, len(PRIORS))[draws]
    runs = run_counts(subgoals, demonstration.starts, len(posterior.candidates))
    result = np.empty(runs.shape)
    for index, (subgoal_of, values) in enumerate(zip(subgoals, parameters, strict=True)):
        same = (subgoal_of[1:] >= 0) & (subgoal_of[1:] == subgoal_of[:-1]) & ~model.starts[1:]
        kept = subgoal_of[1:][same]
        rho = model.switch_probability(subgoal_of, values)[1:][same]
        counts = runs[index].astype(np.float64)
        for _ in range(5):  # a fixed point, soon near enough
            weights = _urn_weights(model, values[ETA], counts)
            again = rho * weights[kept]
            expected = again / (1.0 - rho + again)
            counts = runs[index] + np.bincount(kept, weights=expected, minlength=len(weights))
        result[index] = _urn_weights(model, values[ETA], counts)
    return result


def _urn_weights(
    model: PursuitModel, eta: float, counts: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(G,) predictive weights within each part."""
    drawn = np.bincount(model.candidate_part, weights=counts)[model.candidate_part]
    return np.asarray((eta * model.prior + counts) / (eta + drawn))


def evenly_spaced_draws(
    posterior: Posterior, grid_map: GridMap
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Of evenly spaced draws of all chains, the weights of the next subgoal and the parameters.

    Returns:
        (D, G) weights as in `weights_of_draws`, and (D, P) parameters in the order of `PRIORS`.

    Raises:
        InputError: the posterior is not one of the sequential model, or no candidate can be
            reached from an observation.
    """
    if posterior.settings.model != "sequential":
        raise InputError("only the sequential model can be filtered; infer with it")
    model = pursuit_model_of(
        posterior.demonstration, posterior.candidates, grid_map, posterior.settings
    )
    numbers = np.unique(np.linspace(0, posterior.draws.log_joint.size - 1, _DRAWS).astype(int))
    parameters = posterior.draws.parameters.reshape(-1, len(PRIORS))[numbers]
    return weights_of_draws(posterior, model, numbers), parameters


def middle_of_draws(
    posterior: Posterior, grid_map: GridMap
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(G,) mean weights of the next subgoal, and (P,) median parameters.

    Raises:
        InputError: the posterior is not one of the sequential model.
    """
    weights, _ = evenly_spaced_draws(posterior, grid_map)
    parameters = np.median(posterior.draws.parameters.reshape(-1, len(PRIORS)), axis=0)
    return weights.mean(axis=0), parameters


class SubgoalFilter:
    """Watches a demonstrator and tells, action by action, what it is going for now.

    With the posterior medians of the parameters, and the mean of the weights over some draws.
    Holds the action likelihoods of all free cells: their number times that of actions times that
    of candidates.
    """

    def __init__(self, posterior: Posterior, grid_map: GridMap) -> None:
        """A filter for a demonstrator like the one of a posterior, on the same map.

        Raises:
            InputError: the posterior is not one of the sequential model.
        """
        self._weights, self._parameters = middle_of_draws(posterior, grid_map)
        self.candidates = posterior.candidates
        self._world = grid_world(grid_map, posterior.settings)
        free = np.flatnonzero(self._world.free)
        states = free[self.candidates.reachable_from(self._world, free)]
        actions = self._world.actions
        every = Demonstration(
            episode=np.zeros(len(states) * len(actions), dtype=np.int64),
            cells=self._world.cells_of(np.repeat(states, len(actions))),
            action=np.tile(actions, len(states)),
            last_episode=np.empty(0, dtype=np.int64),
            last_cells=np.empty((0, 2), dtype=np.int64),
        )
        self._model = pursuit_model_of(every, self.candidates, grid_map, posterior.settings)
        self._kernel = kernel_model(self._model)
        self._chosen = softmax_table(self._kernel, self._parameters[ALPHA])
        # By cell: the number of a state tells nothing of a cell beyond the map's edge.
        self._row_of_cell = {
            (int(x), int(y)): row for row, (x, y) in enumerate(self._world.cells_of(states))
        }
        self._belief: npt.NDArray[np.float64] | None = None
        self._row = 0

    def begin_episode(self) -> None:
        """The next action is the first one of an episode."""
        self._belief = None

    def observe(self, cell: npt.ArrayLike, action: int) -> npt.NDArray[np.float64]:
        """P(subgoal now | actions of this episode so far) (G,), after one more of them.

        Args:
            cell: (x, y) in which the action was chosen.
            action: index into `ACTION_NAMES`.

        Raises:
            InputError: the cell is not free, or no candidate can be reached from it, or there is
                no such action.
        """
        x, y = (int(coordinate) for coordinate in np.asarray(cell).reshape(2))
        row = self._row_of_cell.get((x, y))
        if row is None:
            raise InputError(f"cell ({x}, {y}): no candidate can be reached from it")
        actions = self._world.actions
        if action not in actions:
            raise InputError(f"action {action}: is none of {', '.join(map(str, actions))}")
        pair = self._kernel.pair_of[row * len(actions) + np.searchsorted(actions, action)]
        starts = self._belief is None
        here = self._model.candidate_part == self._model.state_part[row]
        weights = np.where(here, self._weights, 0.0)
        after = np.empty((1, len(weights)))
        forward_pass(
            self._kernel._replace(
                state_of=np.array([self._row, row]),
                pair_of=np.array([0, pair]),
                starts=np.array([False, starts]),
            ),
            self._parameters,
            self._chosen,
            weights,
            1,
            2,
            weights if self._belief is None else self._belief,
            after,
            np.empty(1),
        )
        self._belief, self._row = after[0], row
        return self._belief.copy()
