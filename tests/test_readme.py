"""README.md and docs/architecture.md say what is there: commands, topics, parameters, files.

`tests/test_tutorials.py` has what is special to the tutorials.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.cli import parser
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.scenarios import PAPER_LOOP
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.prediction import by_outcome, predict_at
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES
from launch_support import declared

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PAGES = {
    page: (ROOT / page).read_text(encoding="utf-8")
    for page in (
        "README.md",
        "docs/architecture.md",
        "docs/tutorial_bag.md",
        "docs/tutorial_nav2.md",
        "bags/README.md",
        "msg_schemas/README.md",
    )
}

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`]+)`")
LINK = re.compile(r"\]\(([^)]+)\)")


def fenced(page: str, language: str) -> list[str]:
    """The blocks of code in a language."""
    return [text for kind, text in FENCE.findall(page) if kind == language]


def spans(page: str) -> list[str]:
    """What stands in backticks outside blocks of code."""
    return SPAN.findall(FENCE.sub("", page))


def commands(page: str) -> list[list[str]]:
    """The words of each command in shell blocks and backticks."""
    lines = [line for block in fenced(page, "sh") for line in block.splitlines()]
    return [shlex.split(text, comments=True) for text in [*lines, *spans(page)] if "'" not in text]


def arguments_of(*beginning: str) -> list[list[str]]:
    """What follows this beginning in the README's commands that go on."""
    words = [command for command in commands(README) if command[: len(beginning)] == [*beginning]]
    return [command[len(beginning) :] for command in words if len(command) > len(beginning)]


def test_python_example_runs_and_finds_the_true_subgoals() -> None:
    (example,) = fenced(README, "python")
    assert len([line for line in example.splitlines() if line]) <= 10
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=ROOT, capture_output=True, text=True, check=True
    )
    found = re.findall(r"^\d+ \((\d+), (\d+)\) ", done.stdout, re.MULTILINE)
    assert {(int(x), int(y)) for x, y in found} == set(PAPER_LOOP.subgoals)


@pytest.mark.parametrize("arguments", arguments_of("bnirl"), ids=shlex.join)
def test_commands_parse(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    # A command's bare name, in prose, gets something to work on, and all of them show their help.
    if arguments in (["infer"], ["predict"]):
        arguments = [*arguments, "bags/paper_loop"]
    if arguments in (["replay"], ["record"]):  # their options are the nodes': see below
        return
    if "--help" in arguments:
        with pytest.raises(SystemExit, match=r"^0$"):
            parser().parse_args(arguments)
        assert "usage" in capsys.readouterr().out
        return
    assert callable(parser().parse_args(arguments).run)


def test_there_are_commands_to_parse() -> None:
    assert ["infer", "bags/overcooked_random3"] in arguments_of("bnirl")
    assert ["infer", "bags/paper_loop", "--out", "result"] in arguments_of("bnirl")


def test_commands_of_nodes_with_options_parse() -> None:
    pytest.importorskip("rclpy")
    from bnirl_ros.nodes import record_node, replay_options

    for name, parse in (("replay_node", replay_options.parse), ("record_node", record_node.parse)):
        found = arguments_of("ros2", "run", "bnirl_ros", name)
        assert found
        for arguments in found:
            parse(arguments)


def test_launch_arguments_are_declared() -> None:
    launches = arguments_of("ros2", "launch", "bnirl_ros")
    assert launches
    for file, *words in launches:
        names = {argument.name for argument in declared(ROOT / "launch" / file)}
        assert {word.partition(":=")[0] for word in words} <= names


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target, *_ in arguments_of("make"):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_modules_to_run_exist() -> None:
    for page in PAGES.values():
        for module in re.findall(r"python -m (bnirl_ros[\w.]+)", page):
            assert (ROOT / f"{module.replace('.', '/')}.py").is_file(), module


@pytest.mark.parametrize("page", PAGES)
def test_named_files_exist(page: str) -> None:
    names = [name for name in LINK.findall(PAGES[page]) if "://" not in name]
    top = {path.name for path in ROOT.iterdir()}
    for word in (word for words in commands(PAGES[page]) for word in words):
        # A path from the root; one that begins elsewhere is the reader's own, or an output.
        name = word.rpartition(":=")[2]
        if name.partition("/")[0] in top and re.fullmatch(r"[\w./-]+", name):
            names.append(name)
    assert names
    base = ROOT / Path(page).parent
    for name in names:
        assert (ROOT / name).exists() or (base / name).exists(), name


@pytest.mark.parametrize("page", PAGES)
def test_named_modules_exist(page: str) -> None:
    for name in spans(PAGES[page]):
        if re.fullmatch(r"[\w/]+\.(py|md|yaml|toml|rst)", name) and name not in (
            "__init__.py",
            "depot.yaml",
            "metadata.yaml",
            "turtle/waypoints.yaml",
            "waypoints.yaml",
        ):
            assert (ROOT / name).is_file(), name


def test_every_folder_of_the_package_is_shown() -> None:
    rooms = {path.parent for path in (ROOT / "bnirl_ros").glob("*/__init__.py")}
    for page in (README, ARCHITECTURE):
        assert {str(room.relative_to(ROOT)) for room in rooms} <= set(spans(page))


def test_names_in_the_architecture_exist() -> None:
    code = "\n".join(
        path.read_text(encoding="utf-8") for path in sorted((ROOT / "bnirl_ros").rglob("*.py"))
    )
    diagram = "\n".join(re.findall(r"^    .*$", ARCHITECTURE, re.MULTILINE))
    drawn = re.findall(r"[A-Z]?[a-z]+(?:_[a-z]+|[A-Z][a-z]+)+", diagram)
    for name in {*spans(ARCHITECTURE), *drawn}:
        if re.fullmatch(r"\w+(\(\))?", name) and not (ROOT / name).exists():
            assert re.search(rf"\b{name.removesuffix('()')}\b", code), name


def test_the_reference_is_current() -> None:
    pytest.importorskip("rclpy")
    from bnirl_ros.nodes.reference import reference

    assert (ROOT / "docs" / "reference.md").read_text(encoding="utf-8") == reference(), (
        "run make reference"
    )


def test_the_readme_names_every_topic_and_service() -> None:
    pytest.importorskip("rclpy")
    from bnirl_ros.nodes import discretiser_node, subgoal_node

    tables = (
        *(subgoal_node.INPUTS, subgoal_node.OUTPUTS, subgoal_node.SERVICES),
        *(discretiser_node.INPUTS, discretiser_node.OUTPUTS),
    )
    assert {entry.name for table in tables for entry in table} <= set(spans(README))


@pytest.fixture(scope="module")
def kitchen() -> tuple[Demonstration, GridMap]:
    """The demonstration of the demo, and its map."""
    recorded = read_demonstration(ROOT / "bags" / "overcooked_random3", {})
    assert recorded.grid_map is not None
    return place(recorded.recording, recorded.grid_map).demonstration, recorded.grid_map


def test_figures_of_the_demonstration(kitchen: tuple[Demonstration, GridMap]) -> None:
    demonstration, grid_map = kitchen
    text = " ".join(README.split())
    assert f"{len(np.unique(demonstration.episode))} episodes" in text
    assert f"with {len(demonstration):,} observations" in text
    assert f"six of the {np.count_nonzero(grid_map.free)} free cells" in text


def test_table_of_the_demo(kitchen: tuple[Demonstration, GridMap]) -> None:
    """The last digits may differ with the machine, whose exponential may round another way."""
    demonstration, grid_map = kitchen
    summary = summarise(infer(demonstration, grid_map, Settings()), grid_map)
    pattern = r"^ +(\d+)  \((\d+), (\d+)\) .*\)  +([\d.]+) +(\d+) +([\d.]+) +\d+$"
    told = [tuple(map(float, row)) for row in re.findall(pattern, README, re.MULTILINE)]
    assert len(told) == 12
    found = summary.subgoals
    for number, (rank, x, y, probability, observations, pursuits) in enumerate(told[:6]):
        subgoal = found[number]
        assert (subgoal.rank, *subgoal.cell) == (rank, x, y)
        assert subgoal.probability == pytest.approx(probability, abs=0.01)
        assert subgoal.observations == pytest.approx(observations, rel=0.1)
        assert subgoal.pursuits == pytest.approx(pursuits, rel=0.05)
    rest = {(x, y): pursuits for _, x, y, _, _, pursuits in told[6:]}
    for subgoal in found[6:]:
        assert subgoal.pursuits == pytest.approx(rest.get(subgoal.cell, 0.0), abs=3.0)
        assert (subgoal.pursuits or 0.0) < (found[5].pursuits or 0.0) / 8


def test_table_of_what_is_foreseen(kitchen: tuple[Demonstration, GridMap]) -> None:
    """With fewer sweeps than the default, which tell the same but for a few hundredths."""
    demonstration, grid_map = kitchen
    settings = Settings(moves=4, sweeps=300, burn_in=100, chains=2)
    pattern = r"^ +\((\d+), (\d+)\)  ((?:\w+ [\d.]+,? )+) +\((\d+), (\d+)\) +([\d.]+)$"
    told = re.findall(pattern, README, re.MULTILINE)
    (arguments,) = (each for each in arguments_of("bnirl", "predict") if "--cell" in each)
    cells = [[int(x), int(y)] for x, y, *_ in told]
    assert [f"{x},{y}" for x, y in cells] == arguments[arguments.index("--cell") + 1 :: 2]
    foreseen = predict_at(infer(demonstration, grid_map, settings), cells, grid_map)
    outcomes = by_outcome(foreseen.probability, foreseen.same)
    for row, (_, _, actions, _, _, share) in enumerate(told):
        for words in actions.split(","):
            name, probability = words.split()
            column = foreseen.actions.tolist().index(ACTION_NAMES.index(name))
            assert outcomes[row, column] == pytest.approx(float(probability), abs=0.04)
        assert foreseen.subgoal_probability[row] == pytest.approx(float(share), abs=0.04)
