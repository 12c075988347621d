"""Are chains that are said to have converged right, and how many effective samples a second?

    make benchmark
    python benchmarks/convergence.py --seeds 200 --bags paper_loop

Inferences with many seeds go on until their chains have converged, from few sweeps on so that they
look often. The subgoals' probabilities are compared with those of one long run of other chains;
the error of an inference is that of the cell for which it is largest. With an effective sample
size of 400 a probability has a standard error of 0.025 at the most, so that one of twenty cells is
off by 0.075 now and then. One thread; kernels are compiled and cached first.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.machine import machine
from bnirl_ros.fleet.reading import Reading, Remark, read
from bnirl_ros.inference.chains import CONVERGED
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.resources import share_folder

BAGS = ("paper_loop", "turtle_waypoints")
MODELS = ("sequential", "paper")
SWEEPS, BURN_IN, MAX_SWEEPS = 200, 50, 51_200
LONG = 10_000  # sweeps to compare with
ERROR_BOUND = 0.1  # four standard errors
SHARE_BOUND = 0.02  # of the converged inferences may be off by more than that


def read_bag(name: str) -> tuple[Demonstration, GridMap]:
    """A shipped bag's demonstration, and its map."""
    remarks: list[Remark] = []
    placed = read(share_folder() / "bags" / name, Reading(), remarks.append)
    return placed.demonstration, placed.grid_map


def is_right(name: str, model: str, seeds: int, sweeps: int) -> bool:
    """Print the line of a bag and a model; returns whether converged inferences are right."""
    demonstration, grid_map = read_bag(name)
    settings = Settings(model=model, sweeps=SWEEPS, burn_in=BURN_IN, max_sweeps=MAX_SWEEPS)
    long = Settings(model=model, sweeps=sweeps, burn_in=sweeps // 10, thin=10, seed=10**6)
    infer(demonstration, grid_map, Settings(model=model, sweeps=2, burn_in=0), threads=1)
    truth = infer(demonstration, grid_map, long, threads=1)
    expected = truth.subgoal_probability()
    errors, rates, done, slowest = [], [], [], []
    for seed in range(seeds):
        found = infer(demonstration, grid_map, replace(settings, seed=seed), threads=1)
        rates.append(found.ess_per_second or np.nan)
        slowest.append(found.convergence.ess_of)
        if found.sampling.stopped == CONVERGED:
            errors.append(float(np.abs(found.subgoal_probability() - expected).max()))
            done.append(found.sampling.sweeps)
    off = np.array(errors)
    worst = max(set(slowest), key=slowest.count)
    told = "-  " * 4
    if errors:
        told = (
            f"{np.median(done):8.0f} {max(done):8d}  {np.median(off):7.3f} "
            f"{np.quantile(off, 0.95):7.3f} {off.max():7.3f}"
        )
    print(
        f"{f'{name}, {model}':32} {len(errors):4d} of {seeds:<4d} {told}  "
        f"{np.nanmedian(rates):8.0f}  {worst}; in the long run R-hat "
        f"{truth.convergence.rhat or np.nan:.3f}, {truth.convergence.ess or np.nan:.0f}",
        flush=True,
    )
    return bool((off > ERROR_BOUND).mean() <= SHARE_BOUND) if errors else True


def main() -> int:
    """Print a line for each bag and model; returns the exit status."""
    parser = argparse.ArgumentParser(description="Is what is said to have converged right?")
    parser.add_argument("--seeds", type=int, default=5, help="(%(default)s)")
    parser.add_argument("--bags", nargs="+", default=BAGS, metavar="BAG", help="of the shipped")
    parser.add_argument("--models", nargs="+", default=MODELS, choices=MODELS, metavar="MODEL")
    parser.add_argument("--long", type=int, default=LONG, help="sweeps (%(default)s)")
    given = parser.parse_args()
    print(machine(("numpy", "numba")))
    print(
        f"{'':32} {'converged':>12} {'sweeps':>8} {'most':>8}  {'error':>7} {'95 %':>7} "
        f"{'most':>7}  {'ESS/s':>8}  slowest"
    )
    right = True
    for name in given.bags:
        for model in given.models:
            if not is_right(name, model, given.seeds, given.long):
                print(f"BROKEN: more than {SHARE_BOUND:.0%} are off by more than {ERROR_BOUND:g}")
                right = False
    return int(not right)


if __name__ == "__main__":
    sys.exit(main())
