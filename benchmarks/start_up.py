"""How long it takes from the start of a process until subgoals are known.

    make benchmark
    python benchmarks/start_up.py --runs 10

`bnirl infer` with its default settings on the paper's loop, until it prints the subgoals, and to
its end, the picture drawn; `subgoal_node`, until it hears, and then until it publishes subgoals of
the same observations, all sent at once. Kernels are compiled and cached by a run that doesn't
count. Above them what nobody gets round: the interpreter, numpy, and numba ready to load a kernel
from its cache, each including those before. Exit status 1 where a bound is broken. The least of
several runs counts: what else runs on the machine matters.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.machine import machine
from bnirl_ros.resources import share_folder
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.demonstration import action_message, pose_message

BOUND = 1.5  # [s] until the first result
BAG = share_folder() / "bags" / "paper_loop"
PATIENCE = 120.0  # [s] for what has to come
STEP, GAP = 500_000_000, 10_000_000_000  # [ns] between poses, and between episodes

# Numba reads its registries, and imports what it has of SciPy, for the first kernel of a process.
NUMBA = """
from numba.core.registry import cpu_target
cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
"""
ALONE = {"the interpreter": "", "numpy": "import numpy", "numba, ready": NUMBA}


def code(program: str) -> list[float]:
    """How long Python takes for a program [s]."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", program], check=True)
    return [time.perf_counter() - begin]


def command(model: str, out: str) -> list[float]:
    """How long `bnirl infer` takes until its first line, and in all [s]."""
    begin = time.perf_counter()
    arguments = ["infer", str(BAG), "--model", model, "--out", out]
    with subprocess.Popen(
        [sys.executable, "-m", "bnirl_ros.cli", *arguments], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        first = time.perf_counter() - begin
        process.stdout.read()
    if process.returncode:
        sys.exit("bnirl infer failed")
    return [first, time.perf_counter() - begin]


class Demonstrator:
    """Whoever publishes the loop, and waits for its subgoals."""

    def __init__(self) -> None:
        self._rclpy = importlib.import_module("rclpy")
        conversion = importlib.import_module("bnirl_ros.nodes.conversion")
        qos = importlib.import_module("rclpy.qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._rclpy.init()
        self._node = self._rclpy.create_node("demonstrator")
        self._publishers = {
            name: self._node.create_publisher(
                conversion.message_class(type_name),
                name,
                latched if name == "map" else qos.QoSProfile(depth=40_000),
            )
            for name, type_name in TOPIC_TYPES.items()
        }
        markers = importlib.import_module("visualization_msgs.msg").MarkerArray
        self._node.create_subscription(markers, "subgoals", self._on_subgoals, 10)
        self._found = False
        recorded = read_demonstration(BAG, {})
        assert recorded.grid_map is not None
        seen = place(recorded.recording, recorded.grid_map).demonstration
        self._map = conversion.to_ros(map_message(recorded.grid_map, 0))
        self._messages = []
        for number, (episode, x, y, action) in enumerate(seen.observations.tolist()):
            stamp = STEP * number + GAP * episode
            pose = pose_message(recorded.grid_map, (x, y), stamp)
            step = action_message(action, stamp, recorded.grid_map.frame_id)
            self._messages.append((conversion.to_ros(pose), conversion.to_ros(step)))

    def __call__(self) -> list[float]:
        """How long a node takes until it hears, and from then until it publishes subgoals [s]."""
        self._found = False
        begin = time.perf_counter()
        program = "from bnirl_ros.nodes.start import subgoal_node; subgoal_node()"
        with (
            tempfile.TemporaryDirectory() as home,
            subprocess.Popen(
                [sys.executable, "-c", program], env=os.environ | {"ROS_HOME": home}
            ) as process,
        ):
            self._until(lambda: all(p.get_subscription_count() for p in self._publishers.values()))
            heard = time.perf_counter()
            self._publishers["map"].publish(self._map)
            for pose, action in self._messages:
                self._publishers["pose"].publish(pose)
                self._publishers["action"].publish(action)
            self._until(lambda: self._found)
            end = time.perf_counter()
            process.send_signal(signal.SIGINT)
        self._until(lambda: not any(p.get_subscription_count() for p in self._publishers.values()))
        return [heard - begin, end - heard, end - begin]

    def _on_subgoals(self, message: Any) -> None:
        self._found = len(message.markers) > 1  # the first one deletes what was there

    def _until(self, happened: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not happened():
            if time.monotonic() > end:
                sys.exit(f"nothing happened for {PATIENCE:g} s")
            self._rclpy.spin_once(self._node, timeout_sec=0.01)


def measured(runs: int, run: Callable[[], list[float]], *names: str) -> list[float]:
    """Print least and median time of several runs [s], after one that doesn't count.

    Returns:
        The least ones.
    """
    run()
    times = list(zip(*(run() for _ in range(runs)), strict=True))
    for name, passed in zip(names, times, strict=True):
        print(f"{name:50} {min(passed):7.3f} {median(passed):7.3f}", flush=True)
    return [min(passed) for passed in times]


def main() -> int:
    """Print a table of seconds, and what bounds are broken."""
    parser = argparse.ArgumentParser(description="Time until the first result.")
    parser.add_argument("--runs", type=int, default=5, help="runs of each (%(default)s)")
    runs = parser.parse_args().runs
    print(machine())
    print(f"{'[s]':50} {'least':>7} {'median':>7}")
    for name, program in ALONE.items():
        measured(runs, lambda program=program: code(program), name)
    firsts = {}
    for model in ("sequential", "paper"):
        words = f"bnirl infer, {model} model"
        with tempfile.TemporaryDirectory() as out:
            firsts[words], _ = measured(
                runs, lambda model=model, out=out: command(model, out), words, "    to its end"
            )
    if importlib.util.find_spec("rclpy"):
        names = "subgoal_node: until it hears", "    then until its first subgoals", "    both"
        firsts["subgoal_node"] = measured(runs, Demonstrator(), *names)[2]
    for what, first in firsts.items():
        verdict = "" if first <= BOUND else "  BROKEN"
        print(f"{what}: first result after {first:.2f} s, at most {BOUND:g}{verdict}")
    return int(any(first > BOUND for first in firsts.values()))


if __name__ == "__main__":
    sys.exit(main())
