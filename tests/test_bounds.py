"""Kernels stay within their arrays: their source in plain Python, where numpy checks each index.

Compiled kernels check none. What they are compiled from reads and writes the same elements, and
compiling it with numba's checks takes five times as long as running it here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
from dataclasses import replace

import numba
import numpy as np
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.prediction import predict
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld

for seed in range(60):
    generator = np.random.default_rng(seed)
    free = generator.random((1 + seed % 4, 1 + seed % 5)) < 0.8
    free.flat[seed % free.size] = True
    y, x = np.nonzero(free)
    count = int(generator.integers(1, 40))
    moves = (4, 8)[seed % 2]
    world = GridWorld(free, moves)
    actions = world.actions
    parts = world.parts_of(world.states_of(np.column_stack([x, y])))
    at = generator.integers(len(x), size=count)
    at = at[np.argsort(parts[at], kind="stable")]
    demonstration = Demonstration(
        # An episode stays in one part of the map, as real ones do.
        episode=np.cumsum(np.diff(parts[at], prepend=-1) != 0),
        cells=np.column_stack([x, y])[at],
        action=generator.choice(actions, size=count),
        last_episode=np.zeros(0, dtype=np.int64),
        last_cells=np.zeros((0, 2), dtype=np.int64),
    )
    eta = float(10.0 ** generator.uniform(-2, 4))
    alpha = float(10.0 ** generator.uniform(-1, 2))
    paper = Settings(
        model="paper", alpha=alpha, eta=eta, moves=moves, sweeps=12, burn_in=4, chains=2,
        candidates=("visited", "free")[seed % 3 == 0],
    )
    posterior = infer(demonstration, GridMap(free), paper)
    assert np.isfinite(posterior.draws.log_joint).all()
    assert posterior.mode.log_joint >= posterior.draws.log_joint.max() - 1e-9
    some = (alpha, eta, 0.0, 1.0, 0.5, 0.0)
    names = ("alpha", "eta", "slip", "switch_on_arrival", "switch_at_subgoal", "switch_elsewhere")
    fixed = {name: value for name, value in zip(names, some) if generator.random() < 0.3}
    sequential = replace(
        paper, **{"alpha": None, "eta": None, **fixed}, model="sequential",
        arrival_radius=float(generator.choice([0.0, 1.0, 2.0])),
        likelihood=("delay", "value")[seed % 5 == 0],
    )
    posterior = infer(demonstration, GridMap(free), sequential)
    assert np.isfinite(posterior.draws.log_joint).all()
    assert np.isfinite(posterior.mode.log_joint)
    assert posterior.pursuit_counts().sum(axis=1).max() <= count
    if seed < 10:
        probability = predict(posterior, demonstration, GridMap(free)).probability
        np.testing.assert_allclose(probability.sum(axis=1), 1.0)
    if seed < 5:
        goals = world.states_of(np.column_stack([x, y]))
        mdp = FiniteMDP.from_transitions(world.transitions(), 0.9)
        goal_values(mdp, goals, np.arange(world.state_count))
assert numba.config.DISABLE_JIT
print("within bounds")
"""


def test_kernels_stay_within_their_arrays() -> None:
    root = Path(__file__).resolve().parent.parent
    environment = {
        **os.environ,
        "NUMBA_DISABLE_JIT": "1",
        "PYTHONPATH": str(root),
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment
    )
    assert done.stdout == "within bounds\n", done.stderr
