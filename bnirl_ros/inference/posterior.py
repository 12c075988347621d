"""From a demonstration on a map to the posterior: the one path, live and offline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from threading import Event
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference import mode, pursuit_mode
from bnirl_ros.inference.chains import Progress, Sampling, run_until
from bnirl_ros.inference.convergence import Convergence, convergence_of, traces_of
from bnirl_ros.inference.draws import Draws, most_draws
from bnirl_ros.inference.known_goals import KnownGoals
from bnirl_ros.inference.mode import Mode
from bnirl_ros.inference.runs import run_counts
from bnirl_ros.inference.samplers import Model
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.distinct import distinct
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.candidates import Candidates, candidates_of
from bnirl_ros.model.mixture import SubgoalMixture, log_policies, subgoal_mixture
from bnirl_ros.model.pursuits import PRIORS, PursuitModel, action_costs, pursuit_model


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from the posterior of a demonstration's subgoals, and its mode.

    Attributes:
        candidates: the G subgoals in the support of P(g).
        demonstration: the N observations.
        draws: draws (chain, draw, N).
        mode: the most probable partition with its subgoals.
        settings: with which they were drawn.
        model: of the demonstration, over the candidates.
        sampling: how many sweeps there were, and what stopped them.
        convergence: how far the chains agree.
    """

    candidates: Candidates
    demonstration: Demonstration
    draws: Draws
    mode: Mode
    settings: Settings
    model: Model
    sampling: Sampling
    convergence: Convergence

    @property
    def ess_per_second(self) -> float | None:
        """Effective samples for each second of sampling [1/s], if any; the machine's doing."""
        ess, seconds = self.convergence.ess, self.sampling.seconds
        return None if ess is None or not seconds else ess / seconds

    def pursuit_counts(
        self, region_of: npt.NDArray[np.int32] | None = None
    ) -> npt.NDArray[np.int64]:
        """(D, G) number of pursuits of each candidate in each draw of all chains.

        Args:
            region_of: (G,) candidate that stands for each one; by default each for itself.
        """
        drawn = self.draws.subgoal_of.reshape(-1, len(self.demonstration))
        starts, count = self.demonstration.starts, len(self.candidates)
        if region_of is None:
            return np.asarray(run_counts(drawn, starts, count))
        regions = np.append(region_of, np.int32(-1))
        # Draw by draw, as all draws of a long demonstration are most of the memory there is.
        return np.concatenate([run_counts(regions[each[None]], starts, count) for each in drawn])

    def subgoal_probability(self) -> npt.NDArray[np.float64]:
        """(G,) share of the draws in which each candidate is some observation's subgoal."""
        return np.asarray((self.pursuit_counts() > 0).mean(axis=0))

    def assignment_probability(self) -> npt.NDArray[np.float64]:
        """(N, G) share of the draws in which each candidate is the observation's subgoal.

        What is missing to one is the probability that the observation is a slip.
        """
        drawn = self.draws.subgoal_of.reshape(-1, len(self.demonstration))
        counts = np.zeros((len(self.demonstration), len(self.candidates) + 1))
        rows = np.arange(len(counts))
        for subgoals in drawn:
            counts[rows, subgoals] += 1.0
        return counts[:, :-1] / len(drawn)


def grid_world(grid_map: GridMap, settings: Settings) -> GridWorld:
    """The grid world that a map and the settings give."""
    return GridWorld(grid_map.free, settings.moves, settings.success, settings.discount)


def known_goals(grid_map: GridMap, settings: Settings) -> KnownGoals:
    """What is to be known from one `model_of` to the next, on this map and with these settings."""
    world = grid_world(grid_map, settings)
    if settings.model == "paper":
        alpha = settings.fixed["alpha"]
        return KnownGoals(world, lambda states, goals: log_policies(world, states, goals, alpha))
    likelihood = settings.likelihood
    return KnownGoals(world, lambda states, goals: action_costs(world, states, goals, likelihood))


def model_of(
    demonstration: Demonstration,
    grid_map: GridMap,
    settings: Settings,
    known: KnownGoals | None = None,
) -> tuple[Candidates, Model]:
    """The candidates, and the model over them that the settings ask for.

    Args:
        demonstration: the observations.
        grid_map: the map.
        settings: model and sampling settings.
        known: `known_goals` of the same map and settings, which are made use of, and added to.

    Raises:
        InputError: the map has features, but where they are needed it has none.
    """
    world = known.world if known else grid_world(grid_map, settings)
    candidates = candidates_of(
        settings.candidates,
        demonstration,
        world,
        grid_map.features,
        by_part=settings.model == "sequential",
    )
    if settings.model == "paper":
        return candidates, subgoal_mixture(
            world,
            world.states_of(demonstration.cells),
            demonstration.action,
            candidates.goals,
            policies_in=known.of if known else None,
            **settings.fixed,
        )
    return candidates, pursuit_model_of(demonstration, candidates, grid_map, settings, known)


def pursuit_model_of(
    demonstration: Demonstration,
    candidates: Candidates,
    grid_map: GridMap,
    settings: Settings,
    known: KnownGoals | None = None,
) -> PursuitModel:
    """The sequential model of a demonstration over given candidates; `known` as in `model_of`.

    Raises:
        InputError: some of it lies where no candidate can be reached.
    """
    world = known.world if known else grid_world(grid_map, settings)
    states = world.states_of(demonstration.cells)
    visited, _ = distinct(states, world.state_count)
    reachable = candidates.reachable_from(world, visited)
    if not reachable.all():
        x, y = world.cells_of(visited[~reachable])[0]
        raise InputError(
            f"cell ({x}, {y}): no candidate can be reached from it; give features to more cells, "
            "or take other candidates"
        )
    radius = settings.arrival_radius / grid_map.resolution
    return pursuit_model(
        world,
        states,
        demonstration.action,
        demonstration.starts,
        candidates.goals,
        arrived=candidates.reached_in(world, world.cells_of(visited), radius),
        likelihood=settings.likelihood,
        fixed=settings.fixed,
        cost=known.of(visited, candidates.goals) if known else None,
    )


def mode_of(model: Model, draws: Draws) -> Mode:
    """The posterior mode of a model, from draws (chain, draw, N)."""
    if isinstance(model, SubgoalMixture):
        return mode.posterior_mode(model, draws)
    return pursuit_mode.posterior_mode(model, draws)


def posterior_of(
    candidates: Candidates,
    demonstration: Demonstration,
    model: Model,
    draws: Draws,
    settings: Settings,
    sampling: Sampling,
) -> Posterior:
    """The posterior that draws (chain, draw, N) of a model stand for."""
    return Posterior(
        candidates=candidates,
        demonstration=demonstration,
        draws=draws,
        mode=mode_of(model, draws),
        settings=settings,
        model=model,
        sampling=sampling,
        convergence=convergence_in(draws, demonstration, candidates),
    )


def convergence_in(
    draws: Draws, demonstration: Demonstration, candidates: Candidates
) -> Convergence:
    """How far the chains agree of which these are the draws (chain, draw, N)."""
    return convergence_of(watched_in(draws, demonstration, candidates))


def watched_in(
    draws: Draws, demonstration: Demonstration, candidates: Candidates
) -> dict[str, npt.NDArray[Any]]:
    """What is watched of the chains of which these are the draws: `traces_of`."""
    names = list(PRIORS)[: draws.parameters.shape[-1]]  # none, or all of them
    subgoals = candidates.coordinates.tolist()
    return traces_of(draws, demonstration.starts, subgoals, names)


def within_memory(settings: Settings, observations: int) -> Settings:
    """The settings, or with so much more thinning that all draws fit into `DRAW_MEMORY`."""
    most = most_draws(settings.chains, observations)
    return replace(settings, thin=settings.thin * (settings.draws // (most + 1) + 1))


def infer(
    demonstration: Demonstration,
    grid_map: GridMap,
    settings: Settings,
    progress: Progress | None = None,
    stop: Event | None = None,
    threads: int | None = None,
) -> Posterior:
    """Sample the posterior of a demonstration's subgoals with fresh chains from the seed.

    Equal demonstrations, maps and settings give equal posteriors, bit for bit, unless time runs
    out: this is what `bnirl infer` and the node's `~/infer` run. Draws that would not be
    `within_memory` are thinned out, which the settings of the posterior tell.

    Args:
        demonstration: observations on free cells of the map.
        grid_map: the map; with features, subgoals are feature subgoals.
        settings: model and sampling settings.
        progress: told of sweeps as they are done, from several threads.
        stop: set it to give up between sweeps.
        threads: how many chains run at the same time; by default one on each core.

    Raises:
        InputError: there is no observation, or features do not cover what was visited.
        StoppedError: `stop` was set.
    """
    if len(demonstration) == 0:
        raise InputError("there is no observation to infer from; a pose and an action make one")
    settings = within_memory(settings, len(demonstration))
    candidates, model = model_of(demonstration, grid_map, settings)

    def is_enough(draws: Draws) -> bool:
        return convergence_in(draws, demonstration, candidates).reached

    draws, sampling = run_until(is_enough, model, settings, progress, stop, threads)
    return posterior_of(candidates, demonstration, model, draws, settings, sampling)
