"""How long goal values take, beside others who solve the same MDP in the same run.

    make benchmark
    python benchmarks/goal_values.py --goals 10

The others are QuantEcon's DiscreteDP, by sparse modified policy iteration with the best of several
lengths, and the sweeps in four alternating orders that solve any rewards on a map. QuantEcon can
stop on an absolute bound only: 1e-6 of V, which is up to 100 here, and the same for us. The line
below has a relative bound of 1e-6 on the first-passage values h instead, at every cell, however
far. One thread. Errors are those of h, against a solve with a relative bound of 1e-13.

QuantEcon is compared with if it is installed: `pip install quantecon`.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import vstack

from bnirl_ros.experiments.machine import machine
from bnirl_ros.maps import load_map
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.mdp.process import first_passage_by_sweeps

BOUND = 1e-6
LENGTHS = (10, 20, 50, 100)  # of the evaluation of a policy, by QuantEcon
SIZES = {20: 1 / 40, 100: 1 / 30}  # cells to a side, and at most this part of QuantEcon's time
LARGE, LARGE_BOUND = 300, 8.0  # [s] of one core: four seconds of two
WAREHOUSE = Path("../shared/data/maps/warehouse.yaml")  # 1,006 x 1,674 cells, from elsewhere
WAREHOUSE_BOUND = 1.0  # [s] for one goal
RUNS = 3

Values = npt.NDArray[np.float64]


def timed(run: Callable[[], Values]) -> tuple[float, Values]:
    """The least time of several runs [s], and what comes out."""
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        values = run()
        times.append(time.perf_counter() - begin)
    return min(times), values


def of_quantecon(world: GridWorld, goals: npt.NDArray[np.int64]) -> tuple[float, int]:
    """The least time for so many goals [s], and the length that it was reached with.

    Ten of them are solved, and the time is scaled.
    """
    discrete_dp = importlib.import_module("quantecon").markov.DiscreteDP
    layers = world.transitions()
    states = np.tile(np.arange(world.state_count), len(layers))
    actions = np.repeat(np.arange(len(layers)), world.state_count)
    order = np.lexsort((actions, states))
    transitions: Any = vstack(layers).tocsr()[order]
    states, actions = states[order], actions[order]
    some = goals[:: max(1, len(goals) // 10)]
    process = discrete_dp(np.zeros(len(states)), transitions, world.discount, states, actions)
    best = np.inf, 0
    for length in LENGTHS:
        begin = time.perf_counter()
        for goal in some:
            process.R = (states == goal).astype(np.float64)
            process.solve("modified_policy_iteration", epsilon=BOUND, max_iter=10**6, k=length)
        passed = (time.perf_counter() - begin) * len(goals) / len(some)
        best = min(best, (passed, length))
    return best


def solved_by_us(world: GridWorld, goals: npt.NDArray[np.int64]) -> float:
    """Print our lines; returns the time with the absolute bound [s]."""
    world.first_passage(goals[:1], 0.1)
    first_passage_by_sweeps(world, goals[:1], 0.1)
    true = world.first_passage(goals, 1e-13)
    # V = h V(g), with V(g) <= 1 / (1 - gamma). If gamma max_a E[h] differs from h by r, then
    # R + gamma max_a E[V] from V by V(g) r, and V from what it should be by V(g) r / (1 - gamma).
    residual = BOUND * (1.0 - world.discount) ** 2
    bound = residual / (2.0 - world.discount)
    size = f"{world.free.shape[1]} x {world.free.shape[0]}"
    ways: dict[str, Callable[[], Values]] = {
        "V within 1e-6": lambda: world.first_passage(goals, bound, residual),
        "h within 1e-6 of itself": lambda: world.first_passage(goals, BOUND),
        "four orders, V within 1e-6": lambda: first_passage_by_sweeps(world, goals, bound),
    }
    taken = []
    for what, run in ways.items():
        seconds, values = timed(run)
        taken.append(seconds)
        off = np.abs(values - true)
        print(
            f"{f'{size}, {what}':44} {seconds:9.4f} {off.max():9.1e} {(off / true).max():9.1e}",
            flush=True,
        )
    return taken[0]


def solved_in(path: Path) -> bool:
    """Print lines for single goals on a map; returns whether each was there in time."""
    free = load_map(path).free
    states = np.flatnonzero(free)
    in_time = True
    for moves in (8, 4):
        world = GridWorld(free, moves=moves)
        world.first_passage(states[:1], 1e6)
        for goal in states[[len(states) // 3, 2 * len(states) // 3]]:
            begin = time.perf_counter()
            world.first_passage(np.array([goal]), BOUND)
            passed = time.perf_counter() - begin
            print(f"{f'{path.stem}, {moves} moves, one goal':44} {passed:9.4f}", flush=True)
            in_time &= passed <= WAREHOUSE_BOUND
    return in_time


def main() -> int:
    """Print a line for each way and size; returns the exit status."""
    parser = argparse.ArgumentParser(description="How long do goal values take?")
    parser.add_argument("--goals", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--map", type=Path, default=WAREHOUSE, help="a large one (%(default)s)")
    given = parser.parse_args()
    count = given.goals
    with_peer = importlib.util.find_spec("quantecon") is not None
    print(machine(("numpy", "numba", *(["quantecon"] if with_peer else []))))
    print(f"{f'{count} goals':44} {'[s]':>9} {'error':>9} {'relative':>9}")
    broken = False
    for size in (*SIZES, LARGE):
        world = GridWorld(np.ones((size, size), dtype=bool))
        goals = np.sort(np.random.default_rng(0).choice(size * size, count, replace=False))
        ours = solved_by_us(world, goals)
        slow = size == LARGE and ours > LARGE_BOUND * count / 100
        if with_peer and size in SIZES:
            peer, length = of_quantecon(world, goals)
            slow = ours > SIZES[size] * peer
            what = f"{size} x {size}, QuantEcon, k = {length}"
            print(f"{what:44} {peer:9.4f}   {peer / ours:.0f} times ours", flush=True)
        if slow:
            print("BROKEN: that is too slow")
        broken |= slow
    if not given.map.exists():
        print(f"{given.map} is not there: no large map")
    elif not solved_in(given.map):
        print(f"BROKEN: one goal is to take {WAREHOUSE_BOUND:g} s")
        broken = True
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
