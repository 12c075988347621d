"""Chains that go on while observations arrive: warm-started, in bounded memory."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.placement import Placement
from bnirl_ros.inference.chains import CONVERGED, SWEEP_LIMIT, TIME_BUDGET, Sampling
from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.posterior import Posterior, model_of, posterior_of
from bnirl_ros.inference.samplers import sampler_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.threads import workers

CAPACITY = 256
"""Draws kept of each of four chains or more; even, and enough to tell that they have converged."""


class RunningPosterior:
    """The posterior of what was observed so far, from chains that never start again.

    Draws count from the last change of the observations. When there is no more room for them,
    every second one is dropped and every second sweep left out from then on, so that memory stays
    bounded and the draws span all sweeps. Its results agree with those of fresh chains, but are
    not equal to them.

    Attributes:
        placement, grid_map, settings: what it is the posterior of.
        sweeps: sweeps of each chain so far.
    """

    def __init__(
        self,
        placement: Placement,
        grid_map: GridMap,
        settings: Settings,
        before: RunningPosterior | None = None,
    ) -> None:
        """Chains over a demonstration with at least one observation.

        Where there is a posterior from `before`, of other observations, another map or other
        settings, its chains go on: what was observed then keeps its subgoal, as far as that is
        still a candidate. With another model, another seed, or another number of chains, they
        start anew.
        """
        self.placement, self.grid_map, self.settings = placement, grid_map, settings
        self.sweeps = 0
        self._seconds = 0.0
        self._converged, self._next_look = False, settings.sweeps
        self._candidates, self._model = model_of(placement.demonstration, grid_map, settings)
        self._sampler = sampler_of(self._model)
        self._capacity = CAPACITY * max(1, 4 // settings.chains)
        room = (settings.chains, self._capacity)
        self._draws = self._sampler.room_for(self._model, room)
        self._kept, self._thin = 0, 1
        self._generators: list[np.random.Generator]
        self._states: list[Any]
        if before and all(
            getattr(settings, name) == getattr(before.settings, name)
            for name in ("chains", "seed", "model")
        ):
            self._generators = before._generators
            self._states = self._states_going_on(before)
        else:
            seeds = np.random.SeedSequence(settings.seed).spawn(settings.chains)
            self._generators = [np.random.default_rng(seed) for seed in seeds]
            self._states = [
                self._sampler.initial_state(self._model, generator)
                for generator in self._generators
            ]

    @property
    def finished(self) -> bool:
        """Whether the settings ask for no more sweeps."""
        return self._stopped is not None

    @property
    def _stopped(self) -> str | None:
        """What stopped the chains, as far as these observations are concerned."""
        settings = self.settings
        if self._converged:
            return CONVERGED
        if self.sweeps >= max(settings.sweeps, settings.max_sweeps):
            return SWEEP_LIMIT
        out_of_time = 0.0 < settings.time_budget <= self._seconds
        return TIME_BUDGET if out_of_time and self._kept else None

    def advance(self, draws: int) -> None:
        """Go on for so many further draws of each chain, or fewer where room is short."""
        if self._kept == self._capacity:
            self._draws.drop_every_second()
            self._kept //= 2
            self._thin *= 2
        end = min(self._kept + draws, self._capacity)
        begin = time.monotonic()

        def run_chain(chain: int) -> None:
            part = self._draws[chain][self._kept : end]
            state, generator = self._states[chain], self._generators[chain]
            self._sampler.advance(self._model, state, generator, part, self._thin)

        with workers(len(self._states)) as threads:
            list(threads.map(run_chain, range(len(self._states))))
        self.sweeps += (end - self._kept) * self._thin
        self._kept = end
        self._seconds += time.monotonic() - begin

    def posterior(self) -> Posterior:
        """The posterior from all draws but the first quarter, in which the chains settle."""
        left_out = self._kept // 4
        draws = Draws(*(values[:, left_out : self._kept] for values in vars(self._draws).values()))
        burn_in = left_out * self._thin
        sampling = Sampling(self.sweeps, burn_in, self._thin, self._stopped, self._seconds)
        posterior = posterior_of(
            self._candidates,
            self.placement.demonstration,
            self._model,
            draws,
            self.settings,
            sampling,
        )
        # As rarely as offline: who looks often enough sees every chain converge.
        if self.settings.max_sweeps and self.sweeps >= self._next_look:
            self._next_look = 2 * self.sweeps
            self._converged = posterior.convergence.reached
        return replace(posterior, sampling=replace(sampling, stopped=self._stopped))

    def _states_going_on(self, before: RunningPosterior) -> list[Any]:
        """The states of the chains before, over the present observations and candidates."""
        _, old, new = np.intersect1d(
            before.placement.poses, self.placement.poses, return_indices=True
        )
        row_before = np.full(len(self.placement.poses), -1, dtype=np.int64)
        row_before[new] = old
        candidate_now = self._candidates_on(before)
        return [
            self._sampler.going_on(self._model, state, row_before, candidate_now, generator)
            for state, generator in zip(before._states, self._generators, strict=True)
        ]

    def _candidates_on(self, before: RunningPosterior) -> npt.NDArray[np.int64]:
        """(G before,) present index of each candidate before; -1 for none.

        Cells are told by their places, features by their coordinates.
        """
        old, now = before._candidates, self._candidates
        keys = old.coordinates
        if old.are_features != now.are_features:
            return np.full(len(old), -1, dtype=np.int64)
        if not old.are_features:
            keys = self.grid_map.cells_of(before.grid_map.centres_of(keys))
        index_of = {tuple(key): index for index, key in enumerate(now.coordinates.tolist())}
        return np.array([index_of.get(tuple(key), -1) for key in keys.tolist()], dtype=np.int64)
