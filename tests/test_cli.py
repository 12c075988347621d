"""The commands `bnirl infer` and `bnirl predict` as their users meet them.

What they read, write, say, and end with.
"""

from __future__ import annotations

import csv
import os
import re
import signal
import subprocess
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import bnirl_ros
from bnirl_ros.bags import writer as bag_writer
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.csv_file import read_csv
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.scenarios import PAPER_LOOP, shipped_demonstration
from bnirl_ros.inference.posterior import grid_world, infer
from bnirl_ros.inference.prediction import predict, predict_at, predict_from_mode
from bnirl_ros.inference.scoring import WITHOUT_MODEL, losses
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap, occupancy_of, parse_text_grid
from bnirl_ros.mdp.actions import ACTION_NAMES, ACTION_SETS
from bnirl_ros.model.pursuits import PRIORS
from cli_support import (
    FILES,
    QUICK,
    Command,
    Ended,
    arrays_in,
    assert_refused,
    contents,
    document_in,
    ended,
    in_process,
)
from demonstration_support import (
    BAD_COUNTS,
    BAGS,
    CORNERS,
    GRID,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    action_of,
    bad_maps,
    bad_messages,
    bag_with_odd_topic,
    map_of_grid,
    mcap_of,
    pose_at,
    truncated,
    walk,
    write_bag,
    write_odd_mcap,
)

pytestmark = pytest.mark.timeout(180)

PAPER_BAG = BAGS / PAPER_LOOP.name
MODELS = ("sequential", "paper")
DOCUMENT = {
    "sequential": [
        "format",
        "frame_id",
        "resolution",
        "model",
        "subgoals",
        "visit_sequence",
        "repetitions",
        "episodes",
        "unexplained",
        "parameters",
        "diagnostics",
    ],
    "paper": [
        "format",
        "frame_id",
        "resolution",
        "model",
        "subgoals",
        "visit_sequence",
        "diagnostics",
    ],
}
"""The fields of subgoals.json, by model."""

SUBGOAL = ["rank", "cell", "position", "probability", "observations", "visit_order"]


def cells_in(folder: Path) -> set[tuple[int, ...]]:
    return {tuple(subgoal["cell"]) for subgoal in document_in(folder)["subgoals"]}


@dataclass(frozen=True)
class Run:
    """`bnirl infer bags/paper_loop` in a process, with no option but perhaps the model."""

    model: str
    end: Ended
    folder: Path

    @property
    def results(self) -> Path:
        return self.folder / "bnirl_out"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    """A run with each model; the sequential one is the default and is not named."""
    finished = {}
    for model, option in (("sequential", []), ("paper", ["--model", "paper"])):
        folder = tmp_path_factory.mktemp(model)
        end = ended(in_process("infer", PAPER_BAG, *option, cwd=folder))
        finished[model] = Run(model, end, folder)
    return finished


@pytest.fixture(params=MODELS)
def run(request: pytest.FixtureRequest, runs: dict[str, Run]) -> Run:
    """The run with each model in turn."""
    return runs[request.param]


@pytest.fixture
def walk_bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "walk", [map_of_grid(), *walk()])


# What it writes


def test_three_files_a_table_and_status_0(run: Run) -> None:
    assert (run.end.status, run.end.err) == (0, "")
    assert sorted(path.name for path in run.results.iterdir()) == FILES
    assert run.end.out.splitlines()[0].split()[:2] == ["rank", "cell"]
    assert all(f"bnirl_out/{name}" in run.end.out for name in FILES)
    for x, y in PAPER_LOOP.subgoals:
        assert f"({x}, {y})" in run.end.out


def test_subgoals_json_is_the_contract(run: Run) -> None:
    document, arrays = document_in(run.results), arrays_in(run.results)
    assert list(document) == DOCUMENT[run.model]
    assert (document["format"], document["frame_id"], document["resolution"]) == (1, "map", 1.0)
    model = document["model"]
    assert list(model) == ["name", "alpha", "eta", "discount", "success"]
    assert (model["name"], model["discount"], model["success"]) == (run.model, 0.99, 0.7)
    if run.model == "paper":
        assert (model["alpha"], model["eta"]) == (50.0, 1.0)
    assert set(document["diagnostics"]) >= {"rhat", "ess", "chains", "draws"}
    assert document["diagnostics"]["chains"] == 4
    assert document["diagnostics"]["draws"] == 800
    assert 0.99 < document["diagnostics"]["rhat"] < 1.05
    assert 100 < document["diagnostics"]["ess"] <= 4000
    told = {name: document["diagnostics"][name] for name in ("sweeps", "burn_in", "thin")}
    assert told == {"sweeps": 1000, "burn_in": 200, "thin": 1}
    assert document["diagnostics"]["stopped"] == "sweep limit"
    agreed = document["diagnostics"]["rhat"] <= 1.01 and document["diagnostics"]["ess"] >= 400
    assert document["diagnostics"]["converged"] == agreed
    verdict = "the chains have converged after" if agreed else "the chains have not converged"
    assert verdict in run.end.out
    assert re.search(r"^1,000 sweeps took .* s: .* effective samples a second", run.end.out, re.M)

    subgoals = document["subgoals"]
    check_subgoals(document, arrays)
    assert {tuple(subgoal["cell"]) for subgoal in subgoals} == set(PAPER_LOOP.subgoals)
    ranked_by = "observations" if run.model == "paper" else "pursuits"
    values = [subgoal[ranked_by] for subgoal in subgoals]
    assert values == sorted(values, reverse=True)
    fields_told = SUBGOAL if run.model == "paper" else [*SUBGOAL, "pursuits"]
    assert all(list(subgoal) == fields_told for subgoal in subgoals)
    order = {tuple(subgoal["cell"]): subgoal["visit_order"] for subgoal in subgoals}
    assert [order[cell] for cell in PAPER_LOOP.subgoals] == [[1], [2], [3], [4]]
    rank_of = {tuple(subgoal["cell"]): subgoal["rank"] for subgoal in subgoals}
    assert document["visit_sequence"] == [rank_of[cell] for cell in PAPER_LOOP.subgoals]


def check_subgoals(document: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """The subgoals of a map of cells of 1 m are those of the mode, with what the arrays say."""
    subgoals = document["subgoals"]
    mode = arrays["mode_subgoal_of"]
    candidates, counts = np.unique(mode[mode >= 0], return_counts=True)
    cells = arrays["candidates"][candidates].tolist()
    count_of = dict(zip(map(tuple, cells), counts.tolist(), strict=True))
    index_of = dict(zip(map(tuple, cells), candidates.tolist(), strict=True))
    assert [subgoal["rank"] for subgoal in subgoals] == list(range(1, len(subgoals) + 1))
    assert {tuple(subgoal["cell"]) for subgoal in subgoals} == set(count_of)
    for subgoal in subgoals:
        cell = tuple(subgoal["cell"])
        assert subgoal["position"] == [cell[0] + 0.5, cell[1] + 0.5]
        assert subgoal["observations"] == count_of[cell]
        occurs = (arrays["subgoal_of"] == index_of[cell]).any(axis=2)
        assert subgoal["probability"] == pytest.approx(occurs.mean())


def runs_of(
    subgoal_of: np.ndarray, observations: np.ndarray
) -> dict[int, list[tuple[int, int, int]]]:
    """(subgoal, first, last) of the maximal runs of one subgoal, by episode; slips left out."""
    found: dict[int, list[tuple[int, int, int]]] = {}
    for row, (subgoal, episode) in enumerate(
        zip(subgoal_of.tolist(), observations[:, 0].tolist(), strict=True)
    ):
        runs = found.setdefault(episode, [])
        if subgoal < 0:
            continue
        if runs and runs[-1][0] == subgoal:
            runs[-1] = (subgoal, runs[-1][1], row)
        else:
            runs.append((subgoal, row, row))
    return found


def check_pursuits(document: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """What the sequential model adds to subgoals.json is what the arrays say."""
    observations = arrays["observations"]
    draws = arrays["subgoal_of"].reshape(-1, len(observations))
    index_of = {tuple(cell): index for index, cell in enumerate(arrays["candidates"].tolist())}
    candidate_of = {
        subgoal["rank"]: index_of[tuple(subgoal["cell"])] for subgoal in document["subgoals"]
    }
    expected = np.zeros(len(arrays["candidates"]))
    for subgoal_of in draws:
        for runs in runs_of(subgoal_of, observations).values():
            for candidate, _, _ in runs:
                expected[candidate] += 1 / len(draws)
    for subgoal in document["subgoals"]:
        assert isinstance(subgoal["pursuits"], float)
        assert subgoal["pursuits"] == pytest.approx(expected[candidate_of[subgoal["rank"]]])

    assert isinstance(document["repetitions"], int)
    assert isinstance(document["unexplained"], float)
    assert document["unexplained"] == pytest.approx((draws < 0).mean())

    told = {}
    for episode in document["episodes"]:
        assert list(episode) == ["episode", "pursuits"]
        for pursuit in episode["pursuits"]:
            assert list(pursuit) == ["rank", "first", "last", "arrived"]
            assert isinstance(pursuit["arrived"], bool)
        told[episode["episode"]] = [
            (candidate_of[pursuit["rank"]], pursuit["first"], pursuit["last"])
            for pursuit in episode["pursuits"]
        ]
    assert list(told) == sorted(told)
    assert told == runs_of(arrays["mode_subgoal_of"], observations)

    assert list(document["parameters"]) == arrays["parameter_names"].tolist() == list(PRIORS)
    drawn = arrays["parameters"].reshape(-1, len(PRIORS))
    for column, parameter in enumerate(document["parameters"].values()):
        assert list(parameter) == ["median", "interval", "inferred"]
        assert isinstance(parameter["inferred"], bool)
        low, median, high = np.quantile(drawn[:, column], (0.05, 0.5, 0.95))
        assert parameter["median"] == pytest.approx(median)
        assert parameter["interval"] == pytest.approx([low, high])
        assert parameter["inferred"] == (low < high)
    for name in ("alpha", "eta"):
        assert document["model"][name] == document["parameters"][name]["median"]


def test_subgoals_json_tells_the_pursuits_of_the_sequential_model(runs: dict[str, Run]) -> None:
    document = document_in(runs["sequential"].results)
    check_pursuits(document, arrays_in(runs["sequential"].results))
    # Five episodes, each once round the loop and to its end.
    loop = document["visit_sequence"]
    assert document["repetitions"] == 5
    assert [episode["episode"] for episode in document["episodes"]] == [0, 1, 2, 3, 4]
    for episode in document["episodes"]:
        assert [pursuit["rank"] for pursuit in episode["pursuits"]] == loop
        assert all(pursuit["arrived"] for pursuit in episode["pursuits"])
    assert all(4.9 < subgoal["pursuits"] < 5.1 for subgoal in document["subgoals"])
    assert 0.0 <= document["unexplained"] < 0.01
    assert all(parameter["inferred"] for parameter in document["parameters"].values())
    assert document["parameters"]["switch_on_arrival"]["median"] > 0.8
    assert document["parameters"]["switch_elsewhere"]["median"] < 0.02


def test_posterior_npz_is_the_contract(run: Run) -> None:
    arrays = arrays_in(run.results)
    demonstration = shipped_demonstration(PAPER_LOOP)
    count, candidates = len(demonstration), len(arrays["candidates"])
    shapes = {name: values.shape for name, values in arrays.items()}
    whole_numbers = {
        "candidates": (candidates, 2),
        "observations": (count, 4),
        "subgoal_of": (4, 800, count),
        "partition_of": (4, 800, count),
        "mode_subgoal_of": (count,),
        "mode_partition_of": (count,),
    }
    expected = whole_numbers | {"log_joint": (4, 800)}
    if run.model == "sequential":
        expected |= {"parameters": (4, 800, 6), "parameter_names": (6,)}
    assert shapes == expected
    assert arrays["subgoal_of"].dtype == arrays["partition_of"].dtype == np.int32
    assert arrays["log_joint"].dtype == np.float64
    assert all(arrays[name].dtype.kind == "i" for name in whole_numbers)

    np.testing.assert_array_equal(arrays["observations"], demonstration.observations)
    visited = {tuple(cell) for cell in demonstration.cells.tolist()}
    visited |= {tuple(cell) for cell in demonstration.last_cells.tolist()}
    assert sorted(map(tuple, arrays["candidates"].tolist())) == sorted(visited)
    # A slip is explained by no subgoal; the paper's model knows none.
    assert arrays["subgoal_of"].min() == (-1 if run.model == "sequential" else 0)
    assert arrays["subgoal_of"].max() < candidates
    assert np.isfinite(arrays["log_joint"]).all()
    check_partitions(arrays)
    if run.model == "sequential":
        assert arrays["parameter_names"].tolist() == list(PRIORS)
        assert arrays["parameters"].dtype == np.float64
        assert (arrays["parameters"] > 0.0).all()
        assert (arrays["parameters"][..., 2:] < 1.0).all()


def check_partitions(arrays: dict[str, np.ndarray]) -> None:
    """A partition has one subgoal; their numbers start from 0 and leave none out.

    Slips, -1, are in none.
    """
    np.testing.assert_array_equal(arrays["partition_of"] < 0, arrays["subgoal_of"] < 0)
    mode = np.stack([arrays["mode_partition_of"], arrays["mode_subgoal_of"]])
    last = np.stack([arrays["partition_of"][-1, -1], arrays["subgoal_of"][-1, -1]])
    for partition_of, subgoal_of in (mode, last):
        assert min(partition_of.min(), subgoal_of.min()) >= -1
        pairs = {*zip(partition_of.tolist(), subgoal_of.tolist(), strict=True)} - {(-1, -1)}
        assert sorted(partition for partition, _ in pairs) == list(range(len(pairs)))
        assert all(subgoal >= 0 for _, subgoal in pairs)


def test_actions_that_no_subgoal_explains_are_told_as_such(bnirl: Command, tmp_path: Path) -> None:
    (tmp_path / "map.txt").write_text(GRID)
    bag = write_bag(tmp_path / "walk", [map_of_grid(), *walk(rounds=6)])
    rounds = place(read_demonstration(bag, {}).recording, MAP).demonstration.observations.copy()
    # In the middle of three sides, once each the opposite of what it does before and after.
    slips = [2, 3 * OBSERVATIONS_OF_WALK + 9, 5 * OBSERVATIONS_OF_WALK + 14]
    rounds[slips, 3] = (rounds[slips, 3] + 3) % 8 + 1
    table = write_csv(tmp_path / "demo.csv", rounds)
    end = bnirl("infer", table, "--map", tmp_path / "map.txt", "--out", tmp_path, *QUICK)
    assert end.status == 0
    document, arrays = document_in(tmp_path), arrays_in(tmp_path)
    assert np.flatnonzero(arrays["mode_subgoal_of"] < 0).tolist() == slips
    assert np.flatnonzero(arrays["mode_partition_of"] < 0).tolist() == slips
    assert 0.8 * len(slips) / len(rounds) < document["unexplained"] < 2 * len(slips) / len(rounds)
    check_subgoals(document, arrays)
    check_pursuits(document, arrays)
    check_partitions(arrays)
    # Slips neither end a pursuit nor begin one.
    assert [len(episode["pursuits"]) for episode in document["episodes"]] == [4] * 6
    assert document["repetitions"] == 6
    # Told what is never explained, the mode needs no slip.
    arguments = ("--slip", "0", "--alpha", "1", "--out", tmp_path, *QUICK)
    assert bnirl("infer", table, "--map", tmp_path / "map.txt", *arguments).status == 0
    assert document_in(tmp_path)["unexplained"] == 0.0
    assert arrays_in(tmp_path)["subgoal_of"].min() >= 0


def test_subgoals_png_is_a_picture(run: Run) -> None:
    with Image.open(run.results / "subgoals.png") as picture:
        picture.load()
        assert picture.format == "PNG"
        assert min(picture.size) > 300
        assert len(picture.convert("RGB").getcolors(maxcolors=2**24)) > 10


def test_the_defaults_are_those_of_the_contract(run: Run, bnirl: Command, tmp_path: Path) -> None:
    spelt_out = {
        "model": run.model,
        "sweeps": 1000,
        "burn-in": 200,
        "thin": 1,
        "chains": 4,
        "seed": 0,
        "success": 0.7,
        "discount": 0.99,
        "moves": 8,
        "candidates": "visited",
    }
    if run.model == "paper":
        spelt_out |= {"alpha": 50, "eta": 1}
    else:
        spelt_out |= {"likelihood": "delay", "arrival-radius": 0}
    options = [f"--{name}={value}" for name, value in spelt_out.items()]
    assert bnirl("infer", PAPER_BAG, "--out", tmp_path, *options).status == 0
    assert contents(tmp_path) == contents(run.results)


@pytest.mark.parametrize("name", MODELS)
def test_settings_count(bnirl: Command, walk_bag: Path, tmp_path: Path, name: str) -> None:
    model = [f"--model={name}", "--alpha=20", "--eta=0.5", "--success=0.9", "--discount=0.95"]
    sampling = ["--candidates=free", "--sweeps=50", "--burn-in=10", "--thin=4", "--chains=1"]
    assert bnirl("infer", walk_bag, "--out", tmp_path, *model, *sampling).status == 0
    document, arrays = document_in(tmp_path), arrays_in(tmp_path)
    assert document["model"] == {
        "name": name,
        "alpha": 20.0,
        "eta": 0.5,
        "discount": 0.95,
        "success": 0.9,
    }
    assert document["diagnostics"]["rhat"] is None  # a single chain has none
    assert arrays["subgoal_of"].shape == (1, 10, OBSERVATIONS_OF_WALK)
    assert len(arrays["candidates"]) == MAP.free.sum()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("alpha", 20.0),
        ("eta", 0.5),
        ("slip", 0.25),
        ("switch-on-arrival", 0.9),
        ("switch-at-subgoal", 0.25),
        ("switch-elsewhere", 0.05),
    ],
)
def test_each_parameter_can_be_fixed(
    bnirl: Command, walk_bag: Path, tmp_path: Path, option: str, value: float
) -> None:
    fixed = option.replace("-", "_")
    end = bnirl("infer", walk_bag, "--out", tmp_path, f"--{option}={value}", *QUICK)
    assert end.status == 0
    document, arrays = document_in(tmp_path), arrays_in(tmp_path)
    told = document["parameters"]
    assert told[fixed] == {"median": value, "interval": [value, value], "inferred": False}
    assert [name for name, each in told.items() if not each["inferred"]] == [fixed]
    constant = arrays["parameters"].min(axis=(0, 1)) == arrays["parameters"].max(axis=(0, 1))
    assert constant.tolist() == [name == fixed for name in PRIORS]
    check_pursuits(document, arrays)


def test_the_arrival_radius_and_the_likelihood_count(
    bnirl: Command, walk_bag: Path, tmp_path: Path
) -> None:
    results = []
    for number, option in enumerate(("--arrival-radius=0", "--arrival-radius=1.5")):
        out = tmp_path / str(number)
        assert bnirl("infer", walk_bag, "--out", out, option, *QUICK).status == 0
        results.append(contents(out)["posterior.npz"])
    assert results[0] != results[1]
    out = tmp_path / "value"
    assert bnirl("infer", walk_bag, "--out", out, "--likelihood=value", *QUICK).status == 0
    assert contents(out)["posterior.npz"] not in results
    # Its alpha is that of (7), much larger than nats for a step.
    assert document_in(out)["model"]["alpha"] > 10.0


# The same posterior, whatever is in between


@pytest.mark.parametrize("model", MODELS)
def test_the_same_seed_gives_the_same_bytes_on_any_number_of_cores(
    bnirl: Command, walk_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    options = ("--model", model, *QUICK)
    results = []
    for number, cores in enumerate((1, 2, 16)):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        out = tmp_path / str(number)
        assert bnirl("infer", walk_bag, "--out", out, *options, "--seed", "7").status == 0
        results.append(contents(out))
    assert results[0] == results[1] == results[2]
    assert ended(in_process("infer", walk_bag, "--out", out, *options, "--seed", "7")).status == 0
    assert contents(out) == results[0]
    assert bnirl("infer", walk_bag, "--out", out, *options, "--seed", "8").status == 0
    assert contents(out)["posterior.npz"] != results[0]["posterior.npz"]


def write_csv(path: Path, observations: np.ndarray) -> Path:
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["episode", "x", "y", "action"])
        for episode, x, y, action in observations.tolist():
            table.writerow([episode, x, y, ACTION_NAMES[action]])
    return path


def write_nav2_map(folder: Path, grid_map: GridMap) -> Path:
    height, width = grid_map.free.shape
    occupancy = occupancy_of(grid_map).reshape(height, width)[::-1]
    Image.fromarray(np.where(occupancy > 0, 0, 254).astype(np.uint8)).save(folder / "map.pgm")
    path = folder / "map.yaml"
    path.write_text(
        "image: map.pgm\nresolution: 1.0\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    return path


@pytest.mark.parametrize("model", MODELS)
def test_folder_file_and_csv_with_either_map_are_the_same_demonstration(
    bnirl: Command, tmp_path: Path, model: str
) -> None:
    text_grid = tmp_path / "map.txt"
    text_grid.write_text(PAPER_LOOP.grid.strip() + "\n")
    nav2_map = write_nav2_map(tmp_path, PAPER_LOOP.grid_map)
    options = ("--model", model, *QUICK)
    table = write_csv(tmp_path / "demo.csv", shipped_demonstration(PAPER_LOOP).observations)
    results = []
    for number, arguments in enumerate(
        [
            (PAPER_BAG,),
            (mcap_of(PAPER_BAG),),
            (mcap_of(PAPER_BAG), "--map", nav2_map),
            (table, "--map", text_grid),
            (table, "--map", nav2_map),
        ]
    ):
        out = tmp_path / str(number)
        end = bnirl("infer", *arguments, "--out", out, *options)
        assert (end.status, end.err) == (0, "")
        results.append((contents(out), document_in(out)))
    bags, tables = results[:3], results[3:]
    assert all(result == results[0] for result in bags)
    assert tables[0] == tables[1]
    # The loop's last poses, which a CSV file does not tell, are visited otherwise as well.
    assert tables[0][0]["posterior.npz"] == bags[0][0]["posterior.npz"]
    if model == "paper":
        assert tables[0] == bags[0]
        return
    # All that they are missed for is whether an episode's last pursuit got there.
    last = [
        [episode["pursuits"][-1].pop("arrived") for episode in document["episodes"]]
        for _, document in (bags[0], tables[0])
    ]
    assert last == [[True] * 5, [False] * 5]
    assert tables[0][1] == bags[0][1]


def test_a_remapped_topic_is_read(bnirl: Command, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [map_of_grid(), *walk()], prefix="/robot/")
    rules = [f"--remap={name}:=/robot/{name}" for name in ("pose", "action", "map")]
    end = bnirl("infer", bag, "--out", tmp_path, *QUICK, *rules)
    assert (end.status, end.err) == (0, "")
    assert cells_in(tmp_path) == set(CORNERS)
    assert bnirl("infer", bag, "--remap", "poses:=/robot/pose").status == 2
    assert bnirl("infer", bag, "--remap", "pose=/robot/pose").status == 2


def test_a_given_map_wins_over_the_recorded_one(
    bnirl: Command, walk_bag: Path, tmp_path: Path
) -> None:
    rows = GRID.splitlines()
    rows[-1] = "..#...."  # a cell on the way
    given = tmp_path / "map.txt"
    given.write_text("\n".join(rows) + "\n")
    end = bnirl("infer", walk_bag, "--map", given, "--out", tmp_path, *QUICK)
    assert end.status == 0
    assert end.err == f"bnirl: {walk_bag}: left out 1 x pose in a blocked cell\n"
    assert len(arrays_in(tmp_path)["observations"]) == OBSERVATIONS_OF_WALK - 1


# Bad input


def test_what_is_no_bag_is_refused(bnirl: Command, tmp_path: Path) -> None:
    assert_refused(bnirl("infer", tmp_path / "none"), f"{tmp_path / 'none'}: does not exist")
    (tmp_path / "empty").mkdir()
    assert_refused(bnirl("infer", tmp_path / "empty"), "holds no .mcap file")
    (tmp_path / "text.mcap").write_text("no bag")
    assert_refused(bnirl("infer", tmp_path / "text.mcap"), "is no MCAP file")


def test_bad_input_ends_a_process_with_one_line_and_no_traceback(tmp_path: Path) -> None:
    assert_refused(ended(in_process("infer", tmp_path / "none")), "does not exist")


def test_a_bag_without_the_topics_says_which_it_has(bnirl: Command, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", walk(), prefix="/robot/")
    assert_refused(
        bnirl("infer", bag),
        str(bag),
        "has no topic /pose (geometry_msgs/msg/PoseStamped), only /robot/action (",
        "/robot/pose (geometry_msgs/msg/PoseStamped)",
        "--remap pose:=/topic",
    )
    assert_refused(bnirl("infer", bag, "--remap", "pose:=/robot/pose"), "has no topic /action")
    swapped = ["--remap", "pose:=/robot/action", "--remap", "action:=/robot/pose"]
    assert_refused(
        bnirl("infer", bag, *swapped),
        "topic /robot/action is of type geometry_msgs/msg/Vector3Stamped, not geometry_msgs/msg/P",
    )


def test_a_bag_without_a_map_asks_for_one(bnirl: Command, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", walk(), topics=("pose", "action"))
    assert_refused(bnirl("infer", bag), str(bag), "no map", "--map")
    (tmp_path / "map.txt").write_text(GRID)
    arguments = ("--map", tmp_path / "map.txt", "--out", tmp_path, *QUICK)
    assert bnirl("infer", bag, *arguments).status == 0


def test_an_unknown_message_type_matters_only_where_it_is_wanted(
    bnirl: Command, tmp_path: Path
) -> None:
    odd = write_odd_mcap(tmp_path / "odd.mcap", "/pose")
    assert_refused(bnirl("infer", odd), "/pose is of type odd_msgs/msg/Odd")
    odd = write_odd_mcap(tmp_path / "odd.mcap", "/other")
    assert_refused(bnirl("infer", odd), "only /other (odd_msgs/msg/Odd)")
    bag = bag_with_odd_topic(tmp_path / "bag")
    end = bnirl("infer", bag, "--out", tmp_path, *QUICK)
    assert end.status == 0
    (line,) = end.lines
    assert line.startswith(f"bnirl: {bag}: has no metadata.yaml")
    assert cells_in(tmp_path) == set(CORNERS)


def test_of_a_truncated_bag_what_can_be_read_is_used(
    bnirl: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_writer, "CHUNK_SIZE", 2048)
    bag = write_bag(tmp_path / "bag", [map_of_grid(), *walk(rounds=3)])
    path = truncated(bag, tmp_path / "cut.mcap", share=0.5)
    end = bnirl("infer", path, "--out", tmp_path, *QUICK)
    assert end.status == 1
    assert end.lines[-1].startswith(f"bnirl: {path}: is damaged at byte ")
    assert "the results are from what could be read" in end.lines[-1]
    # Where the bag breaks off, one of the two topics may have gone further than the other.
    assert all("left out 1 x " in line for line in end.lines[:-1])
    count = len(arrays_in(tmp_path)["observations"])
    assert OBSERVATIONS_OF_WALK < count < 3 * OBSERVATIONS_OF_WALK
    assert all((tmp_path / name).is_file() for name in FILES)

    truncated(bag, path, share=0.02)
    assert_refused(bnirl("infer", path), str(path), "is damaged at byte", "/pose")


def test_messages_that_cannot_be_used_are_counted_and_the_rest_is_used(
    bnirl: Command, tmp_path: Path
) -> None:
    bad = [message for group in bad_messages(START + 9000 * SECOND).values() for message in group]
    maps = [("map", message, START) for message in bad_maps().values()]
    bag = write_bag(tmp_path / "bag", [map_of_grid(), *maps, *walk(), *bad])
    end = bnirl("infer", bag, "--out", tmp_path / "out", *QUICK)
    assert end.status == 0
    for fault, count in BAD_COUNTS.items():
        assert f"bnirl: {bag}: left out {count} x {fault}" in end.lines
    for words in bad_maps():
        (line,) = (line for line in end.lines if words in line)
        assert "left out 1 x" in line
        assert "topic /map" in line
    assert len(end.lines) == len(BAD_COUNTS) + len(bad_maps())

    good = write_bag(tmp_path / "good", [map_of_grid(), *walk()])
    assert bnirl("infer", good, "--out", tmp_path / "good_out", *QUICK).status == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "good_out")


def test_a_demonstration_with_nothing_on_the_map_is_refused(
    bnirl: Command, tmp_path: Path
) -> None:
    outside = [pose_at(99.5, 0.5, START), action_of(1.0, 0.0, START)]
    bag = write_bag(tmp_path / "bag", [map_of_grid(), *outside])
    end = bnirl("infer", bag)
    assert end.status == 1
    assert end.lines[0] == f"bnirl: {bag}: left out 1 x pose outside the map"
    assert len(end.lines) == 2
    assert f"{bag}: no pose and action of equal stamps lie on the map" in end.lines[1]


def test_a_map_without_a_free_cell_is_refused(bnirl: Command, tmp_path: Path) -> None:
    (tmp_path / "map.txt").write_text("###\n###\n")
    assert_refused(
        bnirl("infer", PAPER_BAG, "--map", tmp_path / "map.txt"), "map.txt: no cell of the map is"
    )
    blocked = bad_maps()["no cell of the map is free"]
    bag = write_bag(tmp_path / "bag", [("map", blocked, START), *walk()])
    assert_refused(
        bnirl("infer", bag), "has no map that can be used", "no cell of the map is free"
    )


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("0,1,0,up", "line 3: action is 'up'"),
        ("0,99,0,E", "line 3: cell (99, 0) is outside the map"),
        ("0,3,3,E", "line 3: cell (3, 3) is blocked"),
        ("0,nan,0,E", "line 3: x is 'nan'"),
        ("0,0", "line 3: y is ''"),
    ],
)
def test_a_bad_row_of_a_csv_is_named(bnirl: Command, tmp_path: Path, row: str, words: str) -> None:
    (tmp_path / "map.txt").write_text(GRID)
    table = tmp_path / "demo.csv"
    table.write_text(f"episode,x,y,action\n0,0,0,E\n{row}\n")
    assert_refused(bnirl("infer", table, "--map", tmp_path / "map.txt"), f"{table}, {words}")


def test_results_that_cannot_be_written_are_one_line(
    bnirl: Command, walk_bag: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        assert_refused(
            bnirl("infer", walk_bag, "--out", out, *QUICK), str(out), "cannot be written there"
        )


# Wrong arguments


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--alpha", "0"], "alpha must be above 0, not 0"),
        (["--alpha", "-1"], "alpha must be above 0, not -1"),
        (["--alpha", "nan"], "alpha must be a finite number, not nan"),
        (["--alpha", "much"], "invalid float value: 'much'"),
        (["--model", "paper", "--alpha", "0"], "alpha must be above 0, not 0"),
        (["--eta", "0"], "eta must be above 0, not 0"),
        (["--eta", "inf"], "eta must be a finite number, not inf"),
        (["--slip", "1"], "slip must be at least 0 and below 1, not 1"),
        (["--slip", "-0.1"], "slip must be at least 0 and below 1, not -0.1"),
        (["--slip", "seldom"], "invalid float value: 'seldom'"),
        *(
            ([f"--switch-{where}", value], f"switch_{where.replace('-', '_')} must be {words}")
            for where in ("on-arrival", "at-subgoal", "elsewhere")
            for value, words in (
                ("1.5", "at least 0 and at most 1, not 1.5"),
                ("-1", "at least 0 and at most 1, not -1"),
                ("nan", "a finite number, not nan"),
            )
        ),
        (["--arrival-radius", "-1"], "arrival_radius must be at least 0, not -1"),
        (["--arrival-radius", "inf"], "arrival_radius must be a finite number, not inf"),
        (["--likelihood", "nonsense"], "invalid choice: 'nonsense'"),
        (["--sweeps", "5", "--burn-in", "5"], "sweeps must leave a draw: 5 sweeps less 5"),
        (["--sweeps", "5", "--burn-in", "6"], "sweeps must leave a draw: 5 sweeps less 6"),
        (["--thin", "0"], "thin must be at least 1, not 0"),
        (["--chains", "0"], "chains must be at least 1"),
        (["--max-sweeps", "500"], "max_sweeps must be 0 or at least sweeps, 1000, not 500"),
        (["--max-sweeps", "5000", "--chains", "1"], "chains must be at least 2 with max_sweeps"),
        (["--time-budget", "-1"], "time_budget must be at least 0, not -1"),
        (["--seed", "-1"], "seed must be at least 0, not -1"),
        (["--success", "0"], "success must be above 0 and at most 1, not 0"),
        (["--discount", "1"], "discount must be at least 0 and below 1, not 1"),
        (["--moves", "5"], "invalid choice: 5 (choose from"),
        (["--model", "none"], "invalid choice: 'none'"),
        (["--candidates", "all"], "invalid choice: 'all'"),
        (["--colour", "red"], "unrecognized arguments: --colour"),
    ],
)
def test_wrong_arguments_end_with_status_2(
    bnirl: Command, arguments: list[str], words: str
) -> None:
    end = bnirl("infer", PAPER_BAG, *arguments)
    assert end.status == 2
    assert end.out == ""
    assert words in end.lines[-1]
    assert end.lines[-1].startswith(("bnirl infer: error: ", "bnirl: error: "))
    assert end.err.startswith("usage: bnirl")


def test_chains_go_on_until_they_have_converged_or_time_is_up(
    bnirl: Command, walk_bag: Path, tmp_path: Path
) -> None:
    few = ["infer", walk_bag, "--model", "paper", "--sweeps", "40", "--burn-in", "10"]
    end = bnirl(*few, "--out", tmp_path / "few")
    assert "the chains have not converged after 40 sweeps: " in end.out
    assert "; --max-sweeps 640 goes on until they have\n" in end.out
    assert not document_in(tmp_path / "few")["diagnostics"]["converged"]

    end = bnirl(*few, "--max-sweeps", "100000", "--report", "--out", tmp_path / "on")
    told = document_in(tmp_path / "on")["diagnostics"]
    assert (told["stopped"], told["converged"]) == ("converged", True)
    assert f"the chains have converged after {told['sweeps']:,} sweeps\n" in end.out
    page = (tmp_path / "on" / "report.html").read_text(encoding="utf-8")
    assert f"They have converged after {told['sweeps']:,} sweeps." in page
    same = [f"--{name.replace('_', '-')}={told[name]}" for name in ("sweeps", "burn_in", "thin")]
    bnirl(*few, *same, "--out", tmp_path / "at_once")
    at_once, on = (arrays_in(tmp_path / name) for name in ("at_once", "on"))
    for name, values in at_once.items():
        assert np.array_equal(values, on[name]), name

    end = bnirl(*few, "--time-budget", "1e-9", "--out", tmp_path / "hurried")
    assert "where the time budget was used up: 4 draws are too few to tell; raise" in end.out
    told = document_in(tmp_path / "hurried")["diagnostics"]
    assert (told["stopped"], told["sweeps"], told["rhat"]) == ("time budget", 1, None)


def test_a_csv_needs_a_map(bnirl: Command, tmp_path: Path) -> None:
    (tmp_path / "demo.csv").write_text("episode,x,y,action\n0,0,0,E\n")
    end = bnirl("infer", tmp_path / "demo.csv")
    assert end.status == 2
    assert "demo.csv: a CSV file tells no map; give one with --map" in end.lines[-1]


def test_without_arguments_the_usage_is_shown(bnirl: Command) -> None:
    for arguments in ([], ["infer"]):
        end = bnirl(*arguments)
        assert end.status == 2
        assert end.err.startswith("usage: bnirl")


def test_help_tells_every_setting_with_its_default(
    bnirl: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    end = bnirl("infer", "--help")
    assert end.status == 0
    told = end.out.split("options:")[1].split("\n  -")
    for setting in fields(Settings):
        option = "-" + setting.name.replace("_", "-")
        (words,) = (each for each in told if each.startswith(f"{option} "))
        if setting.name in PRIORS:  # inferred: it has a prior and no default
            assert f"; inferred where not given, prior {PRIORS[setting.name]}" in words
            assert "None" not in words
        else:
            assert words.rstrip().endswith(f"({setting.default})")
        for name, value in (("alpha", 50), ("eta", 1)):
            assert (f"; {value} for the paper's model" in words) == (setting.name == name)
    for option in ("--map", "--out", "--remap"):
        assert option in end.out
    assert "(bnirl_out)" in end.out
    assert bnirl("--version").out == f"bnirl {bnirl_ros.__version__}\n"


def test_a_reader_that_has_had_enough_is_no_fault(tmp_path: Path) -> None:
    process = in_process("infer", PAPER_BAG, "--out", tmp_path, *QUICK)
    assert process.stdout is not None
    process.stdout.close()
    process.stdout = None
    end = ended(process)
    assert (end.status, end.err) == (1, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES


# Foreseeing

FEW = (*QUICK, "--chains", "2")
FEW_SETTINGS = dict(sweeps=60, burn_in=20, chains=2)


def foreseen_in(folder: Path) -> list[dict[str, str]]:
    with (folder / "predictions.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def probabilities_in(rows: list[dict[str, str]], moves: int = 8) -> np.ndarray:
    names = [ACTION_NAMES[action] for action in ACTION_SETS[moves]]
    return np.array([[float(row[name]) for name in names] for row in rows])


@pytest.fixture
def rounds(tmp_path: Path) -> Path:
    """Three rounds to learn from."""
    return write_bag(tmp_path / "rounds", [map_of_grid(), *walk(rounds=3)])


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """Two shorter walks of somebody else, one of them against a wall."""
    rows = [(0, x, 0, "E") for x in range(6)] + [(0, 6, y, "N") for y in range(6)]
    rows += [(4, 6, 6, "W"), (4, 5, 6, "W"), (4, 4, 6, "N")]
    observed = [(episode, x, y, ACTION_NAMES.index(name)) for episode, x, y, name in rows]
    return write_csv(tmp_path / "other.csv", np.array(observed))


@pytest.mark.parametrize("model", MODELS)
def test_what_was_held_out_is_foreseen_and_scored(
    bnirl: Command, rounds: Path, other: Path, tmp_path: Path, model: str
) -> None:
    options = ("--held-out", other, "--model", model, "--out", tmp_path / "out", *FEW)
    end = bnirl("predict", rounds, *options)
    assert (end.status, end.err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["predictions.csv"]
    assert str(tmp_path / "out" / "predictions.csv") in end.out

    # All of it as from Python.
    settings = Settings(model=model, **FEW_SETTINGS)
    learnt = place(read_demonstration(rounds, {}).recording, MAP).demonstration
    held_out = read_csv(other, MAP)
    posterior = infer(learnt, MAP, settings)
    told = predict(posterior, held_out, MAP)
    rows = foreseen_in(tmp_path / "out")
    ends = ["foreseen", "subgoal_x", "subgoal_y", "subgoal_probability"]
    assert list(rows[0]) == ["held_out", "episode", "x", "y", "action", *ACTION_NAMES, *ends]
    assert {row["held_out"] for row in rows} == {str(other)}
    observed = [
        [int(row["episode"]), int(row["x"]), int(row["y"]), ACTION_NAMES.index(row["action"])]
        for row in rows
    ]
    np.testing.assert_array_equal(observed, held_out.observations)
    np.testing.assert_allclose(probabilities_in(rows), told.probability, atol=1e-6)
    np.testing.assert_allclose(probabilities_in(rows).sum(axis=1), 1.0, atol=1e-5)
    names = [ACTION_NAMES[action] for action in told.most_probable]
    assert [row["foreseen"] for row in rows] == names
    cells = [[int(row["subgoal_x"]), int(row["subgoal_y"])] for row in rows]
    np.testing.assert_array_equal(cells, posterior.candidates.coordinates[told.subgoal])
    shares = [float(row["subgoal_probability"]) for row in rows]
    np.testing.assert_allclose(shares, told.subgoal_probability, atol=1e-6)

    world = grid_world(MAP, settings)
    mode = predict_from_mode(posterior, held_out, MAP)
    expected = {"predictive": told.probability, "likeliest subgoal (19)": mode.probability}
    for name, prediction in WITHOUT_MODEL.items():
        expected[name] = prediction(learnt, held_out, world)
    lines = [line.rsplit(maxsplit=2) for line in end.out.splitlines()[1 : 1 + len(expected)]]
    scored = {name.strip(): (log, zero_one) for name, log, zero_one in lines}
    for name, probability in expected.items():
        lost = losses(probability, held_out, world)
        assert scored[name] == (f"{lost.log.mean():.3f}", f"{lost.zero_one.mean():.3f}")
    assert scored["always stay"][0] == "inf"
    assert "15 actions in 2 episodes held out" in end.out


def test_of_several_files_each_is_foreseen_for_itself(
    bnirl: Command, rounds: Path, other: Path, tmp_path: Path
) -> None:
    once = bnirl("predict", rounds, "--held-out", other, "--out", tmp_path / "once", *FEW)
    files = ("--held-out", other, "--held-out", write_bag(tmp_path / "b", walk()))
    end = bnirl("predict", rounds, *files, "--out", tmp_path / "both", *FEW)
    assert (once.status, end.status) == (0, 0)
    rows = foreseen_in(tmp_path / "both")
    assert rows[:15] == foreseen_in(tmp_path / "once")
    assert {row["held_out"] for row in rows[15:]} == {str(tmp_path / "b")}
    assert len(rows) == 15 + OBSERVATIONS_OF_WALK
    assert f"{len(rows)} actions in 3 episodes held out" in end.out


def test_who_begins_in_a_cell_is_foreseen(bnirl: Command, rounds: Path, tmp_path: Path) -> None:
    end = bnirl("predict", rounds, "--out", tmp_path / "visited", *FEW)
    assert (end.status, end.err) == (0, "")
    rows = foreseen_in(tmp_path / "visited")
    learnt = place(read_demonstration(rounds, {}).recording, MAP).demonstration
    visited = {tuple(cell) for cell in learnt.cells.tolist()}
    assert [(int(row["x"]), int(row["y"])) for row in rows] == sorted(
        visited, key=lambda cell: (cell[1], cell[0])
    )
    assert all(row["held_out"] == row["episode"] == row["action"] == "" for row in rows)
    told = predict_at(infer(learnt, MAP, Settings(**FEW_SETTINGS)), [(0, 0), (6, 3)], MAP)
    options = ("--cell", "0,0", "--cell", "6,3", "--out", tmp_path / "two")
    end = bnirl("predict", rounds, *options, *FEW)
    assert end.status == 0
    two = foreseen_in(tmp_path / "two")
    np.testing.assert_allclose(probabilities_in(two), told.probability, atol=1e-6)
    assert two == [row for row in rows if (row["x"], row["y"]) in (("0", "0"), ("6", "3"))]
    assert "(0, 0)" in end.out
    assert "(6, 3)" in end.out
    # On the terminal, what is likeliest comes first, with all that do the same.
    best = np.argmax(told.probability[1])
    assert f"{ACTION_NAMES[best]} {told.probability[1, best]:.2f}, " in end.out.splitlines()[2]


def test_of_many_cells_the_terminal_shows_the_first_ones(
    bnirl: Command, rounds: Path, tmp_path: Path
) -> None:
    end = bnirl("predict", rounds, "--candidates", "free", "--out", tmp_path, *FEW)
    assert end.status == 0
    assert len(foreseen_in(tmp_path)) == MAP.free.sum() == 48
    assert end.out.splitlines()[21] == "and 28 cells more"
    assert len(end.out.splitlines()) == 25


def test_with_four_moves_five_actions_are_foreseen(
    bnirl: Command, other: Path, tmp_path: Path
) -> None:
    (tmp_path / "map.txt").write_text(GRID)
    options = ("--map", tmp_path / "map.txt", "--moves", "4", "--out", tmp_path, *FEW)
    assert bnirl("predict", other, *options).status == 0
    rows = foreseen_in(tmp_path)
    assert list(rows[0])[5:10] == ["stay", "E", "N", "W", "S"]
    assert list(rows[0])[10] == "foreseen"
    np.testing.assert_allclose(probabilities_in(rows, 4).sum(axis=1), 1.0, atol=1e-5)


def test_feature_subgoals_are_foreseen_with(
    bnirl: Command, rounds: Path, other: Path, tmp_path: Path
) -> None:
    rooms = tmp_path / "rooms.txt"
    rooms.write_text("\n".join([*["4 4 4 0 3 3 3"] * 3, *["1 1 1 0 2 2 2"] * 4]) + "\n")
    options = ("--features", rooms, "--held-out", other, "--out", tmp_path, *FEW)
    end = bnirl("predict", rounds, *options)
    assert (end.status, end.err) == (0, "")
    rows = foreseen_in(tmp_path)
    assert list(rows[0])[-2:] == ["subgoal_feature", "subgoal_probability"]
    assert {row["subgoal_feature"] for row in rows} <= {"0", "1", "2", "3", "4"}
    assert bnirl("predict", rounds, "--features", rooms, "--out", tmp_path, *FEW).status == 0


def test_what_was_learnt_from_is_no_measure(bnirl: Command, rounds: Path, tmp_path: Path) -> None:
    end = bnirl("predict", rounds, "--held-out", rounds, "--out", tmp_path, *FEW)
    assert end.status == 0
    assert end.lines == [
        f"bnirl: {rounds}: is what was learnt from; how well it is foreseen tells little"
    ]


def test_what_cannot_be_foreseen_is_refused(
    bnirl: Command, rounds: Path, other: Path, tmp_path: Path
) -> None:
    none, out = tmp_path / "none", ("--out", tmp_path / "out", *FEW)
    assert_refused(bnirl("predict", none, *out), f"{none}: does not exist")
    for path in (none, tmp_path / "none.csv"):
        assert_refused(bnirl("predict", rounds, "--held-out", path, *out), str(path))
    outside = write_csv(tmp_path / "outside.csv", np.array([(0, 0, 0, 1), (0, 9, 0, 1)]))
    assert_refused(
        bnirl("predict", rounds, "--held-out", other, "--held-out", outside, *out),
        f"{outside}, line 3: cell (9, 0) is outside the map of 7 x 7 cells",
    )
    for cell, words in (("3,3", "is blocked"), ("7,0", "is outside"), (f"{10**30},0", "outside")):
        assert_refused(bnirl("predict", rounds, "--cell", cell, *out), "--cell: cell (", words)
    (tmp_path / "file").touch()
    assert_refused(
        bnirl("predict", rounds, "--out", tmp_path / "file", *FEW), "cannot be written there"
    )
    far = write_bag(tmp_path / "far", [pose_at(99.5, 0.5, START), action_of(1.0, 0.0, START)])
    end = bnirl("predict", rounds, "--held-out", far, *out)
    assert end.status == 1
    assert end.lines[0] == f"bnirl: {far}: left out 1 x pose outside the map"
    assert f"{far}: no pose and action of equal stamps lie on the map" in end.lines[1]
    assert not (tmp_path / "out").exists()


def test_where_no_subgoal_can_be_reached_nothing_is_foreseen(
    bnirl: Command, tmp_path: Path
) -> None:
    (tmp_path / "map.txt").write_text("...#.\n")
    learnt = write_csv(tmp_path / "demo.csv", np.array([(0, 0, 0, 1), (0, 1, 0, 1)]))
    held_out = write_csv(tmp_path / "other.csv", np.array([(0, 4, 0, 0)]))
    options = ("--map", tmp_path / "map.txt", "--out", tmp_path, *FEW)
    words = "cell (4, 0): no candidate can be reached from it"
    end = bnirl("predict", learnt, "--held-out", held_out, *options)
    assert_refused(end, f"{held_out}: {words}")
    assert_refused(bnirl("predict", learnt, "--cell", "4,0", *options), f"--cell: {words}")
    assert bnirl("predict", learnt, "--cell", "2,0", *options).status == 0


def test_of_a_truncated_bag_what_can_be_read_is_foreseen(
    bnirl: Command, rounds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_writer, "CHUNK_SIZE", 2048)
    whole = write_bag(tmp_path / "whole", [map_of_grid(), *walk(rounds=3)])
    cut = truncated(whole, tmp_path / "cut.mcap", share=0.5)
    end = bnirl("predict", rounds, "--held-out", cut, "--out", tmp_path, *FEW)
    assert end.status == 1
    assert end.lines[-1].startswith(f"bnirl: {cut}: is damaged at byte ")
    assert "the results are from what could be read" in end.lines[-1]
    assert OBSERVATIONS_OF_WALK < len(foreseen_in(tmp_path)) < 3 * OBSERVATIONS_OF_WALK


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--cell", "3"], "argument --cell: must be x,y, two whole numbers such as 3,1, not '3'"),
        (["--cell", "a,b"], "must be x,y"),
        (["--cell", "1,2,3"], "must be x,y"),
        (["--cell", "1.5,2"], "must be x,y"),
        (["--cell", "0,0", "--held-out", "b"], "not allowed with argument"),
        (["--alpha", "0"], "alpha must be above 0, not 0"),
        (["--remap", "poses:=/pose"], "--remap poses:=/pose: must be one of"),
    ],
)
def test_wrong_arguments_of_predict_end_with_status_2(
    bnirl: Command, arguments: list[str], words: str
) -> None:
    end = bnirl("predict", PAPER_BAG, *arguments)
    assert (end.status, end.out) == (2, "")
    assert end.lines[-1].startswith("bnirl predict: error: ")
    assert words in end.lines[-1]


def test_predict_has_every_option_of_infer(bnirl: Command) -> None:
    told = {
        command: set(re.findall(r"^  (--[a-z-]+)", bnirl(command, "--help").out, re.MULTILINE))
        for command in ("infer", "predict")
    }
    of_infer = {"--report", "--each", "--jobs", "--scheduler"}
    assert told["predict"] - told["infer"] == {"--held-out", "--cell"}
    assert told["infer"] - told["predict"] == of_infer


# Stopping it


@pytest.mark.parametrize("moment", ["while it reads", "while it samples"])
def test_ctrl_c_ends_with_status_130_and_one_line(tmp_path: Path, moment: str) -> None:
    # A pipe in place of the file: when both ends are open, the command is there and reads.
    table = tmp_path / "demo.csv"
    os.mkfifo(table)
    (tmp_path / "map.txt").write_text(GRID)
    endless = ("--sweeps", "100000000", "--burn-in", "99000000", "--thin", "1000")
    out = tmp_path / "out"
    # A shell's `&` would have told us, and by us the command, to ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    process = in_process("infer", table, "--map", tmp_path / "map.txt", "--out", out, *endless)
    with table.open("w") as file:
        file.write("episode,x,y,action\n0,0,0,E\n0,1,0,NE\n")
        file.flush()
        if moment == "while it reads":
            process.send_signal(signal.SIGINT)
            end = ended(process)
    if moment == "while it samples":
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=2)
        process.send_signal(signal.SIGINT)
        end = ended(process)
    assert (end.status, end.out, end.err) == (130, "", "bnirl: stopped\n")
    assert not out.exists()


def test_the_tests_grid_is_what_its_text_says() -> None:
    np.testing.assert_array_equal(parse_text_grid(GRID, "grid").free, MAP.free)
    assert not MAP.free[3, 3]
