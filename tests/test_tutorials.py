"""The tutorials name what is there, and print what the code does where that takes no robot."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from bnirl_ros.bags.raw_demonstration import read_raw_demonstration
from bnirl_ros.cli import main, parser
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.views.waypoint_files import waypoints_yaml
from bnirl_ros.views.waypoints import visits_of, waypoints_of
from launch_support import ROOT, declared
from test_readme import FENCE, PAGES, fenced, spans

BAG, NAV2 = (PAGES[f"docs/tutorial_{name}.md"] for name in ("bag", "nav2"))
TUTORIALS = (BAG, NAV2)

OF_OTHERS = (".", "colcon", "pip", "python3", "rosbags-convert")
"""Commands that are none of this package's or of ROS."""


def commands(page: str) -> list[list[str]]:
    """The words of each command in shell blocks."""
    lines = [line for block in fenced(page, "sh") for line in block.splitlines()]
    return [shlex.split(line) for line in lines]


def shown(page: str) -> Iterator[tuple[list[str], str]]:
    """The words of each command that stands alone in a block, and the output in the next block."""
    blocks = FENCE.findall(page)
    for (kind, text), (next_kind, output) in pairwise(blocks):
        if kind == "sh" and not next_kind and text.count("\n") == 1:
            yield shlex.split(text), output


def in_words(value: list[str] | str) -> str:
    """What a test's name says of a command; of its output, nothing."""
    return shlex.join(value) if isinstance(value, list) else ""


def check_node(name: str, arguments: list[str]) -> None:
    """The node takes these arguments: files, parameters with their types, topics."""
    from test_launch import INPUTS, OUTPUTS, PARAMETERS

    types = {parameter.name: type(parameter.default) for parameter in PARAMETERS[name]}
    ros, *rest = arguments
    assert ros == "--ros-args"
    for option, value in zip(rest[::2], rest[1::2], strict=True):
        left, separator, right = value.partition(":=")
        if option == "--params-file":
            assert f"/**/{name}" in yaml.safe_load((ROOT / value).read_text(encoding="utf-8"))
        elif option == "-p":
            assert type(yaml.safe_load(right)) is types[left], value
        else:
            assert (option, separator) == ("-r", ":=")
            assert left in {topic.name for topic in (*INPUTS[name], *OUTPUTS[name])}


def check_launch(file: str, arguments: list[str]) -> None:
    """The launch file takes these arguments, with these values."""
    choices = {each.name: each.choices for each in declared(ROOT / "launch" / file)}
    for word in arguments:
        name, separator, value = word.partition(":=")
        assert separator
        assert value in (choices[name] or [value])


@pytest.mark.parametrize(
    "command", {shlex.join(each): each for page in TUTORIALS for each in commands(page)}.values()
)
def test_commands_are_what_there_is(command: list[str]) -> None:
    pytest.importorskip("rclpy")
    from bnirl_ros.nodes.replay_node import parse
    from bnirl_ros.nodes.subgoal_node import SERVICES
    from test_launch import DIAGNOSTICS, PARAMETERS, TOPICS

    match command:
        case ["bnirl", *arguments]:
            parser().parse_args(arguments)
        case ["replay_node", *arguments]:
            parse(arguments)
        case [("subgoal_node" | "discretiser_node") as name, *arguments]:
            check_node(name, arguments)
        case ["ros2", "launch", "bnirl_ros", file, *arguments]:
            check_launch(file, arguments)
        case ["ros2", "topic", "echo", topic]:
            assert topic in {*TOPICS, DIAGNOSTICS.name}
        case ["ros2", "service", "call", service, kind]:
            types = {each.name: each.type_name for each in SERVICES}
            assert types[service.replace("/subgoal_node", "~")] == kind
        case ["ros2", "param", "set", node, name, value]:
            types = {each.name: type(each.default) for each in PARAMETERS[node.removeprefix("/")]}
            assert type(yaml.safe_load(value)) is types[name]
        case [first, *_]:
            assert first in OF_OTHERS


@pytest.mark.parametrize("page", TUTORIALS, ids=("bag", "nav2"))
def test_options_in_the_text_are_the_commands(
    page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rclpy")
    from bnirl_ros.nodes.replay_node import parse

    for help_of in (["infer", "--help"], ["waypoints", "--help"]):
        with pytest.raises(SystemExit):
            parser().parse_args(help_of)
    with pytest.raises(SystemExit):
        parse(["--help"])
    known = set(re.findall(r"--[a-z][a-z-]+", capsys.readouterr().out))
    named = {span.split()[0] for span in spans(page) if span.startswith("--")}
    assert named
    assert named <= known


def test_parameters_to_tune_are_the_nodes() -> None:
    pytest.importorskip("rclpy")
    from test_launch import PARAMETERS

    rows = NAV2[NAV2.index("| parameter |") :].split("\n\n")[0].splitlines()[2:]
    told = [re.match(r"\| `(\w+)` \|", row) for row in rows]
    names = [match[1] for match in told if match]
    assert len(names) == len(rows) == 8
    of_node = {name: {each.name for each in table} for name, table in PARAMETERS.items()}
    assert {*names[:4]} <= of_node["discretiser_node"]
    assert {*names[4:]} <= of_node["subgoal_node"]
    text = " ".join(NAV2.split())
    assert "The first four are parameters of `discretiser_node`" in text


def test_scripts_hear_topics_as_they_are_published() -> None:
    pytest.importorskip("rclpy")
    from test_launch import TOPICS

    scripts = fenced(NAV2, "python")
    heard = re.findall(r'create_subscription\((\w+), "(\w+)"', "\n".join(scripts))
    assert len(heard) == len(scripts) == 2
    for script in scripts:
        ast.parse(script)
    for kind, name in heard:
        assert TOPICS[name].type_name.rpartition("/")[2] == kind
        assert TOPICS[name].latched


def test_what_the_nodes_say_when_nothing_comes_is_in_their_code() -> None:
    rooms = [ROOT / "bnirl_ros" / name for name in ("nodes", "demonstrations", "views")]
    literals = [
        node.value
        for path in (path for room in rooms for path in sorted(room.rglob("*.py")))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    code = "\n".join(literals)
    for words in (
        "waiting for ",
        "the topic of ",
        "a map",
        "left out: ",
        ", which was not brought to the map's, ",
        " has velocity commands, which tell no place",
        " must be below longest_silence, ",
        " blocked cells of ",
        " which are open now: ",
    ):
        assert words.rstrip(": ") in NAV2
        assert words in code, words


def test_the_lifecycle_managers_nodes_are_ours() -> None:
    pytest.importorskip("rclpy")
    from test_launch import PARAMETERS

    (block,) = fenced(NAV2, "yaml")
    given = yaml.safe_load(block)["lifecycle_manager"]["ros__parameters"]
    assert {*given["node_names"]} == {*PARAMETERS}


# What is printed


@pytest.mark.parametrize(
    ("command", "output"),
    [
        (command, output)
        for command, output in shown(BAG)
        if command[:2] == ["bnirl", "info"] or output.startswith("bnirl: ")
    ],
    ids=in_words,
)
def test_what_takes_no_inference_is_printed_as_told(
    command: list[str],
    output: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT)
    status = main(command[1:])
    out, err = capsys.readouterr()
    assert out + err == output
    assert status == (1 if err else 0)


ROW = re.compile(r"^ +(\d+) +\((\d+), (\d+)\) +\((.*), (.*)\) +([\d.]+) +(\d+) +([\d.]+) +(\d+)$")


@pytest.mark.parametrize(
    ("command", "output"),
    [(command, output) for command, output in shown(BAG) if "\nrank " in f"\n{output}"],
    ids=in_words,
)
def test_subgoals_are_as_told(command: list[str], output: str) -> None:
    """The last digits may differ with the machine, whose exponential may round another way."""
    options = parser().parse_args(command[1:])
    discretising = Discretising(
        start=options.start, planning_resolution=options.planning_resolution
    )
    (demonstration,) = options.demonstrations
    recorded, words = read_raw_demonstration(ROOT / demonstration, discretising)
    assert recorded.grid_map is not None
    if "Discretised" in output:
        assert f"Discretised: {words}\n" in output
    gap = discretising.longest_silence
    demonstration = place(recorded.recording, recorded.grid_map, 8, gap).demonstration
    summary = summarise(infer(demonstration, recorded.grid_map, Settings()), recorded.grid_map)
    rows = [match.groups() for match in map(ROW.match, output.splitlines()) if match]
    assert len(rows) == len(summary.subgoals) > 5
    for row, found in zip(rows, summary.subgoals, strict=True):
        rank, x, y, east, north, probability, observations, pursuits, order = map(float, row)
        assert (found.rank, *found.cell) == (rank, x, y)
        assert found.position == pytest.approx((east, north), abs=0.006)
        assert found.probability == pytest.approx(probability, abs=0.03)
        assert found.observations == pytest.approx(observations, abs=2)
        assert found.pursuits == pytest.approx(pursuits, abs=0.15)
        assert summary.visit_sequence.index(found.rank) + 1 == order
    if options.out == Path("turtle"):
        (beginning,) = fenced(BAG, "yaml")
        visits = visits_of(summary, recorded.grid_map.frame_id)
        assert waypoints_yaml(waypoints_of(visits)).startswith(beginning)
