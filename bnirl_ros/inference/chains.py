"""Several chains side by side, reproducible bit for bit whatever the number of cores."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event
from typing import Any

import numpy as np

from bnirl_ros.inference.convergence import LEAST_ESS
from bnirl_ros.inference.draws import Draws, most_draws
from bnirl_ros.inference.samplers import Model, sampler_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.threads import workers

CONVERGED, SWEEP_LIMIT, TIME_BUDGET = "converged", "sweep limit", "time budget"
"""What may stop chains."""

_SWEEPS_AT_ONCE = 50  # between two looks at whether to stop
_SECONDS_AT_ONCE = 0.25  # between two looks at the clock, roughly

Progress = Callable[[int], None]
"""Called, from any thread, with the number of sweeps done since the last call."""


class StoppedError(Exception):
    """The inference was asked to stop before its end."""


@dataclass(frozen=True)
class Sampling:
    """How draws came about.

    Attributes:
        sweeps: of each chain, burn-in included.
        burn_in: first sweeps of each chain that are left out.
        thin: of how many sweeps a draw was kept.
        stopped: CONVERGED, SWEEP_LIMIT or TIME_BUDGET; None of chains that are to go on.
        seconds: time that the sweeps took, of all chains together on however many cores [s].
    """

    sweeps: int
    burn_in: int
    thin: int
    stopped: str | None
    seconds: float


def run_chains(
    model: Model,
    settings: Settings,
    progress: Progress | None = None,
    stop: Event | None = None,
    threads: int | None = None,
) -> Draws:
    """Draws (chain, draw, N) of fresh chains, each with a generator of its own from the seed.

    There are as many sweeps as the settings say, without regard to convergence and time.
    `threads` is how many chains run at the same time; by default one on each core.

    Raises:
        StoppedError: `stop` was set meanwhile.
    """
    chains = _Chains(model, settings, progress, stop)
    draws = chains.room_for(settings.draws)

    def run(chain: int) -> None:
        chains.leave_out(chain, settings.burn_in)
        chains.fill(chain, draws[chain], settings.thin)

    with workers(settings.chains, threads) as executor:
        chains.each(executor.map, run)
    return draws


def run_until(
    is_enough: Callable[[Draws], bool],
    model: Model,
    settings: Settings,
    progress: Progress | None = None,
    stop: Event | None = None,
    threads: int | None = None,
) -> tuple[Draws, Sampling]:
    """Draws of fresh chains that go on until there are enough, as far as the settings let them.

    The draws are those that `run_chains` makes with the sweeps, the burn-in and the thinning that
    are returned. The burn-in remains the same share of the sweeps, if that is not more than half,
    and of more draws than there is room for every second is dropped. Whether it is enough is asked
    at sweeps of the settings, twice as many, four times as many, and so on.

    Args:
        is_enough: of draws (chain, draw, N).
        model: to draw from.
        settings: above all `sweeps`, `max_sweeps` and `time_budget`.
        progress, stop, threads: as in `run_chains`.

    Raises:
        StoppedError: `stop` was set meanwhile.
    """
    begin = time.monotonic()
    if not settings.max_sweeps and not settings.time_budget:
        draws = run_chains(model, settings, progress, stop, threads)
        passed = time.monotonic() - begin
        burn_in, thin = settings.burn_in, settings.thin
        return draws, Sampling(settings.sweeps, burn_in, thin, SWEEP_LIMIT, passed)
    chains = _Chains(model, settings, progress, stop)
    growing = _Growing(chains, settings)
    with workers(settings.chains, threads) as executor:
        chains.each(executor.map, growing.begin)
        target = settings.sweeps
        limit = max(settings.sweeps, settings.max_sweeps)
        at_once = 1 if settings.time_budget else limit
        while True:
            while count := growing.room_before(target, at_once):
                since = time.monotonic()
                chains.each(executor.map, growing.grow(count))
                now = time.monotonic()
                if settings.time_budget and now - begin >= settings.time_budget:
                    done = growing.sweeps
                    return growing.draws(done), growing.sampling(done, TIME_BUDGET, now - begin)
                if now - since < _SECONDS_AT_ONCE:
                    at_once = min(2 * at_once, limit)
            passed = time.monotonic() - begin
            if settings.max_sweeps and is_enough(growing.draws(target)):
                return growing.draws(target), growing.sampling(target, CONVERGED, passed)
            if target == limit:
                return growing.draws(target), growing.sampling(target, SWEEP_LIMIT, passed)
            target = min(2 * target, limit)


class _Chains:
    """Chains with their states, as they go on."""

    def __init__(
        self, model: Model, settings: Settings, progress: Progress | None, stop: Event | None
    ) -> None:
        seeds = np.random.SeedSequence(settings.seed).spawn(settings.chains)
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._states: list[Any] = [None] * settings.chains
        self._model, self._sampler = model, sampler_of(model)
        self._progress, self._stop = progress, stop or Event()

    def __len__(self) -> int:
        return len(self._states)

    @property
    def observations(self) -> int:
        """How many observations a draw has."""
        return self.room_for(1).subgoal_of.shape[-1]

    def room_for(self, draws: int) -> Draws:
        """Room for so many draws of each chain."""
        return self._sampler.room_for(self._model, (len(self), draws))

    def each(self, apply: Callable[..., Any], run: Callable[[int], None]) -> None:
        """Run something with the number of every chain."""
        try:
            list(apply(run, range(len(self))))
        except BaseException:
            self._stop.set()  # Ctrl-C should not wait for the chains' end
            raise

    def leave_out(self, chain: int, sweeps: int) -> None:
        """Start a chain, and let it sweep."""
        self._states[chain] = self._sampler.initial_state(self._model, self._generators[chain])
        self._go_on(chain, sweeps)

    def fill(self, chain: int, draws: Draws, thin: int) -> None:
        """Sweep on until the draws are filled, one in `thin` sweeps."""
        *between, last = _parts(thin, _SWEEPS_AT_ONCE)
        start = 0
        for count in _parts(len(draws), max(1, _SWEEPS_AT_ONCE // thin)):
            for sweeps in between:
                self._go_on(chain, sweeps)
            self._advance(chain, draws[start : start + count], last)
            start += count

    def _go_on(self, chain: int, sweeps: int) -> None:
        nowhere = self._sampler.room_for(self._model, (1,))  # where a chain is is not kept
        for part in _parts(sweeps, _SWEEPS_AT_ONCE):
            self._advance(chain, nowhere, part)

    def _advance(self, chain: int, draws: Draws, thin: int) -> None:
        if self._stop.is_set():
            raise StoppedError
        state, generator = self._states[chain], self._generators[chain]
        self._sampler.advance(self._model, state, generator, draws, thin)
        if self._progress:
            self._progress(len(draws) * thin)


class _Growing:
    """Draws of chains that go on, every `thin`-th from the first sweep, in bounded room."""

    def __init__(self, chains: _Chains, settings: Settings) -> None:
        self._chains, self._settings = chains, settings
        # So that those after the burn-in are the ones that are kept without going on.
        self._first = settings.burn_in % settings.thin
        self._thin = settings.thin
        self._kept = 0
        asked = (settings.sweeps - self._first) // settings.thin
        # Half of them may be burn-in; of two draws that are not alike one counts at the least.
        enough = 4 * int(LEAST_ESS) // len(chains)
        most = most_draws(len(chains), chains.observations)
        self._capacity = -(-max(asked, min(2 * enough, most)) // 2) * 2
        self._draws = chains.room_for(self._capacity)

    @property
    def sweeps(self) -> int:
        """Sweeps of each chain so far."""
        return self._first + self._kept * self._thin

    def begin(self, chain: int) -> None:
        """Start a chain."""
        self._chains.leave_out(chain, self._first)

    def room_before(self, target: int, sweeps: int) -> int:
        """How many draws can be added now, of so many sweeps, or one; none at the target."""
        if self._kept == self._capacity and self.sweeps + self._thin <= target:
            self._draws.drop_every_second()
            self._kept //= 2
            self._thin *= 2
        left = (target - self.sweeps) // self._thin
        return min(left, self._capacity - self._kept, max(1, sweeps // self._thin))

    def grow(self, count: int) -> Callable[[int], None]:
        """What adds so many draws to a chain; they count from now on."""
        part = slice(self._kept, self._kept + count)
        self._kept += count
        return lambda chain: self._chains.fill(chain, self._draws[chain][part], self._thin)

    def draws(self, sweeps: int) -> Draws:
        """Those after the burn-in, as a view, where there were so many sweeps."""
        kept = slice(self._left_out(sweeps), self._kept)
        return Draws(*(values[:, kept] for values in vars(self._draws).values()))

    def sampling(self, sweeps: int, stopped: str, seconds: float) -> Sampling:
        """How these draws came about."""
        burn_in = self._first + self._left_out(sweeps) * self._thin
        return Sampling(sweeps, burn_in, self._thin, stopped, seconds)

    def _left_out(self, sweeps: int) -> int:
        """How many draws are burn-in; all but one at the most."""
        burn_in, asked = self._settings.burn_in, self._settings.sweeps
        if sweeps > asked:
            burn_in = max(burn_in, min(burn_in * sweeps // asked, sweeps // 2))
        elif sweeps < asked:
            burn_in = min(burn_in, sweeps // 2)
        return min(max(0, burn_in - self._first) // self._thin, self._kept - 1)


def _parts(whole: int, size: int) -> list[int]:
    """`whole` in parts of `size`, the last one smaller."""
    return [min(size, whole - start) for start in range(0, whole, size)]
