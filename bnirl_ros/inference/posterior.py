"""From a demonstration on a map to the posterior: the one path, live and offline."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Event

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.chains import Progress, run_chains
from bnirl_ros.inference.diagnostics import effective_sample_size, rhat
from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.mode import Mode, posterior_mode
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.candidates import candidate_cells
from bnirl_ros.model.mixture import SubgoalMixture, subgoal_mixture


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from the posterior of a demonstration's subgoals, and its mode.

    Attributes:
        candidates: (G, 2) int64 cells in the support of P(g).
        demonstration: the N observations.
        draws: draws (chain, draw, N).
        mode: the most probable partition with its subgoals.
        rhat, ess: the worse one for log joint and number of partitions, both free of labels; None
            where undefined (`bnirl_ros.inference.diagnostics`).
    """

    candidates: npt.NDArray[np.int64]
    demonstration: Demonstration
    draws: Draws
    mode: Mode
    rhat: float | None
    ess: float | None

    def subgoal_probability(self) -> npt.NDArray[np.float64]:
        """(G,) share of the draws in which each candidate is some observation's subgoal."""
        drawn = self.draws.subgoal_of.reshape(-1, len(self.demonstration))
        occurs = np.zeros((len(drawn), len(self.candidates)), dtype=np.bool_)
        for present, subgoals in zip(occurs, drawn, strict=True):
            present[subgoals] = True
        return occurs.mean(axis=0)

    def assignment_probability(self) -> npt.NDArray[np.float64]:
        """(N, G) share of the draws in which each candidate is the observation's subgoal."""
        drawn = self.draws.subgoal_of.reshape(-1, len(self.demonstration))
        counts = np.zeros((len(self.demonstration), len(self.candidates)))
        rows = np.arange(len(counts))
        for subgoals in drawn:
            counts[rows, subgoals] += 1.0
        return counts / len(drawn)


def grid_world(grid_map: GridMap, settings: Settings) -> GridWorld:
    """The grid world that a map and the settings give."""
    return GridWorld(grid_map.free, settings.moves, settings.success, settings.discount)


def paper_model(
    demonstration: Demonstration, grid_map: GridMap, settings: Settings
) -> tuple[npt.NDArray[np.int64], SubgoalMixture]:
    """Candidate cells (G, 2) and the paper's mixture over them."""
    world = grid_world(grid_map, settings)
    candidates = candidate_cells(settings.candidates, demonstration, world)
    return candidates, subgoal_mixture(
        world,
        world.states_of(demonstration.cells),
        demonstration.action,
        world.states_of(candidates),
        settings.alpha,
        settings.eta,
    )


def posterior_of(
    candidates: npt.NDArray[np.int64],
    demonstration: Demonstration,
    mixture: SubgoalMixture,
    draws: Draws,
) -> Posterior:
    """The posterior that draws (chain, draw, N) of a mixture stand for."""
    traces = (draws.log_joint, draws.partition_count)
    rhats = [value for value in map(rhat, traces) if value is not None]
    sizes = [value for value in map(effective_sample_size, traces) if value is not None]
    return Posterior(
        candidates=candidates,
        demonstration=demonstration,
        draws=draws,
        mode=posterior_mode(mixture, draws),
        rhat=max(rhats, default=None),
        ess=min(sizes, default=None),
    )


def infer(
    demonstration: Demonstration,
    grid_map: GridMap,
    settings: Settings,
    progress: Progress | None = None,
    stop: Event | None = None,
) -> Posterior:
    """Sample the posterior of a demonstration's subgoals with fresh chains from the seed.

    Equal demonstrations, maps and settings give equal posteriors, bit for bit: this is what
    `bnirl infer` and the node's `~/infer` run.

    Args:
        demonstration: observations on free cells of the map.
        grid_map: the map.
        settings: model and sampling settings.
        progress: told of sweeps as they are done, from several threads.
        stop: set it to give up between sweeps.

    Raises:
        InputError: there is no observation.
        StoppedError: `stop` was set.
    """
    if len(demonstration) == 0:
        raise InputError("there is no observation to infer from; a pose and an action make one")
    candidates, mixture = paper_model(demonstration, grid_map, settings)
    draws = run_chains(mixture, settings, progress, stop)
    return posterior_of(candidates, demonstration, mixture, draws)
