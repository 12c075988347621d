"""How soon a running posterior of 10,000 observations takes one more into account.

    make benchmark
    python benchmarks/running.py --additions 30

From the moment at which the recorder has the observation until there is a posterior of all of
them: placing the recording on the map, and the posterior itself. Then what else is published: the
summary, and for the sequential model the filter of the intent. Some observations are made in a
cell that was visited before, others in a new one, which is a new candidate as well. Between two of
them the chains sweep, and the next cells are prepared, as in `subgoal_node` while nobody waits.

Times are the processor's, all threads together. The bound is on the least, since what else runs on
the machine makes also these longer. Exit status 1 where it is broken.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from statistics import median

import numpy as np

from bnirl_ros.demonstrations.placement import place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.experiments.machine import machine
from bnirl_ros.experiments.scenarios import PAPER_LOOP, demonstrate
from bnirl_ros.inference.intent import IntentFilter
from bnirl_ros.inference.running import RunningPosterior
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import STEPS

OBSERVATIONS = 10_000
SUCCESS = 0.98  # of a move: about a hundred cells are visited
SIDES = (20, 100)
BOUND = 5.0  # [ms]
SWEEPS = 50  # before the first addition
STEP, GAP = 500_000_000, 10_000_000_000  # [ns] between poses, and between episodes
COLUMNS = ("place", "posterior", "both", "summary", "intent")


class Walk:
    """Many times round the paper's loop, recorded."""

    def __init__(self, observations: int) -> None:
        self.recorder = Recorder()
        self.recorder.map_arrived()
        self._stamp = 0
        loop = replace(PAPER_LOOP, episodes=1 + observations // 30, success=SUCCESS)
        seen = demonstrate(loop, np.random.default_rng(0))
        for episode, x, y, action in seen.observations[:observations].tolist():
            self._episode, self.cell = episode, np.array([x, y])
            self.go(STEPS[action])

    def go(self, step: np.ndarray) -> None:
        """One more observation."""
        x, y = self.cell + 0.5
        stamp = self._stamp + GAP * self._episode
        self.recorder.add_pose(stamp, "map", float(x), float(y))
        self.recorder.add_action(stamp, float(step[0]), float(step[1]))
        self.cell = self.cell + step
        self._stamp += STEP


def clock() -> float:
    """The processor's time of this process [s]: what else runs on the machine is left out."""
    return time.process_time()


def benchmark(model: str, side: int, additions: int) -> list[tuple[str, float]]:
    """Print what additions take; returns the least of both parts, old cells and new ones [ms]."""
    grid_map, settings = GridMap(np.ones((side, side), dtype=np.bool_)), Settings(model=model)
    walk = Walk(OBSERVATIONS)
    cells = {(x, y) for x in range(side) for y in range(side)}
    placement = place(walk.recorder.snapshot(), grid_map)
    visited = set(map(tuple, placement.demonstration.cells.tolist()))
    running = RunningPosterior(placement, grid_map, settings)
    while running.sweeps < SWEEPS:
        running.advance(1)
    running.posterior()
    print(f"{model} model, {side} x {side} cells, {len(visited)} candidates")
    swept = 0
    times: dict[str, list[list[float]]] = {"a cell visited before": [], "a new cell": []}
    intent = None
    while min(map(len, times.values())) < 1 + additions:
        running.advance(1)
        running.prepare()
        cell = tuple(walk.cell.tolist())
        kind = "a cell visited before" if cell in visited else "a new cell"
        visited.add(cell)
        # On to the next new cell, with a stay where one was reached.
        new = np.array(sorted(cells - visited))
        nearest = new[np.abs(new - walk.cell).max(axis=1).argmin()]
        walk.go(np.sign(nearest - walk.cell) if kind != "a new cell" else np.zeros(2, dtype=int))
        begin = clock()
        placement = place(walk.recorder.snapshot(), grid_map)
        placed = clock()
        after = RunningPosterior(placement, grid_map, settings, running)
        swept += not after.ready
        if not after.ready:
            after.advance(1)
        posterior = after.posterior()
        known = clock()
        assert posterior.draws.subgoal_of.shape[-1] == len(placement.poses)
        summary = summarise(posterior, grid_map)
        summarised = clock()
        if model == "sequential":
            intent = IntentFilter(posterior, summary, grid_map, intent)
        end = clock()
        parts = [placed - begin, known - placed, known - begin, summarised - known]
        times[kind].append([1e3 * part for part in (*parts, end - summarised)])
        running = after
    print(f"  of these, after a sweep: {swept}")
    least = []
    for kind, every in times.items():
        columns = list(zip(*every[1:], strict=True))  # kernels are loaded in the first
        middle = [median(column) for column in columns]
        print(f"  {kind:24}" + "".join(f"{value:10.2f}" for value in middle), flush=True)
        least.append((f"{model} model, {side} x {side} cells, {kind}", min(columns[2])))
    return least


def main() -> int:
    """Print a table of milliseconds, and what bounds are broken."""
    parser = argparse.ArgumentParser(description="Time what one more observation takes.")
    parser.add_argument("--additions", type=int, default=15, help="of each kind (%(default)s)")
    additions = parser.parse_args().additions
    print(machine())
    print(f"{'medians [ms]':26}" + "".join(f"{name:>10}" for name in COLUMNS))
    least = [
        each
        for model in ("sequential", "paper")
        for side in SIDES
        for each in benchmark(model, side, additions)
    ]
    for what, passed in least:
        verdict = "" if passed <= BOUND else "  BROKEN"
        print(f"{what:56} {passed:6.2f} ms, at most {BOUND:g}{verdict}")
    return int(any(passed > BOUND for _, passed in least))


if __name__ == "__main__":
    sys.exit(main())
