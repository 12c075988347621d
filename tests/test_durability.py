"""A demonstration survives its node: killed, with a full disk, or ended in order."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from bnirl_ros import cli
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.errors import InputError
from demonstration_support import (
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    TopicMessage,
    map_of_grid,
    walk,
    write_bag,
)
from ros_support import NodeProcess, Subgoals, as_arguments, assert_same_results

pytestmark = pytest.mark.timeout(180)

QUICK: dict[str, Any] = {"sweeps": 300, "burn_in": 100, "journal_interval": 0.2}
OPTIONS = ["--sweeps=300", "--burn-in=100"]
LATER = walk(start=START + 1000 * SECOND)


def kept(folder: Path) -> int:
    """How many actions the journals hold."""
    try:
        return sum(len(read_demonstration(each).recording.actions) for each in folder.iterdir())
    except (InputError, OSError):
        return 0


def until_kept(node: Subgoals, folder: Path, actions: int) -> None:
    node.peer.until(
        lambda: kept(folder) == actions, lambda: f"{actions} actions, not {kept(folder)}"
    )


def assert_as_by_command(node: Subgoals, results: Path, *groups: list[TopicMessage]) -> None:
    """What the node infers is what the command infers from a bag with all that was sent."""
    bag, offline = results.with_name("bag"), results.with_name("offline")
    write_bag(bag, chain(*groups))
    assert cli.main(["infer", str(bag), "--out", str(offline), *OPTIONS]) == 0
    response = node.call("infer")
    assert response.success, response.message
    assert_same_results(results, offline)


def test_a_killed_node_goes_on_and_comes_to_the_same_posterior(
    subgoals: Callable[..., Subgoals], tmp_path: Path
) -> None:
    journals, results = tmp_path / "journals", tmp_path / "results"
    given = {**QUICK, "journal_folder": journals, "result_folder": results}
    first = subgoals(**given)
    first.send([map_of_grid()], walk())
    first.until_settled(OBSERVATIONS_OF_WALK)
    until_kept(first, journals, OBSERVATIONS_OF_WALK)
    (folder,) = journals.iterdir()
    first.peer.until((folder / "checkpoint").is_file, "a checkpoint")
    first.process.end(signal.SIGKILL)

    second = subgoals(**given)
    second.until_settled(OBSERVATIONS_OF_WALK)
    assert "goes on with 25 poses and 24 actions that" in second.process.err
    assert "start anew" not in second.process.err
    assert second.health()["last error"] == ""
    second.send(LATER)
    second.until_settled(2 * OBSERVATIONS_OF_WALK)
    assert_as_by_command(second, results, [map_of_grid()], walk(), LATER)
    assert second.process.end(signal.SIGINT).status == 0
    assert sorted(each.name for each in folder.iterdir()) == [
        f"{folder.name}_0.mcap",
        f"{folder.name}_1.mcap",
        "metadata.yaml",
    ]


def test_a_node_that_ended_in_order_leaves_a_bag_and_starts_afresh(
    subgoals: Callable[..., Subgoals], tmp_path: Path
) -> None:
    journals, results = tmp_path / "journals", tmp_path / "results"
    given = {**QUICK, "journal_folder": journals, "result_folder": results}
    first = subgoals(**given)
    first.send([map_of_grid()], walk())
    first.until_settled(OBSERVATIONS_OF_WALK)
    assert first.call("infer").success
    assert first.process.end(signal.SIGTERM).status == 0
    (folder,) = journals.iterdir()
    offline = tmp_path / "offline"
    assert cli.main(["infer", str(folder), "--out", str(offline), *OPTIONS]) == 0
    assert_same_results(results, offline)

    second = subgoals(**given)
    second.until_health("nothing", observations="0", queue="0")
    assert "goes on with" not in second.process.err


def test_a_reset_begins_another_journal(subgoals: Callable[..., Subgoals], tmp_path: Path) -> None:
    node = subgoals(**QUICK, journal_folder=tmp_path / "journals")
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert node.call("reset").success
    node.until_health("nothing", observations="0", queue="0")
    node.send(LATER)
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert node.process.end(signal.SIGINT).status == 0
    for folder, messages in zip(
        sorted((tmp_path / "journals").iterdir()), (walk(), LATER), strict=True
    ):
        recorded = read_demonstration(folder)
        stamps = [stamp for name, _, stamp in messages if name == "pose"]
        assert recorded.recording.pose_stamps.tolist() == stamps
        assert recorded.grid_map is not None


def test_a_full_disk_is_told_and_nothing_is_lost_once_there_is_room(
    subgoals: Callable[..., Subgoals], tmp_path: Path
) -> None:
    journals = tmp_path / "journals"
    given = {**QUICK, "journal_folder": journals}
    node = subgoals(**given)
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    until_kept(node, journals, OBSERVATIONS_OF_WALK)
    (file,) = journals.glob("*/*.mcap")
    unlimited = resource.RLIM_INFINITY
    limit = resource.prlimit
    limit(node.process.pid, resource.RLIMIT_FSIZE, (file.stat().st_size + 10, unlimited))
    node.send(LATER)
    node.until_health("an error", level=2, observations=str(2 * OBSERVATIONS_OF_WALK))
    assert "the journal cannot be written (File too large); make room" in node.health()["message"]
    assert kept(journals) == OBSERVATIONS_OF_WALK
    limit(node.process.pid, resource.RLIMIT_FSIZE, (unlimited, unlimited))
    until_kept(node, journals, 2 * OBSERVATIONS_OF_WALK)
    node.until_health("no error", level=0)
    node.process.end(signal.SIGKILL)
    subgoals(**given).until_settled(2 * OBSERVATIONS_OF_WALK)


def test_without_a_folder_for_it_the_node_does_without_a_journal_and_says_so(
    subgoals: Callable[..., Subgoals], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setitem(os.environ, "ROS_HOME", str(tmp_path / "file"))
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert "no journal can be written there (Not a directory)" in node.process.err


def test_a_folder_that_was_named_must_do(
    start: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    end = start("subgoal_node", *as_arguments({"journal_folder": tmp_path / "file"})).end()
    assert end.status == 1
    assert end.err.count("\n") == 1
    assert "no journal can be written there (File exists); name another journal_folder" in end.err


def test_a_journal_can_be_turned_off(subgoals: Callable[..., Subgoals], tmp_path: Path) -> None:
    node = subgoals(**QUICK, journal=False, journal_folder=tmp_path / "journals")
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert node.process.end(signal.SIGINT).status == 0
    assert not (tmp_path / "journals").exists()
