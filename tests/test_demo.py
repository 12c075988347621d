"""The main job from end to end, as `make demo` runs it: two nodes in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bnirl_ros import cli
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.reader import Bag
from bnirl_ros.experiments.scenarios import PAPER_LOOP
from bnirl_ros.resources import share_folder

pytest.importorskip("rclpy", reason="the nodes need rclpy")

LOOP = share_folder() / "bags" / "paper_loop"


@pytest.mark.timeout(300)
def test_demo_tells_shows_and_records_what_it_found(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [sys.executable, "-m", "bnirl_ros.cli", "demo", "--bag", LOOP]
    environment = {**os.environ, "PYTHONPATH": str(share_folder())}
    environment.pop("ROS_DOMAIN_ID", None)  # one of its own
    done = subprocess.run(
        [*map(str, command), "--out", str(out)], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    for x, y in PAPER_LOOP.subgoals:
        assert f"({x}, {y})" in done.stdout
    assert (out / "subgoals.png").read_bytes().startswith(b"\x89PNG")
    # what came over DDS is what the command gets from the file
    assert cli.main(["infer", str(LOOP), "--out", str(tmp_path / "infer")]) == 0
    assert (out / "posterior.npz").read_bytes() == (
        tmp_path / "infer" / "posterior.npz"
    ).read_bytes()
    assert json.loads((out / "subgoals.json").read_text()) == json.loads(
        (tmp_path / "infer" / "subgoals.json").read_text()
    )
    bag = Bag(out / "published")
    counts = {topic.name: topic.messages for topic in bag.topics()}
    assert min(counts.values()) > 0
    assert {"/map", "/subgoals", "/assignments", "/waypoints", "/subgoal_belief"} < set(counts)
    assert {"/current_subgoal", "/intent"} < set(counts)
    assert counts["/action"] == len(read_demonstration(LOOP, {}).recording.actions)
    assert sum(1 for _ in bag.messages()) == sum(counts.values())
    assert bag.damage is None


def test_demo_of_a_bag_that_is_not_there_ends_with_a_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bnirl_ros.cli", "demo", "--bag", "/none"]
    environment = {**os.environ, "PYTHONPATH": str(share_folder())}
    done = subprocess.run(
        [*command, "--out", str(tmp_path)], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 1
    assert "/none: does not exist" in done.stderr
    assert "Traceback" not in done.stderr
