"""The launch file, configurations, RViz's and Foxglove's files name what the nodes really have."""

from __future__ import annotations

import json
import runpy
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import yaml

from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.inference.settings import Settings
from bnirl_ros.views.diagnostics import Health, diagnostic_array
from bnirl_ros.views.messages import MarkerArray, OccupancyGrid, PoseStamped
from bnirl_ros.views.messages import Path as PathMessage
from launch_support import ROOT, Started, declared, started

rclpy = pytest.importorskip("rclpy", reason="the nodes' tables need rclpy")

from bnirl_ros.nodes import discretiser_node, subgoal_node  # noqa: E402
from bnirl_ros.nodes.managed import DIAGNOSTICS, with_common  # noqa: E402
from bnirl_ros.nodes.parameters import declare, parameter_of  # noqa: E402
from bnirl_ros.nodes.replay_options import parse  # noqa: E402

LAUNCH_FILE = ROOT / "launch" / "bringup.launch.py"
CONFIGS = sorted((ROOT / "config").iterdir())
RVIZ_FILE = ROOT / "rviz" / "subgoals.rviz"
LAYOUT_FILE = ROOT / "foxglove" / "subgoals.json"

PARAMETERS = {
    "discretiser_node": with_common(discretiser_node.PARAMETERS),
    "subgoal_node": with_common(
        [*subgoal_node.PARAMETERS, *(parameter_of(setting) for setting in fields(Settings))]
    ),
}
"""All parameters of each managed node."""

INPUTS = {"discretiser_node": discretiser_node.INPUTS, "subgoal_node": subgoal_node.INPUTS}
OUTPUTS = {"discretiser_node": discretiser_node.OUTPUTS, "subgoal_node": subgoal_node.OUTPUTS}
TOPICS = {topic.name: topic for topic in chain(*INPUTS.values(), *OUTPUTS.values())}
"""All topics of the managed nodes, by their names."""

TRANSFORMS = {"/tf", "/tf_static"}

BAG, MAP_FILE = "a bag", "a map.yaml"
CASES: tuple[tuple[dict[str, str], list[str]], ...] = (
    ({}, ["subgoal_node"]),
    ({"bag": BAG, "rate": "20.0"}, ["subgoal_node", "replay_node"]),
    (
        {"config": "nav2_robot", "rviz": "true", "namespace": "robot", "autostart": "false"},
        ["discretiser_node", "subgoal_node", "rviz2"],
    ),
    (
        {"config": "nav2_robot", "bag": BAG, "map": MAP_FILE, "use_sim_time": "true"},
        ["discretiser_node", "subgoal_node", "replay_node"],
    ),
    ({"config": "turtlesim", "discretise": "false"}, ["subgoal_node"]),
)
"""Arguments of the launch file, and what is started for them; every node, and every argument."""

ARGUMENTS = [given for given, _ in CASES]


@pytest.fixture(params=ARGUMENTS, ids=str)
def nodes(request: pytest.FixtureRequest) -> dict[str, Started]:
    """The nodes that are started, by their executables."""
    return {node.executable: node for node in started(LAUNCH_FILE, request.param)}


def of_package(nodes: Mapping[str, Started]) -> list[Started]:
    return [node for node in nodes.values() if node.package == "bnirl_ros"]


@pytest.mark.parametrize(("given", "executables"), CASES)
def test_what_is_asked_for_is_started(given: dict[str, str], executables: list[str]) -> None:
    assert [node.executable for node in started(LAUNCH_FILE, given)] == executables


def test_every_argument_is_described_and_tried() -> None:
    arguments = {argument.name: argument for argument in declared(LAUNCH_FILE)}
    assert all(argument.description for argument in arguments.values())
    assert {*chain(*ARGUMENTS)} | {"params_file"} == {*arguments}
    assert arguments["config"].choices is not None
    assert {*arguments["config"].choices} == {path.stem for path in CONFIGS}


def test_executables_and_files_are_installed(
    nodes: dict[str, Started], setup_arguments: dict[str, Any]
) -> None:
    scripts = setup_arguments["entry_points"]["console_scripts"]
    installed = {ROOT / file for _, files in setup_arguments["data_files"] for file in files}
    for node in of_package(nodes):
        assert node.executable in {script.split()[0] for script in scripts}
        assert {*node.parameter_files} <= installed
    if "rviz2" in nodes:
        assert nodes["rviz2"].arguments == ["-d", str(RVIZ_FILE)]
    assert {LAUNCH_FILE, RVIZ_FILE, LAYOUT_FILE, *CONFIGS} <= installed


def test_parameters_are_the_nodes(nodes: dict[str, Started]) -> None:
    for node in of_package(nodes):
        assert bool(node.parameter_files) == (node.executable in PARAMETERS)
        types = {each.name: type(each.default) for each in PARAMETERS.get(node.executable, ())}
        types["use_sim_time"] = bool  # every node of rclpy has it
        assert {name: type(value) for name, value in node.parameters.items()}.items() <= (
            types.items()
        )


def test_a_parameter_file_can_be_the_users_own() -> None:
    (node,) = started(LAUNCH_FILE, {"params_file": "mine.yaml"})
    assert node.parameter_files == [Path("mine.yaml")]


def test_absolute_names_are_taken_into_the_namespace(nodes: dict[str, Started]) -> None:
    for node in nodes.values():
        absolute = [(old, new) for old, new in node.remappings if old.startswith("/")]
        assert all(new == old[1:] for old, new in absolute)
        recorded = {f"/{name}" for name in TOPIC_TYPES} if node.executable == "replay_node" else {}
        wanted = {} if node.executable == "subgoal_node" else TRANSFORMS | {*recorded}
        assert {old for old, _ in absolute} == {*wanted}


def test_the_subgoal_node_hears_what_the_discretiser_node_makes(nodes: dict[str, Started]) -> None:
    renamed = {old: new for old, new in nodes["subgoal_node"].remappings}
    heard = {renamed.pop(topic.name, topic.name): topic for topic in subgoal_node.INPUTS}
    assert not renamed  # there was a topic for each
    if "discretiser_node" not in nodes:
        assert {*heard} == {*TOPIC_TYPES}
        return
    made = {topic.name: topic for topic in discretiser_node.OUTPUTS}
    for name, topic in heard.items():
        assert (made[name].type_name, made[name].latched) == (topic.type_name, topic.latched)


@pytest.mark.parametrize("given", [given for given in ARGUMENTS if "bag" in given], ids=str)
def test_a_replay_gets_arguments_that_it_takes(given: dict[str, str]) -> None:
    (node,) = (each for each in started(LAUNCH_FILE, given) if each.executable == "replay_node")
    wanted = {
        "bags": (Path(BAG),),
        "rate": float(given.get("rate", 1.0)),
        "grid_map": Path(MAP_FILE) if "map" in given else None,
    }
    assert parse(node.arguments) == replace(parse([BAG]), **wanted)


def test_ros_own_launch_reads_the_same_arguments() -> None:
    pytest.importorskip("launch_ros", reason="it comes with a ROS installation only")
    description = runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]()
    theirs = {argument.name for argument in description.get_launch_arguments()}
    assert theirs == {argument.name for argument in declared(LAUNCH_FILE)}


def sections(path: Path) -> dict[str, dict[str, Any]]:
    """The parameters that a file has for each node."""
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    return {key: section["ros__parameters"] for key, section in document.items()}


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_configuration_is_what_its_nodes_take(path: Path, own_domain: None) -> None:
    for key, section in sections(path).items():
        name = key.removeprefix("/**/")  # in whatever namespace
        table = PARAMETERS[name]
        context = rclpy.Context()
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
        node = rclpy.create_node(name, namespace="robot", context=context)
        try:
            values = declare(node, table)
        finally:
            node.destroy_node()
            rclpy.shutdown(context=context)
        assert section == {parameter: values.get(parameter) for parameter in section}
        for settings in (Settings, Discretising):
            names = {each.name for each in fields(settings)} & {*section}
            settings(**{parameter: section[parameter] for parameter in names})


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_both_nodes_are_configured_alike(path: Path) -> None:
    given = sections(path)
    assert "/**/subgoal_node" in given
    if "/**/discretiser_node" in given:
        first, second = given["/**/discretiser_node"], given["/**/subgoal_node"]
        assert first["longest_silence"] == second["episode_gap"]
        assert first["moves"] == second["moves"]


def shown_in_rviz() -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Class and topic of each display."""
    document = yaml.safe_load(RVIZ_FILE.read_text(encoding="utf-8"))
    for display in document["Visualization Manager"]["Displays"]:
        yield display["Class"], display["Topic"]


RVIZ_TYPES = {
    "rviz_default_plugins/Map": OccupancyGrid.TYPE,
    "rviz_default_plugins/MarkerArray": MarkerArray.TYPE,
    "rviz_default_plugins/Path": PathMessage.TYPE,
    "rviz_default_plugins/Pose": PoseStamped.TYPE,
}


def test_rviz_shows_topics_as_they_are_published() -> None:
    for kind, topic in shown_in_rviz():
        published = TOPICS[topic["Value"]]  # relative, so that a namespace holds for it too
        assert RVIZ_TYPES[kind] == published.type_name
        assert topic["Durability Policy"] == (
            "Transient Local" if published.latched else "Volatile"
        )
        assert topic["Reliability Policy"] == "Reliable"


def foxglove_panels(kind: str) -> list[dict[str, Any]]:
    """What the layout says of the panels of a kind."""
    document = json.loads(LAYOUT_FILE.read_text(encoding="utf-8"))
    return [
        config for name, config in document["configById"].items() if name.startswith(f"{kind}!")
    ]


def type_shown(settings: Mapping[str, Any]) -> str:
    """Type of the messages that settings of a topic in Foxglove's 3D panel are for."""
    for setting, kind in (
        ("colorMode", OccupancyGrid.TYPE),
        ("gradient", PathMessage.TYPE),
        ("axisScale", PoseStamped.TYPE),
        ("arrowScale", PoseStamped.TYPE),
    ):
        if setting in settings:
            return kind
    return MarkerArray.TYPE


def test_foxglove_shows_topics_as_they_are_published() -> None:
    (scene,) = foxglove_panels("3D")
    for name, settings in scene["topics"].items():
        assert type_shown(settings) == TOPICS[name.removeprefix("/")].type_name
    (diagnostics,) = foxglove_panels("DiagnosticStatusPanel")
    assert diagnostics["topicToRender"] == DIAGNOSTICS.name
    message = diagnostic_array("a node", Health("its work", "at work", "well"), 0)
    assert {status.hardware_id for status in message.status} == {diagnostics["selectedHardwareId"]}


def test_whatever_can_be_shown_is_shown() -> None:
    visible = {topic.name for topic in TOPICS.values() if topic.type_name in RVIZ_TYPES.values()}
    assert {topic["Value"] for _, topic in shown_in_rviz()} == visible
    (scene,) = foxglove_panels("3D")
    assert {name.removeprefix("/") for name in scene["topics"]} == visible


def panels_laid_out(layout: Any) -> set[str]:
    """The panels in a tree of Foxglove's splits."""
    if isinstance(layout, str):
        return {layout}
    return panels_laid_out(layout["first"]) | panels_laid_out(layout["second"])


def test_foxglove_lays_out_the_panels_that_there_are() -> None:
    document = json.loads(LAYOUT_FILE.read_text(encoding="utf-8"))
    assert panels_laid_out(document["layout"]) == {*document["configById"]}
