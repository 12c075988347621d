"""Whether the subgoal node bears half an hour of 500 messages a second, and what it does beyond.

    make campaigns
    python benchmarks/soak.py --minutes 2 --limit 5000

The node and the demonstrator are those of benchmarks/load.py, with the journal on. Memory is
looked at from when the node has begun to forget what is oldest: how it goes on from there is told
by a line through what it was in each window, with the interval of its slope (95 %), and so is the
delay. Then come floods, as fast as several demonstrators can send them, with a short queue: what
was not taken has to be counted as lost. Exit status 1 where a bound is broken.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from load import Observer, Window, percentiles, send, take

from bnirl_ros.experiments.machine import machine

RATE = 250.0  # observations a second, each with two messages
MEMORY_BOUND = 20.0  # [MB an hour] of which the slope's interval may not be wholly above
DELAY_BOUND = 10.0  # [ms an hour], the same of the median delay
FLOOD = 40_000  # observations of each demonstrator
QUEUE = 500  # messages in a flood


def slope(times: npt.NDArray[np.float64], values: npt.NDArray[np.float64]) -> tuple[float, float]:
    """The slope of a line through values at times, and half the width of its 95 % interval."""
    middle = times - times.mean()
    spread = (middle**2).sum()
    rise = (middle * (values - values.mean())).sum() / spread
    rest = values - values.mean() - rise * middle
    error = np.sqrt((rest**2).sum() / max(1, len(times) - 2) / spread)
    return float(rise), float(2.0 * error)


def watched(observer: Observer, demonstrator: BaseProcess) -> list[Window]:
    """Windows of the node, as long as somebody demonstrates."""
    windows = []
    length = 10.0
    while demonstrator.is_alive():
        windows.append(observer.watch(length, lambda: not demonstrator.is_alive()))
    demonstrator.join()
    return windows


def main() -> int:
    """Print what was seen, and what was to be seen; returns the exit status."""
    parser = argparse.ArgumentParser(description="Does the node bear half an hour, and a flood?")
    parser.add_argument("--minutes", type=float, default=30.0, help="(%(default)s)")
    parser.add_argument(
        "--limit", type=int, default=100_000, help="observation_limit of the node (%(default)s)"
    )
    given = parser.parse_args()
    os.environ |= {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    print(machine(("numpy", "numba", "ros-rclpy")), flush=True)
    start = multiprocessing.get_context("spawn").Process
    observations = round(60 * given.minutes * RATE)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_HOME"] = folder
        path = Path(folder, "times.npz")
        parameters = {"observation_limit": given.limit}
        node = start(target=take, args=(path, 50), kwargs=parameters, daemon=True)
        node.start()
        observer = Observer(node)
        observer.until(lambda: bool(observer.health))
        begin = time.monotonic()
        demonstrator = start(target=send, args=(observations, RATE), daemon=True)
        demonstrator.start()
        windows = watched(observer, demonstrator)
        settled = observer.until(lambda: observer.health["queue"] == "0", 60.0)
        soaked = dict(observer.health)
        observer.close()
        os.kill(node.pid or 0, signal.SIGINT)
        node.join()
        with np.load(path) as times:
            sent, taken, count = times["sent"], times["taken"], int(times["count"])
            is_pose = times["is_pose"] == 1
        journal = sum(each.stat().st_size for each in Path(folder).rglob("*.mcap"))
    latency = 1e3 * (taken - sent)
    print(f"{'':33} delay [ms]                           node")
    print(f"{'[s]':>10} {'50 %':>8} {'99 %':>8} {'99.9 %':>8} {'most':>8}", end="")
    print(f" {'results':>8} {'[core]':>8} {'[MB]':>8}")
    medians = []
    for number, window in enumerate(windows):
        part = latency[(window.begin <= sent) & (sent < window.end)]
        medians.append(np.median(part) if len(part) else np.nan)
        if len(part) and number % max(1, len(windows) // 30) == 0:
            span = f"{window.begin - begin:.0f}-{window.end - begin:.0f}"
            print(f"{span:>10} {percentiles(part)} {window.results:8d}", end="")
            print(f" {window.share:7.0f}% {window.memory:8.0f}")
    warm = begin + 1.25 * given.limit / RATE
    later = [
        (window.end / 3600, window.memory, median)
        for window, median in zip(windows[:-1], medians, strict=False)
        if window.begin > warm and np.isfinite(median)
    ]
    print(f"{count} messages taken of {2 * observations}; the journal has {journal / 1e6:.1f} MB")
    bounds = [
        ("messages lost", 2 * observations - count, 0),
        ("messages counted as lost", int(soaked.get("left out: message lost on its way", "0")), 0),
        (
            "messages out of order",
            sum(out_of_order(sent[each]) for each in (is_pose, ~is_pose)),
            0,
        ),
        ("not settled in the end", not settled, 0),
        ("exit status of the node", abs(node.exitcode or 0), 0),
    ]
    if len(later) > 5:
        hours, memory, median = (np.array(values) for values in zip(*later, strict=True))
        for what, values, bound in (
            ("memory [MB an hour]", memory, MEMORY_BOUND),
            ("median delay [ms an hour]", median, DELAY_BOUND),
        ):
            rise, error = slope(hours, values)
            print(f"{what} over {60 * np.ptp(hours):.0f} minutes: {rise:.2f} +- {error:.2f}")
            bounds.append((f"{what}, at least", rise - error, bound))
    else:
        print("too short to tell a slope: the oldest is not forgotten yet, or has just been")
    for demonstrators in (1, 3):
        bounds += flood(start, demonstrators)
    for what, value, bound in bounds:
        verdict = "" if value <= bound else "  BROKEN"
        print(f"{what:44} {value:10.2f}  at most {bound:g}{verdict}")
    return int(any(value > bound for _, value, bound in bounds))


def counted_as_lost(health: Mapping[str, str]) -> int:
    """How many messages the node says did not come."""
    return int(health.get("left out: message lost on its way", "0"))


def out_of_order(sent: npt.NDArray[np.float64]) -> int:
    """How many messages of a topic were taken before one that was sent earlier."""
    return int((np.diff(sent) < 0).sum())


def flood(start: Any, demonstrators: int) -> list[tuple[str, float, float]]:
    """What becomes of more than can be taken: bounds, as in `main`."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_HOME"] = folder
        path = Path(folder, "times.npz")
        parameters = {"queue_depth": QUEUE, "journal": False}
        node = start(target=take, args=(path,), kwargs=parameters, daemon=True)
        node.start()
        observer = Observer(node)
        observer.until(lambda: bool(observer.health))
        senders = [
            start(target=send, args=(FLOOD, 1e9), daemon=True) for _ in range(demonstrators)
        ]
        for sender in senders:
            sender.start()
        for sender in senders:
            watched(observer, sender)
        observer.watch(5.0)
        lost = counted_as_lost(observer.health)
        observer.close()
        os.kill(node.pid or 0, signal.SIGINT)
        node.join()
        with np.load(path) as times:
            sent, taken, count = times["sent"], times["taken"], int(times["count"])
    all_sent = 2 * FLOOD * demonstrators
    rate = len(sent) / (sent.max() - sent.min())
    name = f"a flood by {demonstrators}"
    print(
        f"{name}: {all_sent} messages, {rate:.0f} a second taken: {count} in all, {lost} counted "
        f"as lost; delay [ms] {percentiles(1e3 * (taken - sent))}",
        flush=True,
    )
    # Of several publishers rclpy does not say whose message it is.
    unknown = 100 * abs(all_sent - count - lost) / all_sent
    return [(f"{name}: neither taken nor counted [%]", unknown, 0 if demonstrators == 1 else 1)]


if __name__ == "__main__":
    sys.exit(main())
