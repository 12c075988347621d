"""How well a replay keeps the recorded pace, and how fast it is when it keeps none.

    make benchmark

Both are measured over DDS between processes of this machine: the pace by a node that notes when
each message comes, the speed by subgoal_node, which counts what it got. Exit status 1 where a
bound is broken; what else runs on the machine matters.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

from bnirl_ros.bags.qos import RELIABLE
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.nodes.conversion import message_class
from bnirl_ros.views.messages import (
    Header,
    Point,
    Pose,
    PoseStamped,
    Time,
    Vector3,
    Vector3Stamped,
)

TOPICS = ("pose", "action")
PACE = 500  # messages a second
SECONDS = 20
MANY = 20_000
SPACING_BOUND = 5.0  # [ms] off the recorded spacing, of the 99th percentile
SPEED_BOUND = 5000.0  # messages a second
START = 1_700_000_000 * 10**9


def write(bag: Path, count: int, rate: float) -> np.ndarray:
    """A bag of poses and actions in turn; returns the log times [ns]."""
    times = START + np.arange(count) * round(1e9 / rate)
    with BagWriter(bag) as writer:
        for name in TOPICS:
            writer.add_topic(f"/{name}", TOPIC_TYPES[name], RELIABLE)
        for number, log_time in enumerate(times.tolist()):
            header = Header(Time(*divmod(log_time - log_time % 2, 10**9)), "map")
            message = (
                Vector3Stamped(header, Vector3(1.0, 0.0))
                if number % 2
                else PoseStamped(header, Pose(Point(0.5, 0.5)))
            )
            writer.write(f"/{TOPICS[number % 2]}", message, log_time)
    return times


@contextmanager
def process(name: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """One of our nodes, stopped at the end."""
    code = f"import sys; from bnirl_ros.nodes.start import {name}; sys.exit({name}())"
    with tempfile.TemporaryDirectory() as home:
        running = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | {"ROS_HOME": home},
            text=True,
        )
        try:
            yield running
        finally:
            if running.poll() is None:
                running.send_signal(signal.SIGINT)
                running.wait(60)


def spin_until(executor: Any, happened: Callable[[], Any]) -> None:
    """Take messages until something is true; it may take two minutes."""
    deadline = time.monotonic() + 120.0
    while not happened():
        if time.monotonic() > deadline:
            sys.exit("benchmark: waited in vain for two minutes")
        executor.spin_once(timeout_sec=0.05)


def measure_pace(folder: Path) -> float:
    """Print how far from the recorded spacing messages are; returns the 99th percentile [ms]."""
    recorded = write(folder / "paced", PACE * SECONDS, PACE)
    node = rclpy.create_node("listener")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    arrived: list[float] = []
    for name in TOPICS:
        node.create_subscription(
            message_class(TOPIC_TYPES[name]),
            f"/{name}",
            lambda _: arrived.append(time.monotonic()),
            QoSProfile(depth=RELIABLE.depth),
            raw=True,
        )
    with process("replay_node", str(folder / "paced")) as replay:
        spin_until(executor, lambda: len(arrived) == len(recorded))
        replay.communicate(timeout=120)
    node.destroy_node()
    spaces = np.abs(np.diff(arrived) - np.diff(recorded) / 1e9) * 1e3
    drift = np.abs(np.array(arrived) - arrived[0] - (recorded - recorded[0]) / 1e9) * 1e3
    for what, values in (("off the recorded spacing", spaces), ("off the recorded time", drift)):
        told = [f"{np.quantile(values, share):8.3f}" for share in (0.5, 0.99, 1.0)]
        print(f"  {what:38s} {' '.join(told)}", flush=True)
    return float(np.quantile(spaces, 0.99))


def measure_speed(folder: Path) -> float:
    """Print how many small messages a second come to subgoal_node, and return it; none is lost."""
    write(folder / "fast", MANY, 1000.0)
    node = rclpy.create_node("watcher")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    waiting = [0]

    def note(array: DiagnosticArray) -> None:
        values = {entry.key: entry.value for status in array.status for entry in status.values}
        waiting[0] = int(values.get("queue", 0))

    node.create_subscription(DiagnosticArray, "/diagnostics", note, 10)
    client = node.create_client(SetBool, "/subgoal_node/pause")
    with process("subgoal_node"):
        spin_until(executor, client.service_is_ready)
        paused = client.call_async(SetBool.Request(data=True))
        spin_until(executor, paused.done)
        with process("replay_node", str(folder / "fast"), "--fast") as replay:
            _, said = replay.communicate(timeout=120)
        spin_until(executor, lambda: waiting[0] == MANY)
    node.destroy_node()
    found = re.search(r"played (\d+) messages in ([\d.]+) s", said)
    assert found, said
    speed = int(found[1]) / float(found[2])
    print(f"  {found[1]} messages in {found[2]} s: {speed:.0f} a second, none lost", flush=True)
    return speed


def main() -> int:
    """Print both; returns the exit status."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    rclpy.init()
    try:
        with tempfile.TemporaryDirectory() as name:
            title = f"replay at {PACE} messages a second"
            print(f"{title:40s} {'median':>8s} {'99 %':>8s} {'most':>8s}  [ms]", flush=True)
            spacing = measure_pace(Path(name))
            print("replay --fast to subgoal_node", flush=True)
            speed = measure_speed(Path(name))
    finally:
        rclpy.try_shutdown()
    load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
    print(f"  load of the machine in the last 1, 5 and 15 minutes: {load}")
    return int(spacing > SPACING_BOUND or speed < SPEED_BOUND)


if __name__ == "__main__":
    sys.exit(main())
