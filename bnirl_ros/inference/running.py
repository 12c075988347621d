"""Chains that go on while observations arrive: warm-started, in bounded memory."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.placement import Placement
from bnirl_ros.errors import InputError
from bnirl_ros.inference import mode, pursuit_mode
from bnirl_ros.inference.chains import CONVERGED, SWEEP_LIMIT, TIME_BUDGET, Sampling
from bnirl_ros.inference.checkpoint import Checkpoint, digest_of
from bnirl_ros.inference.draws import Draws, most_draws
from bnirl_ros.inference.known_goals import KnownGoals
from bnirl_ros.inference.mode import Mode
from bnirl_ros.inference.particles import EACH, Particles, taken_in
from bnirl_ros.inference.posterior import Posterior, known_goals, model_of, posterior_of
from bnirl_ros.inference.samplers import sampler_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.model.mixture import SubgoalMixture
from bnirl_ros.threads import workers

CAPACITY = 256
"""Draws kept of each of four chains or more; even, and enough to tell that they have converged."""

_AT_ONCE = 256  # new observations that are taken in without a sweep
_LEFT = 0.25  # share of the draws that is to be left in effect then


class RunningPosterior:
    """The posterior of what was observed so far, from chains that never start again.

    Draws count from the last change of the observations. When there is no more room for them,
    every second one is dropped and every second sweep left out from then on, so that memory stays
    bounded and the draws span all sweeps. Its results agree with those of fresh chains, but are
    not equal to them.

    Where observations were only added at the end, there is a posterior before any sweep: the last
    draws of each chain take them in (`bnirl_ros.inference.particles`), and so does the mode.

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
        self._converged = False
        most = most_draws(settings.chains, len(placement.demonstration))
        self._capacity = max(2, min(CAPACITY * max(1, 4 // settings.chains), most // 2 * 2))
        same = before if before and before._is_about(grid_map, settings) else None
        self._known: KnownGoals = same._known if same else known_goals(grid_map, settings)
        self._candidates, self._model = model_of(
            placement.demonstration, grid_map, settings, self._known
        )
        self._sampler = sampler_of(self._model)
        self._draws: Draws | None = None
        self._kept, self._thin = 0, 1
        self._particles: Particles | None = None  # of these observations
        self._told: Posterior | None = None  # last
        self._middle = np.empty(0)  # of the parameters, by the last of the chains' own
        self._before: RunningPosterior | None = None  # whose chains are still to go on
        self._chains: list[Any] = []
        self._generators: list[np.random.Generator]
        if before and all(
            getattr(settings, name) == getattr(before.settings, name)
            for name in ("chains", "seed", "model")
        ):
            self._generators, self._before = before._generators, before
            if same:
                self._take_in(same)
        else:
            seeds = np.random.SeedSequence(settings.seed).spawn(settings.chains)
            self._generators = [np.random.default_rng(seed) for seed in seeds]
            self._chains = [
                self._sampler.initial_state(self._model, generator)
                for generator in self._generators
            ]

    @classmethod
    def resumed(
        cls, checkpoint: Checkpoint, grid_map: GridMap, settings: Settings
    ) -> RunningPosterior:
        """One whose chains go on from where they were when the checkpoint was made.

        Raises:
            InputError: it was made on another map, or with other settings.
        """
        if checkpoint.map_digest != digest_of(grid_map):
            raise InputError("checkpoint: was made on another map; the chains start anew")
        if checkpoint.settings != settings:
            raise InputError("checkpoint: was made with other settings; the chains start anew")
        placement = Placement(
            demonstration=checkpoint.demonstration,
            poses=checkpoint.poses,
            last_poses=checkpoint.last_poses,
            messages=0,
            faults=Counter(),
        )
        running = cls(placement, grid_map, settings)
        running._chains = list(checkpoint.states)
        for generator, state in zip(running._generators, checkpoint.generators, strict=True):
            generator.bit_generator.state = state
        return running

    def checkpoint(self) -> Checkpoint:
        """Where the chains are; they go on from there in any process, draw for draw."""
        return Checkpoint(
            map_digest=digest_of(self.grid_map),
            settings=self.settings,
            demonstration=self.placement.demonstration,
            poses=self.placement.poses,
            last_poses=self.placement.last_poses,
            states=tuple(self._states),
            generators=tuple(dict(each.bit_generator.state) for each in self._generators),
        )

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

    @property
    def ready(self) -> bool:
        """Whether there is a posterior; there always is after a sweep."""
        return self._told is not None or self._kept > 0

    @property
    def full(self) -> bool:
        """Whether there is no room for draws left, at ever twice as many sweeps.

        The posterior at that time is the one by which chains are found to have converged.
        """
        return self._kept == self._capacity

    def advance(self, draws: int) -> None:
        """Go on for so many further draws of each chain, or fewer where room is short."""
        states = self._states
        if self._draws is None:
            shape = self.settings.chains, self._capacity
            self._draws = self._sampler.room_for(self._model, shape)
            if self._particles is None:
                self._particles = Particles.empty(self._model, self.settings.chains)
        if self.full:
            self._draws.drop_every_second()
            self._kept //= 2
            self._thin *= 2
        end = min(self._kept + draws, self._capacity)
        room, particles = self._draws, self._particles
        assert particles is not None
        begin = time.monotonic()

        def run_chain(chain: int) -> None:
            part = room[chain][self._kept : end]
            state, generator = states[chain], self._generators[chain]
            self._sampler.advance(self._model, state, generator, part, self._thin)
            particles.record(chain, state, part[-1])

        with workers(len(states)) as threads:
            list(threads.map(run_chain, range(len(states))))
        self.sweeps += (end - self._kept) * self._thin
        self._kept = end
        self._seconds += time.monotonic() - begin

    def posterior(self) -> Posterior:
        """The posterior from all draws but the first quarter, in which the chains settle.

        Before the first sweep it is from draws of before that have taken in what is new. R-hat is
        then that of the last posterior from the chains' own draws.
        """
        if self._kept:
            self._told = self._from_sweeps()
        assert self._told is not None, "advance first"
        return self._told

    def _from_sweeps(self) -> Posterior:
        assert self._draws is not None
        left_out = self._kept // 4
        draws = Draws(*(values[:, left_out : self._kept] for values in vars(self._draws).values()))
        self._middle = np.median(np.concatenate(draws.parameters), axis=0)
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
        # As rarely as offline, for who looks often enough sees every chain converge, and when
        # there are most draws to tell it from: with half of them it can hardly be told.
        if self.settings.max_sweeps and self.sweeps >= self.settings.sweeps and self.full:
            self._converged = posterior.convergence.reached
        return replace(posterior, sampling=replace(sampling, stopped=self._stopped))

    def prepare(self) -> None:
        """Find out, while nobody waits, what the next observation will ask for."""
        if self.settings.candidates == "visited" and not self._candidates.are_features:
            cells = self.placement.demonstration.cells[-1:]
            self._known.prepare(int(self._known.world.states_of(cells)[0]))

    def _is_about(self, grid_map: GridMap, settings: Settings) -> bool:
        """Whether this map, features included, and settings are its own."""
        return self.settings == settings and (
            grid_map is self.grid_map
            or (self.grid_map.is_same_as(grid_map) and self.grid_map.features is grid_map.features)
        )

    def _take_in(self, before: RunningPosterior) -> None:
        """Have a posterior at once, if observations were only added, and few are new."""
        told, particles = before._told, before._particles
        known, now = before.placement, self.placement
        count, new = len(known.poses), len(now.poses) - len(known.poses)
        if (
            told is None
            or particles is None
            or not particles.full
            or not 0 < new <= _AT_ONCE
            or not np.array_equal(known.poses, now.poses[:count])
            or any(
                not np.array_equal(were, getattr(now.demonstration, name)[:count])
                for name, were in vars(known.demonstration).items()
                if not name.startswith("last_")
            )
        ):
            return
        candidate_now = self._candidates_on(before)
        if (candidate_now < 0).any():
            return
        particles, left = taken_in(
            particles, before._model, self._model, candidate_now, self._generators[0]
        )
        self._particles = particles
        if left < _LEFT:
            return
        shape = self.settings.chains, EACH
        fields = vars(particles.draws).values()
        was, in_effect = told.convergence, left * len(particles.draws)
        draws = Draws(*(values.reshape(*shape, *values.shape[1:]) for values in fields))
        self._told = Posterior(
            candidates=self._candidates,
            demonstration=now.demonstration,
            draws=draws,
            mode=self._mode_from(before, candidate_now),
            settings=self.settings,
            model=self._model,
            sampling=Sampling(sweeps=0, burn_in=0, thin=1, stopped=None, seconds=0.0),
            convergence=replace(
                was, ess=None if was.ess is None else min(was.ess, in_effect), draws=EACH
            ),
        )

    def _mode_from(self, before: RunningPosterior, candidate_now: npt.NDArray[np.int64]) -> Mode:
        assert before._told is not None
        subgoal_of = np.append(candidate_now, -1).astype(np.int32)[before._told.mode.subgoal_of]
        if isinstance(self._model, SubgoalMixture):
            return mode.extended(self._model, subgoal_of)
        self._middle = before._middle
        return pursuit_mode.extended(self._model, subgoal_of, self._middle)

    @property
    def _states(self) -> list[Any]:
        """Where the chains are; those before go on when they are first asked for."""
        before, self._before = self._before, None
        if before:
            _, old, new = np.intersect1d(
                before.placement.poses, self.placement.poses, return_indices=True
            )
            row_before = np.full(len(self.placement.poses), -1, dtype=np.int64)
            row_before[new] = old
            candidate_now = self._candidates_on(before)
            self._chains = [
                self._sampler.going_on(self._model, state, row_before, candidate_now, generator)
                for state, generator in zip(before._states, self._generators, strict=True)
            ]
        return self._chains

    def _candidates_on(self, before: RunningPosterior) -> npt.NDArray[np.int64]:
        """(G before,) present index of each candidate before; -1 for none.

        Cells are told by their places, features by their coordinates.
        """
        old, now = before._candidates, self._candidates
        keys = old.coordinates
        if self._known is before._known and np.array_equal(keys, now.coordinates):
            return np.arange(len(old))
        if old.are_features != now.are_features:
            return np.full(len(old), -1, dtype=np.int64)
        if not old.are_features:
            keys = self.grid_map.cells_of(before.grid_map.centres_of(keys))
        index_of = {tuple(key): index for index, key in enumerate(now.coordinates.tolist())}
        return np.array([index_of.get(tuple(key), -1) for key in keys.tolist()], dtype=np.int64)
