"""What the demonstrator is going for now: filtering, draw by draw.

Given the parameters and weights of a draw, the subgoal of a demonstrator that is being watched is
the state of a hidden Markov chain. Filtering costs O(G) an observation.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.errors import InputError
from bnirl_ros.inference.posterior import Posterior, grid_world
from bnirl_ros.inference.pursuit_gibbs import (
    KernelModel,
    forward_pass,
    kernel_model,
    softmax_table,
    switch_probability,
)
from bnirl_ros.inference.runs import run_counts
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.pursuits import (
    ALPHA,
    ETA,
    PRIORS,
    PursuitModel,
    action_costs,
    pursuit_model,
    switch_probabilities,
)

_DRAWS = 64  # of the posterior, over which a prediction is averaged
_ROOM = 1 << 22  # costs of actions that are kept beside the posterior's: 32 MB


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
    return _filtered(kernel_model(model), weights, parameters)


def _filtered(
    model: KernelModel, weights: npt.NDArray[np.float64], parameters: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """`filtered` of a model as the kernels take it."""
    chosen = softmax_table(model, parameters[ALPHA])
    belief = np.empty((len(model.state_of), len(weights)))
    evidence = np.empty(len(belief))
    bounds = [*np.flatnonzero(model.starts), len(belief)]
    for first, end in pairwise(bounds):
        here = model.candidate_part == model.state_part[model.state_of[first]]
        forward_pass(
            model,
            parameters,
            chosen,
            np.where(here, weights, 0.0),
            first,
            end,
            weights,  # not read
            belief[first:end],
            evidence[first:end],
        )
    return belief / evidence[:, np.newaxis], evidence


def foreseen(
    model: PursuitModel,
    weights: npt.NDArray[np.float64],
    parameters: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """P(subgoal at t | actions before t in its episode) (N, G): before action t is seen.

    Args:
        model, weights, parameters: as in `filtered`.
    """
    kernel = kernel_model(model)
    result = _filtered(kernel, weights, parameters)[0]
    _one_step_back(kernel, parameters, weights, result)
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
                rho = switch_probability(model.arrived, model.state_of, parameters, t, candidate)
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
    posterior: Posterior,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Of evenly spaced draws of all chains, the weights of the next subgoal and the parameters.

    Returns:
        (D, G) weights as in `weights_of_draws`, and (D, P) parameters in the order of `PRIORS`.

    Raises:
        InputError: the posterior is not one of the sequential model.
    """
    model = posterior.model
    if not isinstance(model, PursuitModel):
        raise InputError("only the sequential model can be filtered; infer with it")
    numbers = np.unique(np.linspace(0, posterior.draws.log_joint.size - 1, _DRAWS).astype(int))
    parameters = posterior.draws.parameters.reshape(-1, len(PRIORS))[numbers]
    return weights_of_draws(posterior, model, numbers), parameters


def middle_of_draws(
    posterior: Posterior,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(G,) mean weights of the next subgoal, and (P,) median parameters.

    Raises:
        InputError: the posterior is not one of the sequential model.
    """
    weights, _ = evenly_spaced_draws(posterior)
    parameters = np.median(posterior.draws.parameters.reshape(-1, len(PRIORS)), axis=0)
    return weights.mean(axis=0), parameters


class _ActionCosts:
    """What actions cost in any state: as the posterior has it, and elsewhere found when asked for.

    To find it takes as long for many states as for one, so it is found for as many of those around
    as there is room for. What was found `before`, for an older posterior, is kept.
    """

    def __init__(
        self, posterior: Posterior, world: GridWorld, before: _ActionCosts | None
    ) -> None:
        assert isinstance(posterior.model, PursuitModel)
        self._candidates, self._world = posterior.candidates, world
        self._likelihood = posterior.settings.likelihood
        visited = np.unique(world.states_of(posterior.demonstration.cells))
        self._known = dict(zip(visited.tolist(), posterior.model.cost, strict=True))
        self._found: dict[int, npt.NDArray[np.float64]] = {}
        if before and self._is_about_the_same_as(before):
            self._found = self._kept(before)

    def _is_about_the_same_as(self, other: _ActionCosts) -> bool:
        mine, others = self._world, other._world
        return (
            np.array_equal(mine.free, others.free)
            and (mine.moves, mine.success, mine.discount, self._likelihood)
            == (others.moves, others.success, others.discount, other._likelihood)
            and not self._candidates.are_features
            and not other._candidates.are_features
        )

    def _kept(self, before: _ActionCosts) -> dict[int, npt.NDArray[np.float64]]:
        """What was found before, with columns for the candidates that are new."""
        known = {
            state: costs for state, costs in before._found.items() if state not in self._known
        }
        states = list(known)[: self._room]
        if not states:
            return {}
        now, then = self._candidates.goals.states, before._candidates.goals.states
        _, kept, old = np.intersect1d(now, then, return_indices=True)
        new = np.setdiff1d(np.arange(len(now)), kept)
        costs = np.empty((len(states), len(self._world.actions), len(now)))
        for row, state in enumerate(states):
            costs[row][:, kept] = known[state][:, old]
        if len(new):
            goals = self._candidates.take(new).goals
            costs[:, :, new] = action_costs(self._world, np.array(states), goals, self._likelihood)
        return dict(zip(states, costs, strict=True))

    @property
    def _room(self) -> int:
        """For how many states."""
        return _ROOM // (len(self._world.actions) * len(self._candidates))

    def of(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """(U, A, G) the costs in each of the states, in which candidates can be reached."""
        asked = states.tolist()
        further = [state for state in asked if state not in self._known]
        if not self._found.keys() >= set(further):
            found = self._around(np.array(further))
            goals = self._candidates.goals
            costs = action_costs(self._world, found, goals, self._likelihood)
            self._found = dict(zip(found.tolist(), costs, strict=True))
        return np.stack([self._known.get(state, self._found.get(state)) for state in asked])

    def _around(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """These states, and those nearest to the last of them that the posterior lacks."""
        free = np.flatnonzero(self._world.free)
        others = np.setdiff1d(free, [*self._known, *states])
        cells, last = self._world.cells_of(others), self._world.cells_of(states[-1:])
        nearest = np.argsort(np.abs(cells - last).max(axis=1), kind="stable")
        return np.concatenate([states, others[nearest[: max(0, self._room - len(states))]]])


class SubgoalFilter:
    """Watches a demonstrator and tells, action by action, what it is going for now.

    With the posterior medians of the parameters, and the mean of the weights over some draws. An
    action costs as many operations as there are candidates; in a cell where the demonstrator of
    the posterior never acted, now and then the goal values of all candidates have to be solved.
    """

    def __init__(
        self, posterior: Posterior, grid_map: GridMap, before: SubgoalFilter | None = None
    ) -> None:
        """A filter for a demonstrator like the one of a posterior, on the same map.

        Args:
            posterior: of the sequential model.
            grid_map: the map on which it was inferred.
            before: of an older posterior, whose goal values are used again as far as they hold.

        Raises:
            InputError: the posterior is not one of the sequential model.
        """
        self._weights, self._parameters = middle_of_draws(posterior)
        self.candidates = posterior.candidates
        self._settings, self._grid_map = posterior.settings, grid_map
        self._world = grid_world(grid_map, posterior.settings)
        self._radius = posterior.settings.arrival_radius / grid_map.resolution
        older = before._costs if before else None
        self._costs: _ActionCosts = _ActionCosts(posterior, self._world, older)
        self._parts = self._world.parts_of(
            self.candidates.goals.states[self.candidates.goals.first[:-1]]
        )
        self._belief: npt.NDArray[np.float64] | None = None
        self._drawn = self._weights  # those of the episode's part of the map
        self._state = 0

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
                no such action. Nothing is changed then.
        """
        return self.observe_all(np.asarray(cell).reshape(1, 2), [action])[0]

    def observe_all(self, cells: npt.ArrayLike, actions: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """P(subgoal at t | actions of this episode up to t) (N, G), of the next N of them.

        Args:
            cells: (N, 2) in which each action was chosen; one at least.
            actions: (N,) indices into `ACTION_NAMES`.

        Raises:
            InputError: as in `observe`, of any of them.
        """
        states, chosen = self._states_of(cells), np.asarray(actions)
        drawn, before, first = self._drawn, self._belief, 0
        if before is None:
            before = drawn = self._weights_from(states[0])  # as `before` not read
        else:  # the state before tells whether the demonstrator has arrived or stayed
            states, chosen, first = np.append(self._state, states), np.append(0, chosen), 1
        starts = np.arange(len(states)) == 0
        visited = np.unique(states)
        model = pursuit_model(
            self._world,
            states,
            chosen,
            starts,
            self.candidates.goals,
            arrived=self._reached_in(visited),
            likelihood=self._settings.likelihood,
            fixed=self._settings.fixed,
            cost=self._costs.of(visited),
        )
        kernel = kernel_model(model)
        belief = np.empty((len(states) - first, len(drawn)))
        evidence = np.empty(len(belief))
        forward_pass(
            kernel,
            self._parameters,
            softmax_table(kernel, self._parameters[ALPHA]),
            drawn,
            first,
            len(states),
            before,
            belief,
            evidence,
        )
        belief /= evidence[:, np.newaxis]
        self._belief, self._drawn, self._state = belief[-1].copy(), drawn, int(states[-1])
        return belief

    def expect(self, cell: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """P(subgoal of the next action | actions of this episode so far) (G,), chosen in a cell.

        Who has arrived there may have moved on to the next subgoal: what `observe` begins with.

        Args:
            cell: (x, y) in which the next action will be chosen.

        Raises:
            InputError: the cell is not free, or no candidate can be reached from it.
        """
        (state,) = self._states_of(cell)
        if self._belief is None:
            return self._weights_from(state)
        there_already, here = self._reached_in(np.array([self._state, state]))
        rho = switch_probabilities(here, there_already, self._parameters)
        switched = rho * self._belief
        return self._belief - switched + switched.sum() * self._drawn

    def _states_of(self, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """(N,) state numbers of cells (N, 2) from which a candidate can be reached."""
        places = np.asarray(cells, dtype=np.int64).reshape(-1, 2)
        known = self._grid_map.is_free(places)
        # The number of a state tells nothing of a cell beyond the map's edge.
        states = self._world.states_of(places[known])
        known[known] = np.isin(self._world.parts_of(states), self._parts)
        for x, y in places[~known][:1].tolist():
            raise InputError(f"cell ({x}, {y}): no candidate can be reached from it")
        return states

    def _weights_from(self, state: int) -> npt.NDArray[np.float64]:
        """(G,) the weights in the part of the map in which a state lies; 0 elsewhere."""
        (part,) = self._world.parts_of(np.array([state]))
        return np.where(self._parts == part, self._weights, 0.0)

    def _reached_in(self, states: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(U, G) whether who is in each state counts as being at each candidate."""
        cells = self._world.cells_of(states)
        return self.candidates.reached_in(self._world, cells, self._radius)
