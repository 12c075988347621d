"""How long the main job takes: from a bag to the result files, and what its parts take.

    make benchmark

Times are wall-clock; compare runs on one machine only. Kernels are compiled and cached first.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.inference.chains import run_chains
from bnirl_ros.inference.posterior import infer, mode_of, model_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.resources import share_folder

BAGS = ("paper_loop", "overcooked_random3")
MODELS = ("sequential", "paper")


def timed(what: str, runs: int, run: Callable[[], object]) -> None:
    """Print minimum, median and maximum of several runs, after one that doesn't count."""
    run()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    print(f"{what:40s} {min(times):8.3f} {median(times):8.3f} {max(times):8.3f}", flush=True)


def command(bag: Path, settings: Settings, out: Path) -> None:
    """`bnirl infer` as a process of its own, start of the interpreter included."""
    arguments = ["infer", str(bag), "--out", str(out), "--model", settings.model]
    subprocess.run(
        [sys.executable, "-m", "bnirl_ros.cli", *arguments], check=True, stdout=subprocess.DEVNULL
    )


def benchmark_bag(name: str, settings: Settings) -> None:
    """The parts of `bnirl infer` on a shipped bag, and the whole."""
    bag = share_folder() / "bags" / name
    recorded = read_demonstration(bag, {})
    assert recorded.grid_map is not None
    grid_map = recorded.grid_map
    demonstration = place(recorded.recording, grid_map).demonstration
    _, model = model_of(demonstration, grid_map, settings)
    draws = run_chains(model, settings)
    print(f"{name}, {settings.model} model: {len(demonstration)} observations")
    timed("  read", 5, lambda: read_demonstration(bag, {}))
    timed("  4 chains of 1000 sweeps", 5, lambda: run_chains(model, settings))
    timed("  mode", 5, lambda: mode_of(model, draws))
    with tempfile.TemporaryDirectory() as out:
        timed("  bnirl infer, as a process", 5, lambda: command(bag, settings, Path(out)))
    posterior = infer(demonstration, grid_map, settings)
    agreed = posterior.convergence
    print(
        f"  R-hat {agreed.rhat:.3f}, effective sample size {agreed.ess:.0f} of {agreed.ess_of}, "
        f"{posterior.ess_per_second:.0f} a second"
    )


def main() -> None:
    """Print a table of seconds."""
    print(f"{'':40s} {'least':>8s} {'median':>8s} {'most':>8s}  [s]")
    world = GridWorld(np.ones((20, 20), dtype=bool))
    states = np.arange(400)
    timed("100 goals on 20 x 20 cells", 20, lambda: goal_values(world, states[:100], states))
    for name in BAGS:
        for model in MODELS:
            benchmark_bag(name, Settings(model=model))


if __name__ == "__main__":
    main()
