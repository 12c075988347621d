"""The nodes as other nodes meet them: real processes over DDS, their topics, services and ends."""

from __future__ import annotations

import importlib
import json
import re
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import hypothesis
from hypothesis import strategies as st

from bag_support import messages, same
from bnirl_ros import cli
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.reader import Bag
from bnirl_ros.demonstrations.messages import stamp_of
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.demonstration_bag import first_episodes, write_demonstration
from bnirl_ros.experiments.scenarios import PAPER_LOOP
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap
from bnirl_ros.views.messages import MESSAGE_TYPES, Message
from demonstration_support import (
    BAD_COUNTS,
    BAGS,
    CORNERS,
    GRID,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    TopicMessage,
    bad_maps,
    bad_messages,
    map_of_grid,
    mcap_of,
    pose_at,
    walk,
    write_bag,
)
from ros_support import LATCHED, RELIABLE, NodeProcess, Peer, isolate

from bnirl_ros.nodes.conversion import message_class, to_ros  # isort: skip  # needs rclpy
from bnirl_ros.nodes.subgoal_node import OUTPUTS, PARAMETERS  # isort: skip

diagnostic_msgs = importlib.import_module("diagnostic_msgs.msg")
interfaces = importlib.import_module("rcl_interfaces.msg")
parameter_services = importlib.import_module("rcl_interfaces.srv")
rclpy_parameter = importlib.import_module("rclpy.parameter")
rclpy_qos = importlib.import_module("rclpy.qos")
services = importlib.import_module("std_srvs.srv")

pytestmark = pytest.mark.timeout(180)

PAPER_BAG = BAGS / PAPER_LOOP.name
HUMAN_BAG = BAGS / "overcooked_asymmetric_advantages"
QUICK = {"sweeps": 300, "burn_in": 100}
INPUTS = {
    "map": ("nav_msgs/msg/OccupancyGrid", LATCHED),
    "pose": ("geometry_msgs/msg/PoseStamped", RELIABLE),
    "action": ("geometry_msgs/msg/Vector3Stamped", RELIABLE),
}


@pytest.fixture(scope="module", autouse=True)
def _own_domain(tmp_path_factory: pytest.TempPathFactory) -> None:
    isolate(tmp_path_factory.mktemp("ros_log"))


@pytest.fixture
def peer(_own_domain: None) -> Iterator[Peer]:
    made = Peer()
    yield made
    made.close()


StartNode = Callable[..., NodeProcess]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[StartNode]:
    """Start a node by name, with arguments; it is killed at the end, if it has not ended."""
    started: list[NodeProcess] = []

    def start_node(name: str, *arguments: str | Path) -> NodeProcess:
        folder = tmp_path / f"process{len(started)}"
        folder.mkdir()
        started.append(NodeProcess(name, folder, *arguments))
        return started[-1]

    yield start_node
    for process in started:
        process.kill()


class Subgoals:
    """A subgoal node in a process, and all that it says."""

    def __init__(self, process: NodeProcess, peer: Peer) -> None:
        self.process, self.peer = process, peer
        self.outputs = {
            topic: peer.listen(message_class(kind), f"/{topic}") for topic, kind in OUTPUTS.items()
        }
        self._diagnostics = peer.listen(diagnostic_msgs.DiagnosticArray, "/diagnostics", 10)
        self._publishers = {
            name: peer.publisher(message_class(kind), f"/{name}", qos)
            for name, (kind, qos) in INPUTS.items()
        }
        peer.until(lambda: self._diagnostics, "diagnostics")

    def send(self, *groups: list[TopicMessage]) -> None:
        """Publish messages, in their order; they arrive all, but later."""
        for name, view, _ in chain(*groups):
            self._publishers[name].publish(to_ros(view))

    def call(self, service: str, request: Any = None) -> Any:
        kind = services.SetBool if service == "pause" else services.Trigger
        return self.peer.call(kind, f"/subgoal_node/{service}", request)

    def health(self) -> dict[str, str]:
        """The newest diagnostics."""
        (status,) = self._diagnostics[-1].status
        return {
            **{each.key: each.value for each in status.values},
            "level": int.from_bytes(status.level),
            "message": status.message,
        }

    def until_health(self, what: str, **wanted: str) -> dict[str, str]:
        """Wait for diagnostics that say so."""

        def is_so() -> bool:
            health = self.health()
            return all(health.get(key.replace("_", " ")) == value for key, value in wanted.items())

        self.peer.until(is_so, lambda: f"{what}, {wanted}; says {self.health()}")
        return self.health()

    def until_fault(self, words: str, count: int) -> None:
        """Wait until a fault with these words was counted so often."""
        self.peer.until(
            lambda: any(
                key.startswith("left out: ") and words in key and value == str(count)
                for key, value in self.health().items()
            ),
            lambda: f"{count} x {words}; says {self.health()}",
        )

    def until_settled(self, observations: int) -> dict[str, str]:
        """Wait until all is taken in and inference has come to its end."""
        return self.until_health(
            "rest", state="settled", queue="0", observations=str(observations)
        )

    def shown(self) -> dict[int, tuple[float, float]]:
        """Place of each subgoal shown, by its rank."""
        return {
            marker.id: (marker.pose.position.x, marker.pose.position.y)
            for marker in self.outputs["subgoals"][-1].markers
            if marker.ns == "subgoal"
        }

    def until_shown(self, places: set[tuple[float, float]]) -> None:
        """Wait until exactly these subgoals are shown."""
        outputs = self.outputs["subgoals"]
        self.peer.until(
            lambda: outputs and set(self.shown().values()) == places, f"subgoals at {places}"
        )

    def set(self, **values: Any) -> list[Any]:
        """Set parameters, one after the other; returns the results."""
        request = parameter_services.SetParameters.Request()
        request.parameters = [
            rclpy_parameter.Parameter(name, value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        kind = parameter_services.SetParameters
        return self.peer.call(kind, "/subgoal_node/set_parameters", request).results


@pytest.fixture
def subgoals(start: StartNode, peer: Peer) -> Callable[..., Subgoals]:
    """Start a subgoal node with parameters."""

    def start_it(**parameters: Any) -> Subgoals:
        return Subgoals(start("subgoal_node", *as_arguments(parameters)), peer)

    return start_it


def as_arguments(parameters: Mapping[str, Any]) -> list[str]:
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    return ["--ros-args", *words] if words else []


def centres(cells: Any, grid_map: GridMap = MAP) -> set[tuple[float, float]]:
    return {tuple(place) for place in grid_map.centres_of(list(cells)).tolist()}


CORNER_PLACES = centres(CORNERS)


def assert_silent_end(process: NodeProcess, number: signal.Signals) -> None:
    end = process.end(number)
    assert end.status == 0, end
    assert "Traceback" not in end.err
    assert "Error" not in end.err


# The same posterior, live and offline


def assert_same_results(folder: Path, other: Path) -> None:
    first, second = ((each / "subgoals.json").read_text() for each in (folder, other))
    assert json.loads(first) == json.loads(second)
    with np.load(folder / "posterior.npz") as one, np.load(other / "posterior.npz") as two:
        assert set(one) == set(two)
        for name in one:
            np.testing.assert_array_equal(one[name], two[name])
    assert (folder / "subgoals.png").is_file()


def replay_and_compare(
    bag: Path,
    parameters: Mapping[str, Any],
    tmp_path: Path,
    start: StartNode,
    subgoals: Callable[..., Subgoals],
) -> Subgoals:
    """Live and offline results of a bag are equal, and so is the mode once R-hat is low."""
    live, offline = tmp_path / "live", tmp_path / "offline"
    options = [f"--{name.replace('_', '-')}={value}" for name, value in parameters.items()]
    assert cli.main(["infer", str(bag), "--out", str(offline), *options]) == 0
    cells = {
        tuple(each["cell"])
        for each in json.loads((offline / "subgoals.json").read_text())["subgoals"]
    }
    recorded = read_demonstration(bag, {})
    count = len(place(recorded.recording, recorded.grid_map).demonstration)

    node = subgoals(result_folder=live, **parameters)
    end = start("replay_node", bag, "--fast").end()
    assert end.status == 0, end
    node.until_settled(count)
    assert float(node.health()["R-hat"]) < 1.05
    assert set(node.shown().values()) == centres(cells, recorded.grid_map)

    response = node.call("infer")
    assert response.success, response.message
    assert response.message.startswith(f"{len(cells)} subgoals from {count} observations")
    assert_same_results(live, offline)
    return node


@pytest.mark.parametrize("parameters", [{}, QUICK], ids=["defaults", "quick"])
def test_after_a_replay_the_paper_loop_gives_the_posterior_of_the_command(
    parameters: Mapping[str, Any],
    tmp_path: Path,
    start: StartNode,
    subgoals: Callable[..., Subgoals],
) -> None:
    replay_and_compare(PAPER_BAG, parameters, tmp_path, start, subgoals)


def test_after_a_replay_human_play_gives_the_posterior_of_the_command(
    tmp_path: Path, start: StartNode, subgoals: Callable[..., Subgoals]
) -> None:
    recorded = read_demonstration(HUMAN_BAG, {})
    whole = place(recorded.recording, recorded.grid_map).demonstration
    bag = tmp_path / "human"
    write_demonstration(bag, first_episodes(whole, 2), recorded.grid_map, step=0.15)
    replay_and_compare(bag, {"sweeps": 400, "burn_in": 100}, tmp_path, start, subgoals)


# What it publishes


def test_subgoals_are_spheres_headings_and_labels(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    first, *rest = node.outputs["subgoals"][-1].markers
    marker = message_class("visualization_msgs/msg/Marker")
    assert (first.action, first.ns, first.header.frame_id) == (marker.DELETEALL, "", "map")
    assert [(each.ns, each.id, each.type) for each in rest] == [
        (ns, rank, kind)
        for rank in range(1, 5)
        for ns, kind in (
            ("subgoal", marker.SPHERE),
            ("heading", marker.ARROW),
            ("label", marker.TEXT_VIEW_FACING),
        )
    ]
    assert all(each.action == marker.ADD for each in rest)
    assert all(each.header.frame_id == "map" for each in rest)
    for each in rest[2::3]:
        assert re.fullmatch(rf"wp_{each.id} [01]\.\d\d", each.text)

    # Before every complete set, what was shown goes.
    for array in node.outputs["subgoals"]:
        actions = [each.action for each in array.markers]
        assert actions == [marker.DELETEALL] + [marker.ADD] * (len(actions) - 1)
        assert len({(each.ns, each.id) for each in array.markers}) == len(actions)


def test_waypoints_belief_and_assignments_are_of_the_same_subgoals(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk(rounds=2))
    node.until_settled(2 * OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)

    path = node.outputs["waypoints"][-1]
    assert path.header.frame_id == "map"
    places = [(each.pose.position.x, each.pose.position.y) for each in path.poses]
    assert places == [tuple(each) for each in MAP.centres_of([*CORNERS[1:], CORNERS[0]]).tolist()]

    belief = node.outputs["subgoal_belief"][-1]
    percent = np.array(belief.data).reshape(belief.info.height, belief.info.width)
    assert percent.shape == MAP.free.shape
    assert 0 <= percent.min() <= percent.max() <= 100
    assert all(percent[y, x] > 90 for x, y in CORNERS)
    assert not percent[~MAP.free].any()

    # At most once a second, and the last one is not left out.
    arrays = node.outputs["assignments"]
    node.peer.until(lambda: arrays and len(arrays[-1].markers) == 5, "assignments")
    _, *lines = arrays[-1].markers
    spheres = node.outputs["subgoals"][-1].markers[1::3]
    assert [(each.ns, each.id, each.color) for each in lines] == [
        ("assignment", each.id, each.color) for each in spheres
    ]
    assert all(each.type == each.LINE_LIST for each in lines)
    # Two points for each distinct cell and action: the second round adds none.
    assert sum(len(each.points) for each in lines) == 2 * OBSERVATIONS_OF_WALK


def test_assignments_come_at_most_once_a_second(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals(sweeps=100_000_000, burn_in=0)
    node.send([map_of_grid()], walk())
    node.peer.until(lambda: len(node.outputs["assignments"]) >= 3, "three of them")
    stamps = [stamp_of(each.markers[0]) for each in node.outputs["assignments"]]
    assert all(later - sooner >= SECOND for sooner, later in pairwise(stamps))
    assert len(node.outputs["subgoals"]) > len(stamps)


def test_who_comes_late_gets_all_four_outputs(
    subgoals: Callable[..., Subgoals], peer: Peer
) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    arrays = node.outputs["assignments"]
    peer.until(lambda: arrays and len(arrays[-1].markers) == 5, "assignments")
    late = Peer()
    try:
        received = {
            topic: late.listen(message_class(kind), f"/{topic}") for topic, kind in OUTPUTS.items()
        }
        late.until(lambda: all(received.values()), "the last message on each topic")
        for topic, messages in received.items():
            assert messages == node.outputs[topic][-1:]
    finally:
        late.close()


# What it is sent


def test_what_cannot_be_used_is_counted_and_the_rest_is_used(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(**QUICK)
    bad = list(bad_messages(START + 9000 * SECOND).values())
    maps = bad_maps()

    def send_bad_maps(times: int) -> None:
        for words, grid in maps.items():  # one by one: of those that wait, the last one is kept
            node.send([("map", grid, START)])
            node.until_fault(words, times)

    send_bad_maps(times=1)
    node.send(*bad[::2], [map_of_grid()], walk(), *bad[1::2])
    node.until_settled(OBSERVATIONS_OF_WALK)
    send_bad_maps(times=2)
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    health = node.until_health("all faults", drops=str(sum(BAD_COUNTS.values()) + 2 * len(maps)))
    for fault, count in BAD_COUNTS.items():
        assert health[f"left out: {fault}"] == str(count)
    assert health["level"] == 1
    assert health["last error"] == ""
    assert node.call("infer").success
    assert "left out 1 x pose with a coordinate that is not finite" in node.process.err


def test_a_second_map_with_another_origin_and_size_midway(
    subgoals: Callable[..., Subgoals], tmp_path: Path
) -> None:
    node = subgoals(**QUICK, result_folder=tmp_path)
    first, second = walk(), walk(start=START + 1000 * SECOND)
    node.send([map_of_grid()], first, second[:21])
    node.until_settled(OBSERVATIONS_OF_WALK + 10)
    free = np.pad(MAP.free, ((1, 3), (2, 0)), constant_values=True)
    larger = GridMap(free, origin=(-2.0, -1.0, 0.0))
    node.send([map_of_grid(larger)], second[21:])
    node.until_settled(2 * OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)  # the same places
    belief = node.outputs["subgoal_belief"][-1]
    assert (belief.info.width, belief.info.height) == (9, 11)
    assert (belief.info.origin.position.x, belief.info.origin.position.y) == (-2.0, -1.0)
    assert node.call("infer").success
    document = json.loads((tmp_path / "subgoals.json").read_text())
    assert {tuple(each["cell"]) for each in document["subgoals"]} == {
        (x + 2, y + 1) for x, y in CORNERS
    }

    # And one on which half of it does not lie any more: the rest stays, the others are counted.
    node.send([map_of_grid(GridMap(MAP.free[:, :4]))])
    health = node.until_health("half the walk", queue="0", state="settled", observations="26")
    assert health["left out: pose outside the map"] == "22"


def test_poses_before_the_first_map_are_used_afterwards(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(**QUICK, waiting_limit=OBSERVATIONS_OF_WALK + 1)
    node.send(walk(), [pose_at(0.5, 0.5, START + 1000 * SECOND)])
    node.until_fault("pose before the first map, when the buffer was full", 1)
    assert node.health()["queue"] == str(2 * OBSERVATIONS_OF_WALK + 1)
    assert not node.outputs["subgoals"]
    node.send([map_of_grid()])
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)


# Services


def test_infer_tells_why_it_cannot(subgoals: Callable[..., Subgoals], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    node = subgoals(**QUICK, result_folder=tmp_path / "file")
    response = node.call("infer")
    assert not response.success
    assert "there is no map yet" in response.message
    node.send([map_of_grid()])
    node.peer.until(lambda: node.outputs["subgoals"], "an empty set, for a map and nothing else")
    response = node.call("infer")
    assert not response.success
    assert "there is no observation" in response.message
    node.send(walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    response = node.call("infer")
    assert not response.success
    assert "cannot be written there" in response.message
    assert node.process.running


def test_reset_empties_what_is_shown(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk(), *bad_messages(START + 9000 * SECOND).values())
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert node.call("reset").success
    node.peer.until(lambda: len(node.outputs["subgoals"][-1].markers) == 1, "DELETEALL only")
    node.until_health("nothing", observations="0", drops="0", subgoals="0", queue="0")
    node.peer.until(lambda: len(node.outputs["assignments"][-1].markers) == 1, "DELETEALL only")
    assert not node.outputs["waypoints"][-1].poses
    assert not any(node.outputs["subgoal_belief"][-1].data)
    node.send(walk(start=START + 5000 * SECOND))  # the map is not forgotten
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)


def test_pause_holds_and_releases(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals(**QUICK)
    assert node.call("pause", services.SetBool.Request(data=True)).success
    node.send([map_of_grid()], walk())
    node.until_health("waiting", state="paused", queue=str(2 * OBSERVATIONS_OF_WALK + 1))
    node.peer.rest(0.5)
    assert not node.outputs["subgoals"]
    assert node.call("infer").success  # is asked for, and therefore done
    node.peer.until(lambda: node.outputs["subgoals"], "its result")
    count = len(node.outputs["subgoals"])
    node.send(walk(start=START + 1000 * SECOND))
    node.until_health("waiting", state="paused", queue=str(2 * OBSERVATIONS_OF_WALK + 1))
    assert len(node.outputs["subgoals"]) == count
    assert node.call("pause", services.SetBool.Request(data=False)).success
    node.until_settled(2 * OBSERVATIONS_OF_WALK)


def test_callbacks_are_served_while_inference_runs(
    subgoals: Callable[..., Subgoals], peer: Peer, tmp_path: Path
) -> None:
    # Two inferences of a second or more, asked for at once.
    node = subgoals(sweeps=30_000, burn_in=0, thin=100, result_folder=tmp_path)
    assert node.call("pause", services.SetBool.Request(data=True)).success
    node.send([map_of_grid()], walk(rounds=20))
    node.until_health("all", queue=str(20 * (2 * OBSERVATIONS_OF_WALK + 1)))
    answers = [peer.ask(services.Trigger, "/subgoal_node/infer") for _ in range(2)]
    request = parameter_services.GetParameters.Request(names=["alpha"])
    kind = parameter_services.GetParameters
    slowest = 0.0
    served = 0
    while not all(answer.done() for answer in answers):
        begin = time.monotonic()
        assert (
            peer.call(kind, "/subgoal_node/get_parameters", request).values[0].double_value == 50
        )
        slowest = max(slowest, time.monotonic() - begin)
        served += 1
    assert all(answer.result().success for answer in answers)
    assert served > 5
    # Far from the time of an inference, and far from what a busy machine does to a callback.
    print(f"served {served}, the slowest in {slowest:.3f} s")
