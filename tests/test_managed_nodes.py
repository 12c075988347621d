"""The nodes as ROS 2 people expect them: life cycle, simulated time, names, QoS."""

from __future__ import annotations

import importlib
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from demonstration_support import (
    CORNERS,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    map_of_grid,
    walk,
)

pytest.importorskip("rclpy", reason="rclpy is not installed")

from bnirl_ros.nodes.conversion import message_class, to_ros
from bnirl_ros.nodes.managed import ManagedNode
from bnirl_ros.views.diagnostics import Health
from bnirl_ros.views.stamped import time_of
from ros_support import (
    LATCHED,
    PATIENCE,
    RELIABLE,
    NodeProcess,
    Peer,
    Subgoals,
    as_arguments,
    assert_silent_end,
    services,
)

lifecycle = importlib.import_module("lifecycle_msgs.srv")
rclpy_qos = importlib.import_module("rclpy.qos")
rosgraph_msgs = importlib.import_module("rosgraph_msgs.msg")

pytestmark = pytest.mark.timeout(180)

StartNode = Callable[..., NodeProcess]
QUICK = {"sweeps": 300, "burn_in": 100}
CORNER_PLACES = {tuple(place) for place in MAP.centres_of(list(CORNERS)).tolist()}


def change(node: Subgoals, transition: str) -> bool:
    """Ask for a transition; returns whether it was made."""
    request = lifecycle.ChangeState.Request()
    request.transition.label = transition
    kind = lifecycle.ChangeState
    return bool(node.peer.call(kind, f"/{node.name}/change_state", request).success)


def state(node: Subgoals) -> str:
    kind = lifecycle.GetState
    return str(node.peer.call(kind, f"/{node.name}/get_state").current_state.label)


def test_a_manager_takes_the_node_through_its_life(
    start: StartNode, peer: Peer, tmp_path: Path
) -> None:
    waypoints = tmp_path / "waypoints.yaml"
    parameters = {**QUICK, "autostart": False, "waypoints_file": waypoints}
    node = Subgoals(start("subgoal_node", *as_arguments(parameters)), peer)
    node.until_health("its state", state="unconfigured")
    assert state(node) == "unconfigured"
    assert not change(node, "configure")  # there is no such file
    assert f"cannot be configured: {waypoints}: the file cannot be read" in node.process.err
    assert state(node) == "unconfigured"
    (changed,) = node.set(waypoints_file="")
    assert changed.successful

    assert change(node, "configure")
    node.until_health("its state", state="inactive")
    (late,) = node.set(waypoints_file="elsewhere")
    assert not late.successful
    refused = node.call("infer")
    assert (refused.success, refused.message) == (
        False,
        "subgoal_node is not active; activate it first",
    )
    assert not peer.node.get_subscriptions_info_by_topic("/pose")

    assert change(node, "activate")
    node.meet()
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)

    # At rest nothing is heard, so that a replay waits; and nothing is forgotten.
    assert change(node, "deactivate")
    peer.until(lambda: not peer.node.get_subscriptions_info_by_topic("/pose"), "nobody to listen")
    node.until_health("its state", state="inactive", observations=str(OBSERVATIONS_OF_WALK))
    assert not node.call("reset").success
    shown = len(node.outputs["subgoals"])
    assert change(node, "activate")
    peer.until(lambda: len(node.outputs["subgoals"]) > shown, "what was found before")
    assert set(node.shown().values()) == CORNER_PLACES
    node.meet()
    node.send(walk(start=START + 1000 * SECOND))
    node.until_settled(2 * OBSERVATIONS_OF_WALK)

    assert change(node, "deactivate")
    assert change(node, "cleanup")
    assert state(node) == "unconfigured"
    assert change(node, "configure")
    assert change(node, "activate")
    node.meet()
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)  # it began anew
    assert change(node, "deactivate")
    assert change(node, "shutdown")
    assert state(node) == "finalized"
    assert_silent_end(node.process, signal.SIGINT)


def test_what_the_network_names_stays_in_the_file_folder(
    start: StartNode, peer: Peer, tmp_path: Path
) -> None:
    folder, outside = tmp_path / "folder", tmp_path / "outside"
    for each in (folder, outside):
        each.mkdir()
        Image.new("L", (20, 20), 1).save(each / "rooms.png")
        (each / "rooms.yaml").write_text(
            "{image: rooms.png, resolution: 1.0, origin: [-5.0, -5.0, 0.0]}"
        )
    (folder / "link").symlink_to(outside)
    (folder / "linked.yaml").symlink_to(outside / "rooms.yaml")
    text = (folder / "rooms.yaml").read_text()
    (folder / "leads_out.yaml").write_text(text.replace("rooms.png", str(outside / "rooms.png")))
    given = outside / "rooms.yaml"
    parameters = {**QUICK, "autostart": False, "file_folder": folder, "features": given}
    node = Subgoals(start("subgoal_node", *as_arguments(parameters)), peer)
    node.until_health("its state", state="unconfigured")

    elsewhere = [
        str(outside / "rooms.txt"),
        f"{folder}/../outside/rooms.yaml",
        f"{folder}/link/rooms.yaml",
        f"{folder}/linked.yaml",
        f"{folder}2/rooms.yaml",
        "rooms.yaml",  # in the working directory
        "~/rooms.yaml",
    ]
    for name in ("features", "waypoints_file", "result_folder"):
        for value in elsewhere:
            (refused,) = node.set(**{name: value})
            assert not refused.successful, (name, value)
            assert f"is outside of {folder}" in refused.reason
    (read_only,) = node.set(file_folder="/")
    assert not read_only.successful

    # What it was given at the start it keeps, and may be given again.
    assert change(node, "configure")
    assert change(node, "cleanup")
    (again,) = node.set(features=str(given))
    assert again.successful
    # A file inside must not lead out by the image that it names, nor by a link of later.
    (named,) = node.set(features=str(folder / "leads_out.yaml"))
    assert named.successful
    assert not change(node, "configure")
    assert f"leads_out.yaml: 'image': '{outside}/rooms.png' is outside of" in node.process.err
    results = folder / "results"
    (named,) = node.set(features=str(folder / "rooms.yaml"))
    assert named.successful
    assert change(node, "configure")
    assert change(node, "cleanup")
    changed = node.set(features="", result_folder=str(results))
    assert [each.successful for each in changed] == [True, True]
    assert change(node, "configure")
    assert change(node, "activate")
    node.meet()
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    assert node.call("infer").success
    assert (results / "subgoals.json").is_file()
    shutil.rmtree(results)
    results.symlink_to(outside)
    refused = node.call("infer")
    assert not refused.success
    assert "result_folder" in refused.message
    assert "is outside of" in refused.message
    assert not (outside / "subgoals.json").exists()
    assert_silent_end(node.process, signal.SIGINT)


def test_who_waits_for_an_inference_hears_that_there_will_be_none(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(sweeps=100_000_000, burn_in=0, thin=100_000)
    node.send([map_of_grid()], walk(rounds=5))
    node.until_health("all taken", observations=str(5 * OBSERVATIONS_OF_WALK))
    answer = node.peer.ask(services.Trigger, "/subgoal_node/infer")
    assert change(node, "deactivate")
    assert not answer.done()
    assert change(node, "cleanup")
    node.peer.until(answer.done, "an answer")
    assert answer.result().message == "the node was stopped before the inference was done"
    assert_silent_end(node.process, signal.SIGTERM)


def test_names_can_be_remapped_and_set_apart(start: StartNode, peer: Peer) -> None:
    arguments = ["-r", "__ns:=/robot1", "-r", "__node:=seeker", "-r", "pose:=/where/it/is"]
    process = start("subgoal_node", *as_arguments(QUICK), *arguments)
    subgoals = peer.listen(message_class("visualization_msgs/msg/MarkerArray"), "/robot1/subgoals")
    publishers = {
        name: peer.publisher(message_class(kind), topic, qos)
        for name, topic, kind, qos in (
            ("map", "/robot1/map", "nav_msgs/msg/OccupancyGrid", LATCHED),
            ("pose", "/where/it/is", "geometry_msgs/msg/PoseStamped", RELIABLE),
            ("action", "/robot1/action", "geometry_msgs/msg/Vector3Stamped", RELIABLE),
        )
    }
    for name, view, _ in [map_of_grid(), *walk()]:
        publishers[name].publish(to_ros(view))
    peer.until(lambda: subgoals and len(subgoals[-1].markers) > 1, "subgoals")
    assert peer.call(services.Trigger, "/robot1/seeker/infer").success
    assert_silent_end(process, signal.SIGINT)


def test_reliability_can_be_overridden(start: StartNode, peer: Peer) -> None:
    best_effort = rclpy_qos.ReliabilityPolicy.BEST_EFFORT
    overrides = {"qos_overrides./pose.subscription.reliability": "best_effort"}
    node = Subgoals(start("subgoal_node", *as_arguments({**QUICK, **overrides})), peer)
    node.meet()
    (pose,) = peer.node.get_subscriptions_info_by_topic("/pose")
    (action,) = peer.node.get_subscriptions_info_by_topic("/action")
    assert pose.qos_profile.reliability == best_effort
    assert action.qos_profile.reliability != best_effort


def test_without_a_clock_simulated_time_stands_still_and_the_node_does_not(
    start: StartNode, peer: Peer
) -> None:
    node = Subgoals(start("subgoal_node", *as_arguments({**QUICK, "use_sim_time": True})), peer)
    node.meet()
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    node.until_shown(CORNER_PLACES)
    assert node.outputs["subgoals"][-1].markers[-1].header.stamp.sec == 0
    assert_silent_end(node.process, signal.SIGINT)


def test_a_clock_that_jumps_back_begins_a_new_episode(start: StartNode, peer: Peer) -> None:
    node = Subgoals(start("subgoal_node", *as_arguments({**QUICK, "use_sim_time": True})), peer)
    clock = peer.publisher(rosgraph_msgs.Clock, "/clock")
    node.meet()

    def tick(stamp: int) -> None:
        message = rosgraph_msgs.Clock()
        message.clock = to_ros(time_of(stamp))

        def has_it() -> bool:
            clock.publish(message)  # it may get lost, for rclpy asks for no better
            return node.clock == stamp // SECOND

        peer.until(has_it, f"the time {stamp}; it is {node.clock}")

    tick(START)
    # In the same cells and within the time that an episode may pause: only the clock tells.
    node.send([map_of_grid()], walk())
    node.until_settled(OBSERVATIONS_OF_WALK)
    before = node.outputs["subgoals"][-1]
    assert before.markers[-1].header.stamp.sec == START // SECOND
    tick(START - 5 * SECOND)
    node.send(walk())
    health = node.until_settled(2 * OBSERVATIONS_OF_WALK)
    assert health["drops"] == "0"
    node.until_shown(CORNER_PLACES)
    assert node.outputs["subgoals"][-1].markers[-1].header.stamp.sec == START // SECOND - 5


class Clumsy(ManagedNode):
    """Fails on every message, and has nothing to say."""

    def configure(self, values: dict[str, Any]) -> None:
        pass

    def activate(self) -> None:
        self.hear("pose", "geometry_msgs/msg/PoseStamped", self._fail, RELIABLE)

    def clean_up(self) -> None:
        pass

    def health(self) -> Health:
        return Health("clumsiness", "failing", "", faults=self.faults)

    def _fail(self, message: Any, _: Any) -> None:
        raise ValueError(message.header.frame_id)


def test_a_node_lives_on_when_it_fails_on_a_message(own_domain: None) -> None:
    rclpy = importlib.import_module("rclpy")
    executors = importlib.import_module("rclpy.executors")
    rclpy.init()
    node = Clumsy("clumsy", "clumsiness", ())
    executor = executors.SingleThreadedExecutor()
    executor.add_node(node)
    try:
        node.start()
        publisher = node.create_publisher(
            message_class("geometry_msgs/msg/PoseStamped"), "pose", RELIABLE
        )
        for number in range(3):
            publisher.publish(publisher.msg_type())
            deadline = time.monotonic() + PATIENCE
            while node.faults.total() <= number and time.monotonic() < deadline:
                executor.spin_once(timeout_sec=0.1)
        assert node.faults == {"message on which the node failed": 3}
    finally:
        executor.shutdown()
        node.close()
        rclpy.shutdown()
