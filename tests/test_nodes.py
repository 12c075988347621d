"""The nodes as other nodes meet them: real processes over DDS, their topics, services and ends."""

from __future__ import annotations

import importlib
import json
import math
import re
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from bag_support import messages, same
from bnirl_ros import cli
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.messages import TOPIC_TYPES, stamp_of
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.demonstration_bag import first_episodes, write_demonstration
from bnirl_ros.experiments.scenarios import PAPER_LOOP
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap
from bnirl_ros.views.messages import MESSAGE_TYPES
from bnirl_ros.views.stamped import pose_of
from bnirl_ros.views.waypoint_files import waypoints_yaml
from bnirl_ros.views.waypoints import Waypoints, path_of
from demonstration_support import (
    BAD_COUNTS,
    BAGS,
    CORNERS,
    GRID,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    bad_maps,
    bad_messages,
    bag_with_odd_topic,
    map_of_grid,
    pose_at,
    truncated,
    walk,
    write_bag,
)
from ros_support import (
    LATCHED,
    RELIABLE,
    NodeProcess,
    Peer,
    Subgoals,
    as_arguments,
    assert_same_results,
    assert_silent_end,
    parameter_services,
    services,
)

from bnirl_ros.nodes.conversion import message_class, to_ros  # isort: skip  # needs rclpy
from bnirl_ros.nodes.managed import with_common  # isort: skip
from bnirl_ros.nodes.parameters import INFERRED, parameter_of  # isort: skip
from bnirl_ros.nodes.subgoal_node import INPUTS, OUTPUTS, PARAMETERS  # isort: skip

diagnostic_msgs = importlib.import_module("diagnostic_msgs.msg")
interfaces = importlib.import_module("rcl_interfaces.msg")
rclpy_parameter = importlib.import_module("rclpy.parameter")
rclpy_qos = importlib.import_module("rclpy.qos")

pytestmark = pytest.mark.timeout(180)

PAPER_BAG = BAGS / PAPER_LOOP.name
HUMAN_BAG = BAGS / "overcooked_asymmetric_advantages"
StartNode = Callable[..., NodeProcess]
QUICK = {"sweeps": 300, "burn_in": 100}


def centres(cells: Any, grid_map: GridMap = MAP) -> set[tuple[float, float]]:
    return {tuple(place) for place in grid_map.centres_of(list(cells)).tolist()}


CORNER_PLACES = centres(CORNERS)


# The same posterior, live and offline


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
    # Which draws these are depends on when messages came, so the bound is the wide one of Gelman
    # and Rubin; with some hundred effective draws R-hat is 1.02 to 1.06, and far above 1.1 where
    # chains have not found each other.
    assert float(node.health()["R-hat"]) < 1.1
    assert set(node.shown().values()) == centres(cells, recorded.grid_map)

    response = node.call("infer")
    assert response.success, response.message
    assert response.message.startswith(f"{len(cells)} subgoals from {count} observations")
    assert_same_results(live, offline)
    return node


def test_after_a_replay_the_paper_loop_gives_the_posterior_of_the_command(
    tmp_path: Path, start: StartNode, subgoals: Callable[..., Subgoals]
) -> None:
    replay_and_compare(PAPER_BAG, {}, tmp_path, start, subgoals)


def test_after_a_replay_human_play_gives_the_posterior_of_the_command(
    tmp_path: Path, start: StartNode, subgoals: Callable[..., Subgoals]
) -> None:
    recorded = read_demonstration(HUMAN_BAG, {})
    whole = place(recorded.recording, recorded.grid_map).demonstration
    bag = tmp_path / "human"
    write_demonstration(bag, first_episodes(whole, 2), recorded.grid_map, step=0.15)
    replay_and_compare(bag, {"sweeps": 1000, "burn_in": 400}, tmp_path, start, subgoals)


def test_feature_subgoals_live_are_those_of_the_command_and_show_all_their_cells(
    tmp_path: Path, start: StartNode, subgoals: Callable[..., Subgoals]
) -> None:
    live, offline, rooms = tmp_path / "live", tmp_path / "offline", tmp_path / "rooms.txt"
    blocks = np.arange(20) // 5
    np.savetxt(rooms, 10 * blocks[::-1, np.newaxis] + blocks, fmt="%d")
    settings = {"sweeps": 300, "burn_in": 100, "features": rooms}
    options = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    assert cli.main(["infer", str(PAPER_BAG), "--out", str(offline), *options]) == 0

    node = subgoals(result_folder=live, **settings)
    assert start("replay_node", PAPER_BAG, "--fast").end().status == 0
    recorded = read_demonstration(PAPER_BAG, {})
    node.until_settled(len(place(recorded.recording, recorded.grid_map).demonstration))
    response = node.call("infer")
    assert response.success, response.message
    assert_same_results(live, offline)

    entries = {
        entry["rank"]: entry
        for entry in json.loads((live / "subgoals.json").read_text())["subgoals"]
    }

    def sets() -> list[Any]:
        return [each for each in node.outputs["subgoals"][-1].markers if each.ns == "cells"]

    node.peer.until(lambda: [each.id for each in sets()] == [*entries], "the subgoals inferred")
    for each in sets():
        assert each.type == each.CUBE_LIST
        shown = {(math.floor(point.x), math.floor(point.y)) for point in each.points}
        assert shown == {(x, y) for x, y in entries[each.id]["cells"]}


def test_features_that_do_not_fit_the_map_are_told(
    tmp_path: Path, start: StartNode, subgoals: Callable[..., Subgoals]
) -> None:
    end = start("subgoal_node", *as_arguments({"features": tmp_path / "none.txt"})).end()
    assert end.status == 1
    assert "none.txt: the features cannot be read" in end.err
    assert "Traceback" not in end.err
    (tmp_path / "small.txt").write_text("1 2\n")
    node = subgoals(features=tmp_path / "small.txt")
    node.send([map_of_grid()], walk())
    node.peer.until(lambda: "has 2 x 1 labels, the map" in node.process.err, "a warning")


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
    node.peer.until(lambda: node.outputs["assignments"], "a first result")  # kernels are there
    for seed in range(40):  # each change brings a result at once
        node.set(seed=seed)
        node.peer.rest(0.1)
        if len(node.outputs["assignments"]) >= 3:
            break
    stamps = [stamp_of(each.markers[0]) for each in node.outputs["assignments"]]
    assert len(stamps) >= 3
    assert all(later - sooner >= SECOND for sooner, later in pairwise(stamps))
    assert len(node.outputs["subgoals"]) > len(stamps)


def test_the_next_corner_is_named_on_the_way_there(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk(rounds=3))
    node.until_settled(3 * OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    current, arrays = node.outputs["current_subgoal"], node.outputs["intent"]
    node.peer.until(lambda: current and arrays, "what was pursued last")
    marker = message_class("visualization_msgs/msg/Marker")

    def is_told(place: tuple[float, float], stamp: int) -> bool:
        position = current[-1].pose.position
        told = [stamp_of(current[-1]), stamp_of(arrays[-1].markers[0])]
        return (position.x, position.y) == place and told == [stamp, stamp]

    fourth = walk(start=START + 1000 * SECOND)
    to_corner = 12  # poses and actions on the way to each
    for side, corner in enumerate(CORNERS[1:3]):
        under_way = side * to_corner + 8  # two steps before it
        node.send(fourth[side * to_corner : under_way])
        (place,), stamp = centres([corner]), fourth[under_way - 1][2]
        node.peer.until(partial(is_told, place, stamp), f"{corner}")
        first, *rest = arrays[-1].markers
        assert (first.action, first.header.frame_id) == (marker.DELETEALL, "map")
        assert len({(each.ns, each.id) for each in rest}) == len(rest)
        arrows = {each.id: each for each in rest if each.ns == "intent"}
        likeliest = max(arrows.values(), key=lambda each: each.color.a)
        assert likeliest.type == marker.ARROW
        assert likeliest.color.a > 0.5
        here = fourth[under_way - 2][1].pose.position
        assert [(each.x, each.y) for each in likeliest.points] == [(here.x, here.y), place]
        node.send(fourth[under_way : (side + 1) * to_corner])

    # What is forgotten is not shown any more.
    assert node.call("reset").success
    node.peer.until(lambda: len(arrays[-1].markers) == 1, "DELETEALL only")


def test_the_papers_model_tells_no_intent(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals(**QUICK, model="paper")
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    assert not node.outputs["current_subgoal"]
    assert not node.outputs["intent"]
    # It goes on until the chains have converged, if that is asked for.
    assert all(each.successful for each in node.set(max_sweeps=1_000_000))
    node.peer.until(lambda: node.health()["converged"] == "yes", "chains that have converged")
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert int(node.health()["sweeps"]) < 1_000_000
    # Another model, and back: what it told is taken away.
    assert all(each.successful for each in node.set(model="sequential"))
    node.peer.until(lambda: node.outputs["intent"], "an intent")
    assert len(node.outputs["intent"][-1].markers) > 1
    assert all(each.successful for each in node.set(model="paper"))
    node.peer.until(lambda: len(node.outputs["intent"][-1].markers) == 1, "DELETEALL only")


def test_who_comes_late_gets_all_outputs(subgoals: Callable[..., Subgoals], peer: Peer) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    peer.rest(1.5)  # the last assignments may come a second after the last subgoals
    assert len(node.outputs["assignments"][-1].markers) == 5
    late = {
        topic.name: peer.listen(message_class(topic.type_name), f"/{topic.name}")
        for topic in OUTPUTS
    }
    peer.until(lambda: all(late.values()), "the last message on each topic")
    for topic, received in late.items():
        assert received == node.outputs[topic][-1:]


def test_saved_waypoints_are_served_until_there_is_a_posterior(
    subgoals: Callable[..., Subgoals], tmp_path: Path
) -> None:
    saved = Waypoints("map", (pose_of((1.5, -2.0), 0.5), pose_of((3.5, 4.25), -2.5)))
    (tmp_path / "waypoints.yaml").write_text(waypoints_yaml(saved))
    node = subgoals(**QUICK, waypoints_file=tmp_path / "waypoints.yaml")
    paths = node.outputs["waypoints"]

    def served() -> bool:
        return bool(paths) and paths[-1] == to_ros(path_of(saved, stamp_of(paths[-1])))

    node.peer.until(served, "the saved waypoints, with nothing else known")
    node.send([map_of_grid()])
    node.peer.until(lambda: node.outputs["subgoals"], "an empty set, for a map and nothing else")
    node.peer.rest(0.3)
    assert served()
    node.send(walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    places = {(each.pose.position.x, each.pose.position.y) for each in paths[-1].poses}
    assert places == CORNER_PLACES
    assert node.call("reset").success
    node.peer.until(served, "the saved waypoints again")


# What it is sent


def test_what_cannot_be_used_is_counted_and_the_rest_is_used(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(**QUICK)
    bad = list(bad_messages(START + 9000 * SECOND).values())
    maps = bad_maps()

    for words, grid in maps.items():  # one by one: of those that wait, the last one is kept
        node.send([("map", grid, START)])
        node.peer.until(lambda words=words: words in node.process.err, words)
    node.send(*bad[::2], [map_of_grid()], walk(), *bad[1::2])
    node.until_settled(OBSERVATIONS_OF_WALK)
    words, grid = next(iter(maps.items()))
    node.send([("map", grid, START)])
    node.until_fault(words, 2)
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    health = node.until_health("all faults", drops=str(sum(BAD_COUNTS.values()) + len(maps) + 1))
    for fault, count in BAD_COUNTS.items():
        assert health[f"left out: {fault}"] == str(count)
    assert health["level"] == 1
    assert health["last error"] == ""
    assert node.call("infer").success
    assert re.search(r"left out \d+ x pose with a coordinate that is not finite", node.process.err)


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
    node = subgoals(sweeps=800, burn_in=0, thin=10, result_folder=tmp_path)
    assert node.call("pause", services.SetBool.Request(data=True)).success
    node.send([map_of_grid()], walk(rounds=20))
    node.until_health("all", queue=str(20 * (2 * OBSERVATIONS_OF_WALK + 1)))
    answers = [peer.ask(services.Trigger, "/subgoal_node/infer") for _ in range(2)]
    request = parameter_services.GetParameters.Request(names=["alpha"])
    kind = parameter_services.GetParameters
    served = 0
    while not all(answer.done() for answer in answers):
        (value,) = peer.call(kind, "/subgoal_node/get_parameters", request).values
        assert value.double_value == INFERRED
        served += 1
    assert all(answer.result().success for answer in answers)
    assert served > 5


def test_a_flood_of_messages_is_taken_in_whole_while_inference_runs(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(sweeps=100_000_000, burn_in=0)
    node.send([map_of_grid()], walk())
    node.until_health("a running result", state="inferring", queue="0")
    rounds = 125  # 6,125 messages
    node.send(walk(rounds, start=START + 1000 * SECOND))
    count = (1 + rounds) * OBSERVATIONS_OF_WALK
    node.until_health("all", state="inferring", queue="0", observations=str(count), drops="0")


# Parameters


def test_parameters_are_described(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals()
    table = with_common([*map(parameter_of, fields(Settings)), *PARAMETERS])
    expected = {entry.name: entry.limits for entry in table}
    defaults = {entry.name: entry.default for entry in table}
    names = list(expected)

    kind = parameter_services.DescribeParameters
    request = kind.Request(names=names)
    told = node.peer.call(kind, "/subgoal_node/describe_parameters", request).descriptors
    kind = parameter_services.GetParameters
    request = kind.Request(names=names)
    values = node.peer.call(kind, "/subgoal_node/get_parameters", request).values
    types = {bool: 1, int: 2, float: 3, str: 4}
    for name, each, value in zip(names, told, values, strict=True):
        limits = expected[name]
        assert each.name == name
        assert each.description == limits.description
        assert each.type == value.type == types[type(defaults[name])]
        assert rclpy_parameter.parameter_value_to_python(value) == defaults[name]
        if limits.choices:
            assert all(str(choice) in each.additional_constraints for choice in limits.choices)
        elif each.type in (2, 3):
            (bounds,) = each.integer_range or each.floating_point_range
            assert bounds.from_value == max(limits.lowest, limits.above)
            assert bounds.to_value == min(limits.highest, limits.below, bounds.to_value)
            assert each.additional_constraints == limits.range_in_words()
        assert each.read_only == (name in ("autostart", "file_folder"))


def test_parameters_can_be_set_and_bad_values_are_refused_with_a_reason(
    subgoals: Callable[..., Subgoals], tmp_path: Path
) -> None:
    node = subgoals(**QUICK, result_folder=tmp_path)
    node.send([map_of_grid()], walk())
    refused: dict[str, tuple[Any, str]] = {
        "alpha": (-2.0, "alpha"),
        "slip": (-0.5, "slip must be at least 0 and below 1, not -0.5"),
        "eta": (0.0, "eta must be above 0, not 0"),
        "moves": (5, "moves must be one of 4, 8, not 5"),
        "sweeps": (100, "sweeps must leave a draw: 100 sweeps less 100 of burn-in"),
        "model": ("none", "model must be one of sequential, paper"),
        "discount": (math.nan, "discount"),
        "seed": ("text", "expected 'Type.INTEGER' got 'Type.STRING'"),
        "autostart": (False, "read-only"),
        "queue_depth": (1, "is taken when the node is configured; deactivate it and clean it up"),
        "waiting_limit": (1, "waiting_limit is taken when"),
        "episode_gap": (1.0, "episode_gap is taken when"),
        "waypoints_file": ("elsewhere", "waypoints_file is taken when"),
        "result_folder": ("elsewhere", "result_folder is taken when"),
    }
    results = node.set(**{name: value for name, (value, _) in refused.items()})
    for result, (name, (_, reason)) in zip(results, refused.items(), strict=True):
        assert not result.successful, name
        assert reason in result.reason
    assert node.call("infer").success
    document = json.loads((tmp_path / "subgoals.json").read_text())
    assert document["parameters"]["alpha"]["inferred"]  # nothing has changed

    accepted = node.set(alpha=20.0, chains=2, burn_in=50)
    assert all(result.successful for result in accepted), accepted
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert node.call("infer").success
    document = json.loads((tmp_path / "subgoals.json").read_text())
    assert document["model"]["alpha"] == 20.0
    assert document["diagnostics"]["chains"] == 2
    assert document["diagnostics"]["draws"] == QUICK["sweeps"] - 50


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"alpha": -2.0}, "parameter alpha: must be at least -1"),
        ({"alpha": 0.0}, "alpha must be above 0, not 0.0"),
        ({"alpha": "text"}, "parameter alpha: must be of type float, such as -1.0"),
        ({"moves": 5}, "parameter moves must be one of 4, 8, not 5"),
        ({"sweeps": 10, "burn_in": 10}, "sweeps must leave a draw: 10 sweeps less 10 of burn-in"),
        ({"queue_depth": 0}, "parameter queue_depth: must be at least 1 and at most 1e+07"),
    ],
)
def test_bad_parameters_at_the_start_are_one_sentence(
    start: StartNode, parameters: Mapping[str, Any], sentence: str
) -> None:
    end = start("subgoal_node", *as_arguments(parameters)).end()
    assert end.status == 1
    assert end.err.startswith(f"subgoal_node: {sentence}")
    assert end.err.count("\n") == 1


def test_bad_waypoints_at_the_start_are_one_sentence(start: StartNode, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text("image: map.pgm\n")
    for name, words in (
        ("none.yaml", "the file cannot be read (No such file or directory); check the path"),
        ("map.yaml", "has no waypoints under the key 'waypoints'; save it with"),
    ):
        path = tmp_path / name
        end = start("subgoal_node", *as_arguments({"waypoints_file": path})).end()
        assert end.status == 1
        assert end.err.startswith(f"subgoal_node: {path}: {words}")
        assert end.err.count("\n") == 1


# Replaying


class Audience:
    """Whoever listens to a replay, and when it heard what."""

    def __init__(self, peer: Peer) -> None:
        self.heard: dict[str, list[tuple[float, Any]]] = {topic.name: [] for topic in INPUTS}
        for topic in INPUTS:
            peer.node.create_subscription(
                message_class(topic.type_name),
                f"/{topic.name}",
                partial(self._hear, topic.name),
                LATCHED if topic.latched else RELIABLE,
            )

    def _hear(self, name: str, message: Any) -> None:
        self.heard[name].append((time.monotonic(), message))

    def counts(self) -> dict[str, int]:
        return {name: len(heard) for name, heard in self.heard.items()}

    def stamps(self, name: str) -> list[int]:
        return [stamp_of(message) for _, message in self.heard[name]]


def test_a_replay_waits_loses_nothing_and_says_what_it_sent(
    start: StartNode, peer: Peer, tmp_path: Path
) -> None:
    rounds = 40
    sent = [map_of_grid(), *walk(rounds)]
    process = start("replay_node", write_bag(tmp_path / "bag", sent), "--fast")
    words = "waits for a subscriber of /action, /map, /pose"
    peer.until(lambda: words in process.err, words)
    infos = {
        name: peer.until(
            lambda name=name: peer.node.get_publishers_info_by_topic(f"/{name}"), f"/{name}"
        )
        for name in TOPIC_TYPES
    }
    assert process.running

    audience = Audience(peer)
    expected = {name: sum(each == name for each, _, _ in sent) for name in TOPIC_TYPES}
    peer.until(lambda: audience.counts() == expected, lambda: str(audience.counts()))
    for name in TOPIC_TYPES:
        assert audience.stamps(name) == [stamp for each, _, stamp in sent if each == name]
    end = process.end()
    assert end.status == 0
    counts = ", ".join(f"/{name} {count}" for name, count in sorted(expected.items()))
    assert end.out.splitlines()[-1] == f"sent {len(sent)} messages: {counts}"

    # As recorded: the map latched, the rest reliable.
    for name, (info,) in infos.items():
        qos = info.qos_profile
        assert qos.reliability == rclpy_qos.ReliabilityPolicy.RELIABLE
        assert (qos.durability == rclpy_qos.DurabilityPolicy.TRANSIENT_LOCAL) == (name == "map")


@pytest.mark.parametrize(("options", "factor"), [([], 1.0), (["--rate", "4"], 4.0)])
def test_a_replay_keeps_pace(
    start: StartNode, peer: Peer, tmp_path: Path, options: list[str], factor: float
) -> None:
    seconds = 2.0 * factor
    sent = [each for each in [map_of_grid(), *walk()] if each[2] <= START + seconds * SECOND]
    audience = Audience(peer)
    begin = time.monotonic()
    start("replay_node", write_bag(tmp_path / "bag", sent), *options)
    peer.until(
        lambda: sum(audience.counts().values()) == len(sent), lambda: str(audience.counts())
    )
    poses = audience.heard["pose"]
    assert poses[-1][0] - begin >= 2.0  # whatever the machine is doing
    assert audience.stamps("pose") == [stamp for name, _, stamp in sent if name == "pose"]
    if factor > 1:
        assert poses[-1][0] - poses[0][0] < seconds


def test_a_map_file_takes_the_place_of_a_map_that_is_missing(
    start: StartNode, peer: Peer, tmp_path: Path
) -> None:
    (tmp_path / "map.txt").write_text(GRID)
    without = write_bag(tmp_path / "without", walk(), topics=("pose", "action"))
    audience = Audience(peer)
    end = start("replay_node", without, "--fast", "--map", tmp_path / "map.txt").end()
    assert end.status == 0
    assert end.out == "sent 50 messages: /action 24, /map 1, /pose 25\n"
    peer.until(lambda: audience.heard["map"], "the map")
    ((_, grid),) = audience.heard["map"]
    assert np.array_equal(np.array(grid.data) == 0, MAP.free.reshape(-1))

    whole = write_bag(tmp_path / "whole", [map_of_grid(), *walk()])
    end = start("replay_node", whole, "--fast", "--map", tmp_path / "map.txt").end()
    assert end.status == 1
    assert end.err.count("\n") == 1
    assert "map.txt: the bag has a topic /map already; leave out --map" in end.err
    end = start("replay_node", without, "--map", tmp_path / "none.txt").end()
    assert end.status == 1
    assert "none.txt: the map cannot be read" in end.err


def test_what_cannot_be_played_is_said(start: StartNode, peer: Peer, tmp_path: Path) -> None:
    end = start("replay_node", tmp_path / "none", "--fast").end()
    assert (end.status, end.out) == (1, "")
    assert end.err.startswith(f"replay_node: {tmp_path / 'none'}: does not exist")
    assert end.err.count("\n") == 1
    assert start("replay_node").end().status == 2
    assert start("replay_node", PAPER_BAG, "--rate", "0").end().status == 2

    audience = Audience(peer)
    odd = bag_with_odd_topic(tmp_path / "bag")
    end = start("replay_node", odd, "--fast").end()
    assert end.status == 0
    assert "/odd is not sent: type odd_msgs/msg/Odd isn't installed" in end.err
    assert end.out == (
        "sent 50 messages: /action 24, /map 1, /pose 25, "
        "/odd not sent (type odd_msgs/msg/Odd isn't installed)\n"
    )
    expected = {"map": 1, "pose": 25, "action": 24}
    peer.until(lambda: audience.counts() == expected, lambda: str(audience.counts()))


def test_a_truncated_bag_is_played_as_far_as_it_goes(
    start: StartNode, peer: Peer, tmp_path: Path
) -> None:
    path = truncated(PAPER_BAG, tmp_path / "cut.mcap", share=0.7)
    audience = Audience(peer)
    end = start("replay_node", path, "--fast").end()
    assert end.status == 1
    assert end.out == "sent 604 messages: /action 299, /map 1, /pose 304\n"
    (line,) = (line for line in end.err.splitlines() if not line.startswith("["))
    assert line.startswith(f"replay_node: {path}: is damaged at byte ")
    assert "Traceback" not in end.err
    peer.until(lambda: sum(audience.counts().values()) == 604, lambda: str(audience.counts()))


# The end


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def number(request: pytest.FixtureRequest) -> signal.Signals:
    return request.param


@pytest.mark.parametrize("name", ["subgoal_node", "replay_node"])
def test_a_signal_at_the_start_ends_a_node(
    start: StartNode, number: signal.Signals, name: str
) -> None:
    # Python itself has to be there; what our code imports, and rclpy's start, take 0.7 s or more.
    arguments = [PAPER_BAG] if name == "replay_node" else []
    for after in (0.3, 0.6, 0.9):
        process = start(name, *arguments)
        time.sleep(after)
        assert_silent_end(process, number)


def test_a_signal_ends_the_subgoal_node_while_it_waits(
    subgoals: Callable[..., Subgoals], number: signal.Signals
) -> None:
    node = subgoals()
    node.until_health("a map", state="waiting")
    assert_silent_end(node.process, number)


def test_a_signal_ends_the_subgoal_node_while_it_infers(
    subgoals: Callable[..., Subgoals], number: signal.Signals
) -> None:
    node = subgoals(sweeps=5_000_000, burn_in=0, thin=200)
    node.send([map_of_grid()], walk(rounds=2))
    node.until_health("a running result", state="inferring", queue="0")
    node.peer.ask(services.Trigger, "/subgoal_node/infer")
    node.peer.rest(0.5)
    assert_silent_end(node.process, number)


def test_a_second_signal_changes_nothing(subgoals: Callable[..., Subgoals]) -> None:
    node = subgoals()
    node.process.send(signal.SIGINT)  # the terminal's, and that of `ros2 launch`
    node.process.send(signal.SIGINT)
    assert_silent_end(node.process, signal.SIGTERM)


def test_a_signal_ends_the_replay_while_it_waits(
    start: StartNode, peer: Peer, number: signal.Signals
) -> None:
    process = start("replay_node", PAPER_BAG)
    peer.until(lambda: "waits for a subscriber" in process.err, "a replay that waits")
    assert_silent_end(process, number)


def test_a_signal_ends_the_replay_while_it_plays(
    start: StartNode, peer: Peer, number: signal.Signals
) -> None:
    audience = Audience(peer)
    process = start("replay_node", PAPER_BAG)
    peer.until(lambda: len(audience.heard["pose"]) > 2, "a replay that plays")
    end = process.end(number)
    assert end.status == 0
    assert "Traceback" not in end.err
    assert re.fullmatch(r"sent \d+ messages: /action \d+, /map 1, /pose \d+\n", end.out)


# Messages


@pytest.mark.parametrize("name", sorted(MESSAGE_TYPES))
@hypothesis.given(data=st.data())
@hypothesis.settings(max_examples=20, deadline=None)
def test_a_view_becomes_the_ros_message_with_the_same_fields(
    name: str, data: st.DataObject
) -> None:
    pytest.importorskip(f"{name.partition('/')[0]}.msg")  # tf2_msgs is none of the wheels
    view = data.draw(messages(name))
    message = to_ros(view)
    assert type(message) is message_class(name)
    assert same(view, message)
