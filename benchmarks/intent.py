"""How soon the subgoal node tells what is pursued, after a pose, while the chains go on.

    make benchmark
    python benchmarks/intent.py --poses 120

Over DDS, the node and the demonstrator in processes of their own. The demonstrator first sends
what it has done so far, fast, and then two poses a second, each with an action: in shipped bags,
where most cells were visited before, and on open maps, where it walks on through cells that nobody
has visited, each of them a new candidate, with goal values to be solved.

A delay is from just before the pose is published until the first `intent` with its stamp, or a
later one, is received. The node looks for something new every 0.1 s.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import tempfile
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from convergence import read_bag
from load import GAP, Demonstrator, Observer, take

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.machine import machine
from bnirl_ros.experiments.scenarios import PAPER_LOOP, demonstrate
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import STEPS

BAGS = ("overcooked_random3", "turtle_waypoints")
SIDES = (40, 100)  # of the open maps
RATE = 2.0  # poses a second
FAST = 500.0  # poses a second of what was done before
PERIOD = round(1e9 / RATE)  # [ns]
REST = 3.0  # [s] between what was done before and what follows, and in the end


def exploring(side: int, poses: int) -> tuple[Demonstration, GridMap]:
    """Times round the paper's loop on an open map, and then to the nearest new cell each time."""
    loop = replace(PAPER_LOOP, episodes=20, success=0.98)
    before = demonstrate(loop, np.random.default_rng(0))
    here = before.cells[-1] + STEPS[before.action[-1]]
    y, x = np.indices((side, side))
    new = set(zip(x.ravel().tolist(), y.ravel().tolist(), strict=True))
    new -= set(map(tuple, before.cells.tolist()))
    cells, actions = [], []
    for _ in range(poses):
        new.discard(tuple(here.tolist()))
        left = np.array(sorted(new))
        step = np.sign(left[np.abs(left - here).max(axis=1).argmin()] - here)
        cells.append(here)
        actions.append(int(np.flatnonzero((step == STEPS).all(axis=1))[0]))
        here = here + step
    episode = np.full(poses, before.episode[-1])
    whole = Demonstration(
        episode=np.append(before.episode, episode),
        cells=np.concatenate([before.cells, cells]),
        action=np.append(before.action, actions),
        last_episode=before.last_episode[:-1],
        last_cells=before.last_cells[:-1],
    )
    return whole, GridMap(np.ones((side, side), dtype=np.bool_))


def send(path: Path, seen: Demonstration, grid_map: GridMap, poses: int) -> None:
    """Publish a demonstration, the last poses slowly; then write their stamps and times [ns, s].

    Args:
        path: of an .npz with `stamp` and `sent` of the last poses.
        seen: what is published.
        grid_map: of it.
        poses: how many are published slowly.
    """
    demonstrator = Demonstrator(grid_map)
    stamps = PERIOD * np.arange(len(seen)) + GAP * seen.episode
    rows = zip(seen.cells.tolist(), seen.action.tolist(), stamps.tolist(), strict=True)
    for (x, y), action, stamp in islice(rows, len(seen) - poses):
        demonstrator.act((x, y), action, stamp)
        time.sleep(1.0 / FAST)
    time.sleep(REST)
    sent, begin = [], time.monotonic()
    for number, ((x, y), action, stamp) in enumerate(rows):
        time.sleep(max(0.0, begin + number / RATE - time.monotonic()))
        sent.append(time.monotonic())
        demonstrator.act((x, y), action, stamp)
    demonstrator.close()
    np.savez(path, stamp=stamps[-poses:], sent=np.array(sent))


class IntentObserver(Observer):
    """Notes which stamps [ns] intents have, and when they come [s]."""

    def __init__(self, process: Any) -> None:
        super().__init__(process)
        self.told: list[tuple[int, float]] = []
        self.listen("intent", self._on_intent)

    def _on_intent(self, message: Any) -> None:
        stamp = message.markers[0].header.stamp
        self.told.append((stamp.sec * 10**9 + stamp.nanosec, time.monotonic()))


def delays(seen: Demonstration, grid_map: GridMap, poses: int) -> npt.NDArray[np.float64]:
    """(poses,) how long each of the last poses waited for its intent [s]."""
    start = multiprocessing.get_context("spawn").Process
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_HOME"] = folder
        path, parameters = Path(folder, "sent.npz"), {"sweeps": 1000, "burn_in": 200}
        node = start(
            target=take, args=(Path(folder, "taken.npz"),), kwargs=parameters, daemon=True
        )
        node.start()
        observer = IntentObserver(node)
        observer.until(lambda: bool(observer.health))
        demonstrator = start(target=send, args=(path, seen, grid_map, poses), daemon=True)
        demonstrator.start()
        observer.until(lambda: not demonstrator.is_alive())
        with np.load(path) as times:
            stamp, sent = times["stamp"], times["sent"]
        observer.until(lambda: observer.told[-1][0] >= stamp[-1])
        observer.close()
        os.kill(node.pid or 0, signal.SIGINT)
        node.join()
    told, came = map(np.array, zip(*observer.told, strict=True))
    newest = np.maximum.accumulate(told)
    return np.asarray(came[np.searchsorted(newest, stamp)] - sent)


def main() -> None:
    """Print a table of seconds."""
    parser = argparse.ArgumentParser(description="Time what an intent takes after a pose.")
    parser.add_argument("--poses", type=int, default=60, help="of each line (%(default)s)")
    poses = parser.parse_args().poses
    os.environ |= {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    print(machine(("numpy", "numba", "ros-rclpy")))
    cases = [(name, *read_bag(name)) for name in BAGS]
    cases += [(f"new cells of {side} x {side}", *exploring(side, poses)) for side in SIDES]
    print(f"{'delay of intent [s]':24}{'poses':>8}{'50 %':>8}{'90 %':>8}{'most':>8}")
    for name, seen, grid_map in cases:
        waited = np.percentile(delays(seen, grid_map, poses), (50, 90, 100))
        print(f"{name:24}{len(seen):8}" + "".join(f"{each:8.2f}" for each in waited), flush=True)


if __name__ == "__main__":
    main()
