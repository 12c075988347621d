"""`bnirl infer` on many demonstrations: pooled or each, by workers of which any may die."""

from __future__ import annotations

import csv
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.planning import open_space_round
from bnirl_ros.errors import InputError
from bnirl_ros.fleet import cluster
from bnirl_ros.fleet.account import names_of
from bnirl_ros.fleet.pooling import common_map, joined
from bnirl_ros.fleet.reading import Taken, take
from bnirl_ros.maps import GridMap
from bnirl_ros.maps.coarsening import with_free
from cli_support import FILES, QUICK, Command, assert_refused, contents, ended, in_process
from demonstration_support import (
    GRID,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    map_of_grid,
    truncated,
    walk,
    write_bag,
)

pytestmark = pytest.mark.timeout(180)

WALK = "episode,x,y,action\n4,0,0,E\n4,1,0,E\n4,2,0,N\n9,2,1,W\n9,1,1,W\n"
"""Two episodes, as a CSV file."""


@pytest.fixture
def bags(tmp_path: Path) -> list[Path]:
    """One round and two rounds, recorded one after the other."""
    return [
        write_bag(tmp_path / "monday", [map_of_grid(), *walk()]),
        write_bag(tmp_path / "tuesday", [map_of_grid(), *walk(2, start=START + 100 * SECOND)]),
    ]


@pytest.fixture
def text_map(tmp_path: Path) -> Path:
    path = tmp_path / "map.txt"
    path.write_text(GRID)
    return path


def summary_in(folder: Path) -> list[dict[str, Any]]:
    """What summary.json tells of each demonstration; summary.csv has to tell the same."""
    demonstrations = json.loads((folder / "summary.json").read_text())["demonstrations"]
    with (folder / "summary.csv").open(newline="") as file:
        for row, told in zip(csv.DictReader(file), demonstrations, strict=True):
            left_out = sum(told["left_out"].values())
            expected = {name: "" if it is None else str(it) for name, it in told.items()}
            assert row == expected | {"left_out": str(left_out)}
    return demonstrations


# Pooled


def test_several_bags_are_as_one_of_all_their_episodes(
    bnirl: Command, bags: list[Path], tmp_path: Path
) -> None:
    whole = write_bag(tmp_path / "whole", [map_of_grid(), *walk(3)])
    assert bnirl("infer", whole, "--out", tmp_path / "one", *QUICK).status == 0
    logs = tmp_path / "logs"  # a folder of bags is all bags in it
    logs.mkdir()
    for bag in bags:
        bag.rename(logs / bag.name)
    end = bnirl("infer", logs, "--report", "--out", tmp_path / "pooled", *QUICK)
    assert (end.status, end.err) == (0, "")
    assert contents(tmp_path / "pooled") == contents(tmp_path / "one")
    written = sorted(path.name for path in (tmp_path / "pooled").iterdir())
    assert written == sorted([*FILES, "report.html", "summary.csv", "summary.json"])
    assert "<h1>monday, tuesday</h1>" in (tmp_path / "pooled" / "report.html").read_text()
    first, second = summary_in(tmp_path / "pooled")
    assert (first["first_episode"], first["episodes"]) == (0, 1)
    assert (second["first_episode"], second["episodes"]) == (1, 2)
    assert first["observations"] == OBSERVATIONS_OF_WALK
    assert second["observations"] == 2 * OBSERVATIONS_OF_WALK
    # The table of subgoals, then that of the demonstrations.
    assert end.out.splitlines()[0].split()[0] == "rank"
    assert [line.split()[-1] for line in end.out.splitlines()[-3:-1]] == ["pooled", "pooled"]


def test_what_cannot_be_pooled_is_told_and_stops_no_other(
    bnirl: Command, bags: list[Path], tmp_path: Path, text_map: Path
) -> None:
    table = tmp_path / "walk.csv"
    table.write_text(WALK)
    bad = tmp_path / "bad.csv"
    bad.write_text(WALK + "9,99,1,W\n")
    away = write_bag(tmp_path / "away", walk(grid_map=replace(MAP, origin=(50.0, 0.0, 0.0))))
    half = truncated(bags[1], tmp_path / "half.mcap", 0.7)
    out = tmp_path / "out"
    end = bnirl("infer", bad, table, away, bags[0], half, "--map", text_map, "--out", out, *QUICK)
    assert end.status == 1
    told = {Path(each["demonstration"]).stem: each for each in summary_in(out)}
    assert list(told) == ["bad", "walk", "away", "monday", "half"]
    assert "bad.csv, line 7: cell (99, 1) is outside" in told["bad"]["error"]
    assert "away: no pose and action of equal stamps lie on the map" in told["away"]["error"]
    assert "half.mcap: is damaged at byte" in told["half"]["damage"]
    assert end.lines[-3:] == [
        f"bnirl: {told['bad']['error']}",
        f"bnirl: {told['away']['error']}",
        f"bnirl: {told['half']['damage']}; the results are from what could be read",
    ]
    assert (told["walk"]["first_episode"], told["walk"]["episodes"]) == (0, 2)
    assert told["monday"]["first_episode"] == 2
    assert told["half"]["first_episode"] == 3
    with np.load(out / "posterior.npz") as arrays:
        episodes = arrays["observations"][:, 0]
    assert np.unique(episodes).tolist() == list(range(3 + told["half"]["episodes"]))
    assert (episodes == 2).sum() == told["monday"]["observations"] == OBSERVATIONS_OF_WALK


def test_nothing_to_pool_is_refused(bnirl: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    end = bnirl("infer", tmp_path / "no", tmp_path / "none", "--out", out)
    assert (end.status, end.out) == (1, "")
    assert "no: does not exist" in end.lines[0]
    assert "none: does not exist" in end.lines[1]
    assert end.lines[2:] == ["bnirl: none of the 2 demonstrations can be used"]
    assert not out.exists()


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (replace(MAP, frame_id="floor"), "frame 'floor', not 'map'"),
        (replace(MAP, resolution=0.5), "cells of 0.5 m, not 1 m"),
        (replace(MAP, origin=(0.0, 1.0, 0.0)), "origin (0, 1, 0), not (0, 0, 0)"),
        (GridMap(MAP.free[1:]), "7 x 6 cells, not 7 x 7"),
        (with_free(MAP, [(3, 3)]), "1 cells are free on one of them alone"),
    ],
)
def test_bags_with_different_maps_are_not_pooled(other: GridMap, words: str) -> None:
    with pytest.raises(InputError) as refused:
        common_map([taken("here", MAP), taken("there", MAP), taken("elsewhere", other)])
    assert str(refused.value).startswith(f"elsewhere: its map is not that of here ({words}); ")


def taken(name: str, grid_map: GridMap, **more: Any) -> Taken:
    nothing = np.empty((0, 2), dtype=np.int64)
    none = nothing[:, 0]
    return Taken(Path(name), Demonstration(none, nothing, none, none, nothing), grid_map, **more)


def test_a_cell_that_one_robot_was_in_is_open_for_all() -> None:
    free = MAP.free.copy()
    free[5] = False
    walled = GridMap(free)
    robots = [
        taken(str(number), with_free(walled, cells), opened=cells)
        for number, cells in enumerate((((2, 5),), (), ((2, 5), (4, 5))))
    ]
    for order in (robots, robots[::-1]):
        assert common_map(order).is_same_as(with_free(walled, [(2, 5), (4, 5)]))


def test_open_space_is_as_large_as_all_need() -> None:
    places = np.array([[0.3, 0.3], [2.1, -4.0], [-3.2, 0.9]])
    rooms = [open_space_round(place[None], 0.5, "odom", "here") for place in places]
    robots = [taken(str(number), room, is_assumed=True) for number, room in enumerate(rooms)]
    assert common_map(robots).is_same_as(open_space_round(places, 0.5, "odom", "all"))
    with pytest.raises(InputError, match="one of them has none, and was put in open space"):
        common_map([robots[0], taken("known", rooms[0])])


@given(
    lengths=st.lists(
        st.dictionaries(st.integers(0, 9), st.integers(1, 3), min_size=1, max_size=3),
        min_size=2,
        max_size=4,
    )
)
def test_episodes_are_numbered_on(lengths: list[dict[int, int]]) -> None:
    parts = []
    for number, episodes in enumerate(lengths):
        order = sorted(episodes)
        episode = np.repeat(order, [episodes[each] for each in order])
        cells = np.column_stack([np.full(len(episode), number), episode])
        last = np.array(order[-1:])
        parts.append(Demonstration(episode, cells, episode % 9, last, cells[-1:]))
    whole = joined(parts)
    expected = [
        (number, each) for number, episodes in enumerate(lengths) for each in sorted(episodes)
    ]
    assert np.unique(whole.episode).tolist() == list(range(len(expected)))
    assert (np.diff(whole.episode) >= 0).all()
    # The cells tell of which part, and of which of its episodes, an observation is.
    assert [expected[each] for each in whole.episode] == list(map(tuple, whole.cells.tolist()))
    assert whole.action.tolist() == (whole.cells[:, 1] % 9).tolist()
    lasts = [expected[each] for each in whole.last_episode]
    assert lasts == list(map(tuple, whole.last_cells.tolist()))
    assert len(lasts) == len(lengths)
    assert joined(parts[:1]) is parts[0]


# Each


def test_each_has_the_results_that_it_has_alone(
    bnirl: Command, bags: list[Path], tmp_path: Path
) -> None:
    again = tmp_path / "again" / "monday"
    again.parent.mkdir()
    write_bag(again, [map_of_grid(), *walk(2)])
    demonstrations = [bags[0], again, tmp_path / "none"]
    out = tmp_path / "each"
    options = ("--report", "--seed", "3", *QUICK)
    end = bnirl("infer", *demonstrations, "--each", "--out", out, *options)
    assert end.status == 1
    told = summary_in(out)
    assert [each["folder"] for each in told] == ["monday", "monday_2", ""]
    assert [each["demonstration"] for each in told] == list(map(str, demonstrations))
    assert told[2]["observations"] is None
    assert end.lines == [f"bnirl: {told[2]['error']}"]
    assert "none: does not exist" in told[2]["error"]
    for bag, each in zip(demonstrations[:2], told[:2], strict=True):
        alone = tmp_path / "alone"
        assert bnirl("infer", bag, "--out", alone, *options).status == 0
        for name in (*FILES, "report.html"):
            assert (out / each["folder"] / name).read_bytes() == (alone / name).read_bytes()
        document = json.loads((alone / "subgoals.json").read_text())
        assert each["rhat"] == document["diagnostics"]["rhat"]
        assert each["subgoals"] == len(document["subgoals"])


def test_names_are_those_of_the_files_and_none_twice(tmp_path: Path) -> None:
    (tmp_path / "a.b").mkdir()
    paths = [Path("a.mcap"), Path("x/a.csv"), Path("a_2.csv"), Path("y/a"), tmp_path / "a.b"]
    assert names_of(paths) == ["a", "a_3", "a_2", "a_4", "a.b"]
    (tmp_path / "summary.json").mkdir()
    assert names_of([tmp_path / "summary.json"]) == ["summary.json_2"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["monday", "./monday"], "monday: is named twice; name each DEMO once"),
        (["monday", "-"], "-: workers have no standard input; infer from it alone"),
        (["monday", "walk.csv"], "walk.csv: a CSV file tells no map; give one with --map"),
        (["monday", "--each", "--jobs", "0"], "must be at least 1, not 0"),
        (["monday", "--jobs", "2", "--scheduler", "tcp://x:1"], "--jobs: is for this machine"),
    ],
)
def test_wrong_arguments_end_with_status_2(
    bnirl: Command, arguments: list[str], words: str
) -> None:
    end = bnirl("infer", *arguments)
    assert (end.status, end.out) == (2, "")
    assert words in end.lines[-1]


# Workers that die


def reader_of(pipe: Path) -> int:
    """The process that has opened a named pipe to read from it, as soon as there is one.

    The test has opened it to write, and keeps it open until what is to be read is read.
    """
    while not (readers := [process for process in processes() if reads(process, pipe)]):
        time.sleep(0.05)
    return readers[0]


def processes() -> list[int]:
    """All processes but this one."""
    numbers = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
    return [number for number in numbers if number != os.getpid()]


def reads(process: int, pipe: Path) -> bool:
    """Whether a process is there and has opened a named pipe."""
    try:
        opened = list(Path("/proc", str(process), "fd").iterdir())
    except OSError:  # it is not there any more, or not ours
        return False
    for file in opened:
        try:
            if file.readlink() == pipe:
                return True
        except OSError:  # closed meanwhile
            continue
    return False


def kill_reader(pipe: Path) -> None:
    """Kill the process that reads a named pipe, or soon will, and see it gone."""
    process = reader_of(pipe)
    os.kill(process, signal.SIGKILL)
    while reads(process, pipe):
        time.sleep(0.05)


def feed(pipe: Path, file: TextIO) -> None:
    """Give the process that reads a named pipe, or soon will, the walk."""
    reader_of(pipe)
    file.write(WALK)
    file.close()


@pytest.fixture
def pipes(tmp_path: Path) -> list[Path]:
    """Named pipes in place of CSV files: a worker that reads one waits for the test."""
    made = [tmp_path / f"{name}.csv" for name in ("first", "second")]
    for pipe in made:
        os.mkfifo(pipe)
    return made


@pytest.fixture
def alone(bnirl: Command, tmp_path: Path, text_map: Path) -> dict[str, bytes]:
    """The results of the walk in a CSV file, inferred in this process."""
    table, out = tmp_path / "table.csv", tmp_path / "alone"
    table.write_text(WALK)
    assert bnirl("infer", table, "--map", text_map, "--out", out, *QUICK).status == 0
    return contents(out)


def test_a_demonstration_whose_process_dies_is_tried_again(
    bags: list[Path],
    pipes: list[Path],
    text_map: Path,
    tmp_path: Path,
    alone: dict[str, bytes],
) -> None:
    out = tmp_path / "out"
    options = ("--map", text_map, "--each", "--jobs", "2", "--out", out, *QUICK)
    process = in_process("infer", *pipes, bags[0], *options)
    with pipes[0].open("w") as file, pipes[1].open("w"):  # waits until both are read
        for pipe in pipes:
            kill_reader(pipe)
        feed(pipes[0], file)
        kill_reader(pipes[1])
        end = ended(process)
    assert end.status == 1
    assert end.lines == [
        f"bnirl: {pipes[1]}: the process that worked on it died twice, the second time with "
        "nothing beside it; it may need more memory than there is"
    ]
    assert [each["folder"] for each in summary_in(out)] == ["first", "", "monday"]
    assert contents(out / "first") == alone


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGKILL])
def test_all_processes_end_with_the_command(
    pipes: list[Path], text_map: Path, tmp_path: Path, signal_number: int
) -> None:
    # A shell's `&` would have told us, and by us the command, to ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    out = tmp_path / "out"
    process = in_process("infer", *pipes, "--map", text_map, "--jobs", "2", "--out", out)
    with pipes[0].open("w"), pipes[1].open("w"):
        workers = [reader_of(pipe) for pipe in pipes]
        if signal_number == signal.SIGINT:  # a terminal sends it to all of them
            for each in workers:
                os.kill(each, signal_number)
        process.send_signal(signal_number)
        end = ended(process)
        while any(map(reads, workers, pipes)):
            time.sleep(0.05)
    if signal_number == signal.SIGINT:
        assert (end.status, end.out, end.err) == (130, "", "bnirl: stopped\n")
    assert not out.exists()


# On a cluster


@pytest.fixture
def scheduler() -> Iterator[str]:
    """The address of a Dask cluster of two worker processes."""
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as made:
        yield made.scheduler_address


def test_a_cluster_gives_the_same_results_though_a_worker_is_killed(
    scheduler: str,
    bnirl: Command,
    bags: list[Path],
    pipes: list[Path],
    text_map: Path,
    tmp_path: Path,
    alone: dict[str, bytes],
) -> None:
    pipe, out, options = pipes[0], tmp_path / "cluster", ("--map", text_map, *QUICK)
    demonstrations = [pipe, bags[0], tmp_path / "none"]
    process = in_process(
        "infer", *demonstrations, "--each", "--scheduler", scheduler, "--out", out, *options
    )
    with pipe.open("w") as file:
        kill_reader(pipe)
        feed(pipe, file)
    end = ended(process)
    assert end.status == 1
    told = summary_in(out)
    assert [each["folder"] for each in told] == ["first", "monday", ""]
    assert "none: the worker on" in told[2]["error"]
    assert end.lines == [f"bnirl: {told[2]['error']}"]
    assert contents(out / "first") == alone

    # Pooled, the files are read by the workers that are left.
    assert bnirl("infer", *bags, "--out", tmp_path / "pooled", *options).status == 0
    end = bnirl("infer", *bags, "--scheduler", scheduler, "--out", out, *options)
    assert (end.status, end.err) == (0, "")
    assert contents(out) == contents(tmp_path / "pooled")
    assert summary_in(out) == summary_in(tmp_path / "pooled")


def test_without_a_scheduler_there_is_one_line(
    bnirl: Command, bags: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("--out", tmp_path / "out", "--scheduler")
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    monkeypatch.setattr(cluster, "_TIMEOUT", 0.1)
    end = bnirl("infer", *bags, *options, "tcp://127.0.0.1:9")
    assert_refused(end, "--scheduler tcp://127.0.0.1:9: no Dask scheduler answers there")
    end = bnirl("infer", *bags, *options, "nonsense://")
    assert_refused(end, "--scheduler nonsense://: no Dask scheduler answers there")
    monkeypatch.setitem(sys.modules, "distributed", None)
    end = bnirl("infer", *bags, *options, "tcp://127.0.0.1:9")
    assert_refused(end, "--scheduler: needs dask.distributed", "pip install 'bnirl_ros[dask]'")


def test_a_worker_with_another_version_is_told() -> None:
    with pytest.raises(cluster.OtherVersionError, match=r"not 0\.0\.0"):
        cluster.attempt_there(take, "none", "0.0.0")
