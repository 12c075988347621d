"""Several chains side by side, reproducible bit for bit whatever the number of cores."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event

import numpy as np

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.samplers import Model, sampler_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.threads import workers

_SWEEPS_AT_ONCE = 50  # between two looks at whether to stop

Progress = Callable[[int], None]
"""Called, from any thread, with the number of sweeps done since the last call."""


class StoppedError(Exception):
    """The inference was asked to stop before its end."""


def run_chains(
    model: Model,
    settings: Settings,
    progress: Progress | None = None,
    stop: Event | None = None,
    threads: int | None = None,
) -> Draws:
    """Draws (chain, draw, N) of fresh chains, each with a generator of its own from the seed.

    `threads` is how many chains run at the same time; by default one on each core.

    Raises:
        StoppedError: `stop` was set meanwhile.
    """
    stop = stop or Event()
    sampler = sampler_of(model)
    draws = sampler.room_for(model, (settings.chains, settings.draws))

    def run_chain(chain: int, seed: np.random.SeedSequence) -> None:
        generator = np.random.default_rng(seed)
        state = sampler.initial_state(model, generator)
        burnt = sampler.room_for(model, (1,))  # where a chain is after part of the burn-in
        parts = [(burnt, sweeps) for sweeps in _parts(settings.burn_in, _SWEEPS_AT_ONCE)]
        *between, last = _parts(settings.thin, _SWEEPS_AT_ONCE)
        start = 0
        for count in _parts(settings.draws, max(1, _SWEEPS_AT_ONCE // settings.thin)):
            parts += [(burnt, sweeps) for sweeps in between]
            parts.append((draws[chain][start : start + count], last))
            start += count
        for part, thin in parts:
            if stop.is_set():
                raise StoppedError
            sampler.advance(model, state, generator, part, thin)
            if progress:
                progress(len(part) * thin)

    seeds = np.random.SeedSequence(settings.seed).spawn(settings.chains)
    with workers(settings.chains, threads) as executor:
        try:
            list(executor.map(run_chain, range(settings.chains), seeds))
        except BaseException:
            stop.set()  # Ctrl-C should not wait for the chains' end
            raise
    return draws


def _parts(whole: int, size: int) -> list[int]:
    """`whole` in parts of `size`, the last one smaller."""
    return [min(size, whole - start) for start in range(0, whole, size)]
