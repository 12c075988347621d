"""Whether the subgoal node keeps up with 2,000 messages a second while it infers, and then rests.

    make benchmark
    python benchmarks/load.py --seconds 10 --rest 5

The node is the real one, in a process of its own, and so is the demonstrator: a thousand poses and
as many actions a second of the paper's loop, in episodes. Latency is from just before a message is
published until its callback begins. Exit status 1 where a bound is broken.

What else runs on the machine matters: it is told how much of the cores that took.
"""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.experiments.machine import machine
from bnirl_ros.experiments.scenarios import PAPER_LOOP, demonstrate
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.demonstration import action_message, pose_message

OBSERVATIONS_PER_SECOND = 1000
LATENCY_BOUND = 5.0  # [ms], of the 99th percentile
REST_BOUND = 2.0  # [% of a core]

SWEEPS = 20  # after which inference comes to its end, once no message comes any more
STEP, GAP = 100_000_000, 10_000_000_000  # [ns] by the stamps, between poses and between episodes
WINDOW = 10.0  # [s] that a line of the table is about
PATIENCE = 600.0  # [s] for what has to come
LONGEST_WALK = 60_000  # observations
TICKS = os.sysconf("SC_CLK_TCK")  # in a second of a processor's time


@dataclass(frozen=True)
class Window:
    """What was seen of the node for a while, from begin to end [s].

    Attributes:
        results: how many it published.
        share: of a core [%] that it used.
        memory: that it had in the end [MB].
    """

    begin: float
    end: float
    results: int
    share: float
    memory: float


def walk(observations: int) -> Demonstration:
    """So many observations at least of the paper's loop, each time round an episode."""
    episodes, seen = PAPER_LOOP.episodes, demonstrate(PAPER_LOOP, np.random.default_rng(0))
    while len(seen) < observations:
        episodes = 1 + int(1.1 * episodes * observations / len(seen))
        seen = demonstrate(replace(PAPER_LOOP, episodes=episodes), np.random.default_rng(0))
    return seen


def take(path: Path, every: int = 1, **parameters: object) -> None:
    """Run the subgoal node until it is stopped; then write when messages were sent and taken.

    Args:
        path: of an .npz with the times `sent` and `taken` [s], whether it `is_pose`, and the
            `count` of messages.
        every: how many messages one is noted of.
        parameters: of the node.
    """
    nodes = importlib.import_module("bnirl_ros.nodes.subgoal_node")
    sent, taken, is_pose, count = array("d"), array("d"), array("b"), 0

    def note(time_sent: float, of_pose: bool) -> None:
        nonlocal count
        if count % every == 0:
            taken.append(time.monotonic())
            sent.append(time_sent)
            is_pose.append(of_pose)
        count += 1

    class TimedNode(nodes.SubgoalNode):  # type: ignore[misc, name-defined]
        """Notes what messages tell of when they were sent."""

        def _on_pose(self, message: Any, info: Any) -> None:
            note(message.pose.position.z, True)
            super()._on_pose(message, info)

        def _on_action(self, message: Any, info: Any) -> None:
            note(message.vector.z, False)
            super()._on_action(message, info)

    nodes.SubgoalNode = TimedNode
    given = {"sweeps": SWEEPS, "burn_in": SWEEPS // 2, **parameters}
    words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    status = nodes.main(["--ros-args", *words])
    arrays = {"sent": np.array(sent), "taken": np.array(taken), "is_pose": np.array(is_pose)}
    np.savez(path, **arrays, count=count)
    sys.exit(status)


class Demonstrator:
    """Whoever publishes a demonstration. The height of a message, which the node does not read,
    tells when it was sent."""

    def __init__(self, grid_map: GridMap) -> None:
        """Publishes the map, as soon as somebody hears it."""
        self._rclpy, qos = importlib.import_module("rclpy"), importlib.import_module("rclpy.qos")
        self._conversion = importlib.import_module("bnirl_ros.nodes.conversion")
        self._rclpy.init()
        self._node = self._rclpy.create_node("demonstrator")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers = {
            name: self._node.create_publisher(
                self._conversion.message_class(type_name),
                name,
                latched if name == "map" else qos.QoSProfile(depth=40_000),
            )
            for name, type_name in TOPIC_TYPES.items()
        }
        self._grid_map = grid_map
        self._poses: dict[tuple[int, int], Any] = {}
        self._actions = [
            self._conversion.to_ros(action_message(index, 0, "map")) for index in range(9)
        ]
        while not all(each.get_subscription_count() for each in self._publishers.values()):
            time.sleep(0.01)
        self._publishers["map"].publish(self._conversion.to_ros(map_message(grid_map, 0)))

    def act(self, cell: tuple[int, int], action: int, stamp: int) -> None:
        """Publish a pose and an action, with this stamp [ns]."""
        if cell not in self._poses:
            pose = self._conversion.to_ros(pose_message(self._grid_map, cell, 0))
            self._poses[cell] = pose
        pose, chosen = self._poses[cell], self._actions[action]
        for name, message, place in (
            ("pose", pose, pose.pose.position),
            ("action", chosen, chosen.vector),
        ):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            place.z = time.monotonic()
            self._publishers[name].publish(message)

    def close(self) -> None:
        """End, when all is acknowledged."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked()
        self._node.destroy_node()
        self._rclpy.shutdown()


def send(observations: int, rate: float = OBSERVATIONS_PER_SECOND) -> None:
    """Publish the map and a walk, in time; ends when all is acknowledged.

    A walk of more than `LONGEST_WALK` observations begins again, with later stamps.

    Args:
        observations: how many, each with two messages.
        rate: of observations [1/s].
    """
    seen = walk(min(observations, LONGEST_WALK))
    episodes = int(seen.episode[-1]) + 1
    demonstrator = Demonstrator(PAPER_LOOP.grid_map)
    begin = time.monotonic()
    for number in range(observations):
        round_, row = divmod(number, len(seen))
        stamp = STEP * number + GAP * (int(seen.episode[row]) + episodes * round_)
        x, y = seen.cells[row].tolist()
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        demonstrator.act((x, y), int(seen.action[row]), stamp)
    demonstrator.close()


class Observer:
    """Whoever looks at what the node publishes, and uses."""

    def __init__(self, process: BaseProcess) -> None:
        self._process, self._proc = process, Path(f"/proc/{process.pid}")
        self._rclpy = importlib.import_module("rclpy")
        self._rclpy.init()
        self._node = self._rclpy.create_node("observer")
        self.results = 0
        self.health: dict[str, str] = {}
        diagnostics = importlib.import_module("diagnostic_msgs.msg").DiagnosticArray
        self._markers = importlib.import_module("visualization_msgs.msg").MarkerArray
        self.listen("subgoals", self._on_subgoals)
        self._node.create_subscription(diagnostics, "/diagnostics", self._on_diagnostics, 10)

    def listen(self, topic: str, callback: Callable[[Any], None]) -> None:
        """Have a callback called with the markers of a topic."""
        self._node.create_subscription(self._markers, topic, callback, 10)

    def close(self) -> None:
        """Look no longer."""
        self._node.destroy_node()
        self._rclpy.shutdown()

    def _on_subgoals(self, _: Any) -> None:
        self.results += 1

    def _on_diagnostics(self, message: Any) -> None:
        self.health = {each.key: each.value for each in message.status[0].values}

    def until(self, happened: Callable[[], bool], patience: float = PATIENCE) -> bool:
        """Look on until something is true, or for so long [s]; returns whether it is true."""
        end = time.monotonic() + patience
        while not happened():
            if time.monotonic() > end:
                return False
            if not self._process.is_alive():
                sys.exit("the node has ended by itself")
            self._rclpy.spin_once(self._node, timeout_sec=0.1)
        return True

    def watch(self, seconds: float, happened: Callable[[], bool] = lambda: False) -> Window:
        """What is seen for so long, or until something is true."""
        begin, results, used = time.monotonic(), self.results, self.used()
        self.until(happened, seconds)
        end = time.monotonic()
        share = 100 * (self.used() - used) / (end - begin)
        pages = int((self._proc / "statm").read_text().split()[1])
        memory = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        return Window(begin, end, self.results - results, share, memory)

    def used(self) -> float:
        """What the node has used so far [s of a core]."""
        words = (self._proc / "stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / TICKS


def used_by_all() -> float:
    """What all processes of the machine have used so far [s of a core]."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:]]
    return (sum(ticks[:8]) - ticks[3] - ticks[4]) / TICKS  # without idle and waiting


def percentiles(latency: npt.NDArray[np.float64]) -> str:
    """The middle, the 99th and the 99.9th percentile, and the largest."""
    return " ".join(f"{each:8.2f}" for each in np.percentile(latency, (50, 99, 99.9, 100)))


def main() -> int:
    """Print what was seen, and what was to be seen; returns the exit status."""
    parser = argparse.ArgumentParser(description="Does the subgoal node keep up, and rest?")
    parser.add_argument("--seconds", type=float, default=60.0, help="of messages (%(default)s)")
    parser.add_argument("--rest", type=float, default=20.0, help="seconds of rest (%(default)s)")
    parser.add_argument(
        "--cold", action="store_true", help="without a short run before, which compiles kernels"
    )
    given = parser.parse_args()
    if not given.cold:
        short = [sys.executable, __file__, "--cold", "--seconds", "5", "--rest", "1"]
        subprocess.run(short, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    observations = round(given.seconds * OBSERVATIONS_PER_SECOND)
    os.environ |= {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    print(machine(("numpy", "numba", "ros-rclpy")))
    start = multiprocessing.get_context("spawn").Process
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_HOME"] = folder
        path = Path(folder, "times.npz")
        node = start(target=take, args=(path,), daemon=True)
        node.start()
        observer = Observer(node)
        observer.until(lambda: bool(observer.health))
        observer.watch(2.0)
        at_rest = {"before any map": observer.watch(given.rest).share}

        all_before, mine_before = used_by_all(), observer.used() + sum(os.times()[:4])
        begin = time.monotonic()
        demonstrator = start(target=send, args=(observations,), daemon=True)
        demonstrator.start()
        windows = []
        while demonstrator.is_alive():
            windows.append(observer.watch(WINDOW, lambda: not demonstrator.is_alive()))
        demonstrator.join()
        others = used_by_all() - all_before - (observer.used() + sum(os.times()[:4]) - mine_before)
        others *= 100 / (time.monotonic() - begin)

        has_settled = {"state": "settled", "queue": "0"}.items()
        if not observer.until(lambda: has_settled <= observer.health.items()):
            sys.exit(f"not settled after {PATIENCE:g} s: {observer.health}")
        observer.watch(2.0)
        at_rest["settled"] = observer.watch(given.rest).share
        os.kill(node.pid or 0, signal.SIGINT)
        node.join()
        with np.load(path) as times:
            sent, taken = times["sent"], times["taken"]

    latency = 1e3 * (taken - sent)
    print(f"{'':37} latency [ms]                         node")
    print(f"{'[s]':>9} {'taken':>8} {'50 %':>8} {'99 %':>8} {'99.9 %':>8} {'most':>8}", end="")
    print(f" {'results':>8} {'[core]':>8} {'[MB]':>8}")
    for window in windows:
        part = latency[(window.begin <= sent) & (sent < window.end)]
        if len(part):
            span = f"{window.begin - begin:.0f}-{window.end - begin:.0f}"
            print(f"{span:>9} {len(part):8d} {percentiles(part)} {window.results:8d}", end="")
            print(f" {window.share:7.0f}% {window.memory:8.0f}")
    print(f"{'all':>9} {len(latency):8d} {percentiles(latency)}")
    rate = (len(sent) - 1) / (sent.max() - sent.min())
    print(f"{rate:.0f} messages a second; other processes used {others:.0f} % of a core")
    bounds = [
        ("messages lost", 2 * observations - len(latency), 0),
        ("observations not used", observations - int(observer.health["observations"]), 0),
        ("99th percentile of latency [ms]", np.percentile(latency, 99), LATENCY_BOUND),
        ("spans without a result", sum(not each.results for each in windows[:-1]), 0),
        ("exit status of the node", abs(node.exitcode or 0), 0),
        *((f"{when}: used [% of a core]", share, REST_BOUND) for when, share in at_rest.items()),
    ]
    for what, value, bound in bounds:
        verdict = "" if value <= bound else "  BROKEN"
        print(f"{what:36} {value:8.2f}  at most {bound:g}{verdict}")
    return int(any(value > bound for _, value, bound in bounds))


if __name__ == "__main__":
    sys.exit(main())
