"""What a draw costs: 10,000 observations, 200 candidates, one core."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.machine import one_core
from bnirl_ros.experiments.study.part import MODELS, SEED, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.experiments.study.simulated import Demonstrator, demonstrate
from bnirl_ros.inference.posterior import infer
from bnirl_ros.maps import GridMap

OBSERVATIONS = 10_000

MAP = GridMap(np.ones((10, 20), dtype=np.bool_))
"""200 free cells, all of them candidates."""

SAMPLING = {"chains": 1, "candidates": "free", "sweeps": 400, "burn_in": 50}

_EPISODES = 80  # more than are needed


def long_demonstration() -> Demonstration:
    """`OBSERVATIONS` of a demonstrator that goes from subgoal to subgoal."""
    generator = np.random.default_rng([SEED, OBSERVATIONS])
    whole, _ = demonstrate(Demonstrator(), MAP, generator, _EPISODES)
    assert len(whole) >= OBSERVATIONS
    episode = whole.episode[:OBSERVATIONS]
    ended = whole.last_episode < episode[-1]
    return Demonstration(
        episode=episode,
        cells=whole.cells[:OBSERVATIONS],
        action=whole.action[:OBSERVATIONS],
        last_episode=whole.last_episode[ended],
        last_cells=whole.last_cells[ended],
    )


def run(model: str) -> dict[str, Any]:
    """Draws a second, from the first sweeps that are reported to the last, and what goes before.

    A first inference, short, compiles the kernels.
    """
    demonstration = long_demonstration()
    infer(demonstration, MAP, settings_of(model, **(SAMPLING | {"sweeps": 51})))
    done, at = [0], [time.perf_counter()]

    def progress(sweeps: int) -> None:
        done.append(done[-1] + sweeps)
        at.append(time.perf_counter())

    with one_core():
        infer(demonstration, MAP, settings_of(model, **SAMPLING), progress)
        end = time.perf_counter()
    rate = (done[-1] - done[1]) / (at[-1] - at[1])
    return {"model": model, "draws_a_second": rate, "rest": end - at[0] - done[-1] / rate}


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each model."""
    return Table(
        title="What a draw costs",
        text=f"{OBSERVATIONS:,} observations with {MAP.free.sum()} candidates, one chain on one "
        "core: draws a second, and the seconds for all else (goal values before, the mode after).",
        header=("model", "draws a second", "all else [s]"),
        rows=tuple(
            (result["model"], f"{result['draws_a_second']:.0f}", f"{result['rest']:.1f}")
            for result in results
        ),
    )


def cases(recordings: Path) -> Sequence[str]:
    """The models."""
    return MODELS


PART = Part(name="cost", cases=cases, run=run, table=table, alone=True)
