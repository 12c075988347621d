"""What a draw of the sequential model costs for each observation and candidate, on one core.

    make benchmark
    python benchmarks/sequential.py --only "one episode"

A draw is a whole sweep: blocks, relocation, groups, parameters and slips, all of them inferred.
Its cost is the CPU time of one chain that has settled, over as many sweeps as bring round every
step that is not made in each. Kernels are compiled and cached first. Beside it, for the state of
the machine, the filter alone in plain numpy, which does for each observation what a draw cannot do
without: one product and sum over the candidates.

Then, for the shipped bags, effective samples for each second of CPU time: of log joint, number of
partitions and parameters the one that mixes worst, and alpha. At last, the memory that an
inference from a million observations takes at most, with as many draws as are ever kept, from the
demonstration to all result files but the picture.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.machine import machine
from bnirl_ros.inference import pursuit_gibbs
from bnirl_ros.inference.chains import run_chains
from bnirl_ros.inference.diagnostics import effective_sample_size
from bnirl_ros.inference.posterior import infer, model_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.pursuits import ALPHA, PRIORS, PursuitModel, pursuit_model
from bnirl_ros.resources import share_folder
from bnirl_ros.views.results import posterior_arrays, subgoals_document, write_arrays

BOUND = 2.0  # [ns] for each observation and candidate
MEMORY_BOUND = 2.0  # [GiB] for a million observations
CONFIDENCE, SLIP = 3.0, 0.05
SETTLING, SWEEPS, RUNS = 60, 24, 5
BAGS = ("paper_loop", "overcooked_random3", "turtle_waypoints")


def demonstrated(
    world: GridWorld, episodes: int, length: int, subgoals: int, seed: int = 0
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """States, actions and starts of episodes that go from one of a few subgoals to another."""
    generator = np.random.default_rng(seed)
    free = np.flatnonzero(world.free)
    goals = generator.choice(free, size=subgoals, replace=False)
    truth = pursuit_model(world, free, np.zeros(len(free)), free == free[0], goals)
    outcomes, row_of = world.outcomes(), np.full(world.state_count, -1)
    row_of[free] = np.arange(len(free))
    policies = truth.action_likelihood(np.array([CONFIDENCE, 1.0, SLIP, 0.0, 0.0, 0.0]))
    # Only what the demonstrator can reach from where it is, and not where it is.
    parts = world.parts_of(free)
    goal_part = parts[row_of[goals]]
    state = generator.choice(free[np.isin(parts, goal_part)], size=episodes)
    goal = np.full(episodes, -1)
    states, actions = np.empty((2, episodes, length), dtype=np.int64)
    for step in range(length):
        arrived = (goal < 0) | (goals[goal] == state)
        odds = (goal_part == parts[row_of[state]][:, np.newaxis]) + 0.0
        odds[np.arange(episodes), goal] *= np.where(goal < 0, 1.0, 1e-9)
        chosen = (
            odds.cumsum(axis=1) > generator.random((episodes, 1)) * odds.sum(axis=1, keepdims=True)
        ).argmax(axis=1)
        goal = np.where(arrived, chosen, goal)
        likely = policies[row_of[state], :, goal].cumsum(axis=1)
        action = (likely > generator.random((episodes, 1)) * likely[:, -1:]).argmax(axis=1)
        states[:, step], actions[:, step] = state, action
        wrong = generator.integers(len(world.actions), size=episodes)
        taken = np.where(generator.random(episodes) < world.success, action, wrong)
        state = outcomes[state, taken]
    starts = np.zeros((episodes, length), dtype=np.bool_)
    starts[:, 0] = True
    return states.reshape(-1), world.actions[actions.reshape(-1)], starts.reshape(-1)


def model_with(
    free: npt.NDArray[np.bool_], episodes: int, length: int, candidates: int
) -> PursuitModel:
    """The model of such a demonstration with so many candidates, spread over the map."""
    world = GridWorld(free)
    states, actions, starts = demonstrated(world, episodes, length, subgoals=8)
    cells = np.flatnonzero(world.free)
    spread = cells[np.linspace(0, len(cells) - 1, candidates).astype(int)]
    return pursuit_model(world, states, actions, starts, spread)


def in_parts(height: int, width: int, parts: int) -> npt.NDArray[np.bool_]:
    """A map with walls from bottom to top that part it into equal rooms."""
    free = np.ones((height, width), dtype=np.bool_)
    free[:, width // parts : -1 : width // parts] = parts == 1
    return free


def cost_of_draw(model: PursuitModel) -> float:
    """CPU time [s] of a draw of one chain that has settled: the least mean of several runs."""
    generator = np.random.default_rng(0)
    state = pursuit_gibbs.initial_state(model, generator)
    pursuit_gibbs.advance(model, state, generator, pursuit_gibbs.room_for(model, (1,)), SETTLING)
    draws = pursuit_gibbs.room_for(model, (SWEEPS,))
    times = []
    for _ in range(RUNS):
        begin = time.thread_time()
        pursuit_gibbs.advance(model, state, generator, draws)
        times.append((time.thread_time() - begin) / SWEEPS)
    return min(times)


def cost_of_filter(model: PursuitModel) -> float:
    """CPU time [s] of filtering alone, by plain numpy: the least of several runs."""
    kernel = pursuit_gibbs.kernel_model(model)
    chosen = pursuit_gibbs.softmax_table(kernel, CONFIDENCE)
    weights = model.prior / model.prior.sum()
    times = []
    for _ in range(RUNS):
        begin = time.thread_time()
        belief = weights
        for pair in kernel.pair_of:
            belief = (belief * 0.95 + 0.05 * weights) * chosen[pair]
            belief /= belief.sum()
        times.append(time.thread_time() - begin)
    return min(times)


def effective_samples(name: str) -> dict[str, float]:
    """Of a shipped bag, for each quantity the effective samples for each second of CPU time."""
    recorded = read_demonstration(share_folder() / "bags" / name, {})
    assert recorded.grid_map is not None
    demonstration = place(recorded.recording, recorded.grid_map).demonstration
    settings = Settings()
    _, model = model_of(demonstration, recorded.grid_map, settings)
    begin = time.process_time()
    draws = run_chains(model, settings, threads=1)
    spent = time.process_time() - begin
    traces = {"log joint": draws.log_joint, "partitions": draws.partition_count}
    traces |= {each: draws.parameters[..., column] for column, each in enumerate(PRIORS)}
    return {each: (effective_sample_size(of) or 0.0) / spent for each, of in traces.items()}


def infer_from_a_million() -> None:
    """A million observations in 2,000 episodes along the corridors of a map of 100 x 100 cells."""
    free = np.zeros((100, 100), dtype=np.bool_)
    free[::33] = free[:, ::33] = True  # 784 cells, all of them candidates
    grid_map = GridMap(free)
    world = GridWorld(free)
    states, actions, starts = demonstrated(world, episodes=2000, length=500, subgoals=8)
    nowhere = np.empty(0, dtype=np.int64)
    demonstration = Demonstration(
        np.cumsum(starts) - 1, world.cells_of(states), actions, nowhere, nowhere.reshape(0, 2)
    )
    # 132 draws of all chains: the most that fit into the limit.
    posterior = infer(demonstration, grid_map, Settings(sweeps=36, burn_in=3))
    assert posterior.settings.thin == 1
    summary = summarise(posterior, grid_map)
    subgoals_document(summary, grid_map, posterior.settings)
    with tempfile.TemporaryDirectory() as folder:
        write_arrays(Path(folder) / "posterior.npz", posterior_arrays(posterior))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)


def memory_for_a_million() -> float:
    """The most memory that a process took for that [GiB]."""
    command = [sys.executable, __file__, "--million"]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


CASES = {
    "1,000 candidates, 20 episodes": (in_parts(25, 40, 1), 20, 500, 1000),
    "1,000 candidates, one episode": (in_parts(25, 40, 1), 1, 10_000, 1000),
    "1,000 candidates, 500 episodes": (in_parts(25, 40, 1), 500, 20, 1000),
    "1,000 candidates, four parts": (in_parts(25, 44, 4), 20, 500, 1000),
    "1,000 candidates, 10,000 cells": (in_parts(100, 100, 1), 20, 500, 1000),
    "200 candidates, 20 episodes": (in_parts(25, 40, 1), 20, 500, 200),
}


def main() -> int:
    """Print a table, and whether the bound is kept."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--million", action="store_true", help="infer from a million, no table")
    options = parser.parse_args()
    if options.million:
        infer_from_a_million()
        return 0
    only = options.only
    print(machine())
    print(f"{'':36s}{'ms a draw':>12s}{'ns':>8s}{'numpy filter':>15s}  at most {BOUND:g} ns")
    kept = True
    for name, (free, episodes, length, candidates) in CASES.items():
        if only not in name:
            continue
        model = model_with(free, episodes, length, candidates)
        spent = cost_of_draw(model)
        filtering = cost_of_filter(model)
        each = spent * 1e9 / (len(model.state_of) * candidates)
        kept &= each <= BOUND
        verdict = "" if each <= BOUND else "BROKEN"
        cost = f"{spent * 1e3:12.2f}{each:8.2f}{filtering * 1e3:12.2f} ms"
        print(f"{name:36s}{cost}  {verdict}", flush=True)
    print(f"\n{'effective samples a second':36s}{'worst':>8s}{'alpha':>8s}")
    for name in BAGS:
        sizes = effective_samples(name)
        worst = min(sizes, key=sizes.__getitem__)
        alpha = sizes[list(PRIORS)[ALPHA]]
        print(f"{name:36s}{sizes[worst]:8.0f}{alpha:8.0f}  {worst}", flush=True)
    memory = memory_for_a_million()
    kept &= memory <= MEMORY_BOUND
    verdict = "" if memory <= MEMORY_BOUND else "BROKEN"
    print(f"\na million observations: {memory:.2f} GiB, at most {MEMORY_BOUND:g}  {verdict}")
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
