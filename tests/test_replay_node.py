"""The replay as other nodes meet it: its options and services, over DDS."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bnirl_ros.bags.qos import LATCHED, QosProfile
from bnirl_ros.demonstrations.messages import stamp_of
from demonstration_support import SECOND, START, map_of_grid, walk, write_bag
from ros_support import NodeProcess, Peer, parameter_services, services

from bnirl_ros.nodes.conversion import message_class  # isort: skip  # needs rclpy
from bnirl_ros.nodes.process import separated  # isort: skip
from bnirl_ros.nodes.qos import joint_offer  # isort: skip
from bnirl_ros.nodes.replay_options import Options, parse  # isort: skip
from bnirl_ros.nodes.selection import Selection  # isort: skip

import importlib  # isort: skip

rclpy_parameter = importlib.import_module("rclpy.parameter")
rclpy_qos = importlib.import_module("rclpy.qos")

pytestmark = pytest.mark.timeout(120)

StartNode = Callable[..., NodeProcess]
POSE = "geometry_msgs/msg/PoseStamped"
ACTION = "geometry_msgs/msg/Vector3Stamped"
MAP = "nav_msgs/msg/OccupancyGrid"
STEP = walk()[2][2] - walk()[0][2]  # between two poses


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A map, and a walk of 25 poses and 24 actions, a pose each STEP."""
    return write_bag(tmp_path / "bag", [map_of_grid(), *walk()])


class Replay:
    """A replay in a process, and what it is asked for."""

    def __init__(self, process: NodeProcess, peer: Peer) -> None:
        self.process, self._peer = process, peer

    def call(self, service: str) -> tuple[bool, str]:
        answer = self._peer.call(services.Trigger, f"/replay_node/{service}")
        return answer.success, answer.message

    def set(self, name: str, value: Any) -> Any:
        request = parameter_services.SetParameters.Request()
        request.parameters = [rclpy_parameter.Parameter(name, value=value).to_parameter_msg()]
        kind = parameter_services.SetParameters
        return self._peer.call(kind, "/replay_node/set_parameters", request).results[0]


def test_a_replay_does_what_it_is_asked_for(start: StartNode, peer: Peer, bag: Path) -> None:
    poses = peer.listen(message_class(POSE), "/pose", 100)
    actions = peer.listen(message_class(ACTION), "/action", 100)
    maps = peer.listen(message_class(MAP), "/map")
    clocks = peer.listen(message_class("rosgraph_msgs/msg/Clock"), "/clock", 100)
    replay = Replay(start("replay_node", bag, "--start-paused", "--clock"), peer)

    def clock() -> int:
        return clocks[-1].clock.sec * SECOND + clocks[-1].clock.nanosec

    # Paused: the clock goes on, and stands still; only what is latched has come.
    assert replay.call("is_paused") == (True, "paused at 0.000 s of 12.000 s, rate 1")
    peer.until(lambda: len(clocks) > 3 and maps, "the clock, and the map")
    assert {each.clock.sec * SECOND + each.clock.nanosec for each in clocks} == {START}
    assert not poses

    assert replay.call("play_next")[0]
    peer.until(lambda: poses, "a pose")
    assert replay.set("burst_count", 3).successful
    assert replay.call("burst") == (
        True,
        "sent 3 messages; paused at 0.500 s of 12.000 s, rate 1",
    )
    peer.until(lambda: len(poses) + len(actions) == 4, "three messages more")
    peer.until(lambda: clock() == START + STEP, "the time of the last one")
    assert not replay.set("burst_count", 0).successful

    assert replay.set("seek_to", 10.0).successful
    assert replay.call("seek")[0]
    peer.until(lambda: len(maps) == 2, "the map again")
    peer.until(lambda: clock() == START + 10 * SECOND, "the time that was sought")
    assert replay.set("seek_to", 12.1).successful
    assert replay.call("seek") == (False, "seek_to is 12.1 s, the recording ends at 12.0 s")

    assert replay.set("rate", 0.001).successful
    assert replay.call("set_rate") == (True, "paused at 10.000 s of 12.000 s, rate 0.001")
    assert replay.call("toggle_paused")[0]
    success, place = replay.call("is_paused")
    assert not success
    assert place.startswith("playing at 10.00")
    assert replay.call("burst") == (False, "is not paused; call ~/pause first")
    assert replay.call("pause")[0]
    assert not replay.set("rate", -1.0).successful or not replay.call("set_rate")[0]
    assert replay.set("rate", 8.0).successful
    assert replay.call("set_rate")[0]
    assert replay.call("resume")[0]
    end = replay.process.end()
    assert end.status == 0
    assert end.out == "sent 15 messages: /action 6, /map 2, /pose 7\n"
    expected = [START, START + STEP, *range(START + 10 * SECOND, START + 12 * SECOND + 1, STEP)]
    peer.until(lambda: len(poses) == 7, "the last poses")
    assert [stamp_of(each) for each in poses] == expected
    times = [each.clock.sec * SECOND + each.clock.nanosec for each in clocks]
    assert times == sorted(times)


def test_a_part_of_a_bag_is_played_on_other_topics_with_other_qos(
    start: StartNode, peer: Peer, bag: Path, tmp_path: Path
) -> None:
    (tmp_path / "qos.yaml").write_text(
        "/pose: {durability: transient_local, depth: 3, deadline: {sec: 1, nsec: 0}}\n"
    )
    maps = peer.listen(message_class(MAP), "/map")
    process = start(
        *("replay_node", bag, "--start-offset", "5", "--playback-duration", "2", "--fast"),
        *("--exclude-topics", "action", "nothing", "--remap", "pose:=/elsewhere"),
        *("--qos-profile-overrides-path", tmp_path / "qos.yaml", "--wait", "60"),
    )
    (info,) = peer.until(
        lambda: peer.node.get_publishers_info_by_topic("/elsewhere"), "a publisher that waits"
    )
    assert info.qos_profile.durability == rclpy_qos.DurabilityPolicy.TRANSIENT_LOCAL
    poses = peer.listen(message_class(POSE), "/elsewhere", rclpy_qos.QoSProfile(depth=100))
    end = process.end()
    assert end.status == 0
    assert "there is no /nothing in the recording" in end.err
    # Three poses were latched before, five come; the map was latched long before.
    assert end.out == "sent 9 messages: /map 1, /pose 8, /action not sent (not wanted)\n"
    first = START + 5 * SECOND - 3 * STEP
    peer.until(lambda: len(poses) == 8 and maps, "all of them")
    assert [stamp_of(each) for each in poses] == [first + step * STEP for step in range(8)]


def test_a_loop_goes_on_until_it_is_stopped(start: StartNode, peer: Peer, bag: Path) -> None:
    poses = peer.listen(message_class(POSE), "/pose", 1000)
    process = start("replay_node", bag, "--loop", "--rate", "100", "--regex", "/po.*")
    peer.until(lambda: len(poses) > 60, "three rounds")
    assert Replay(process, peer).call("stop")[0]
    end = process.end()
    assert end.status == 0
    assert re.fullmatch(
        r"sent \d+ messages: /pose \d+, /action not sent \(not wanted\), /map not sent "
        r"\(not wanted\); stopped at \d+\.\d s of 12\.0 s\n",
        end.out,
    )
    stamps = [stamp_of(each) for each in poses]
    assert stamps[:50] == 2 * [START + step * STEP for step in range(25)]


def test_resuming_ends_the_waiting(start: StartNode, peer: Peer, bag: Path) -> None:
    process = start("replay_node", bag, "--rate", "20", "--wait", "1000")
    assert Replay(process, peer).call("resume")[0]
    assert process.end().out == "sent 50 messages: /action 24, /map 1, /pose 25\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--start-offset", "13"], "--start-offset 13: the recording ends after 12.0 s"),
        (["--topics", "/none"], "has none of the topics that are wanted; it has /action, /map"),
        (["--remap", "/pose:=/no name"], "/no name: is no name for a topic"),
        (["--qos-profile-overrides-path", "none.yaml"], "none.yaml: the QoS overrides cannot be"),
    ],
)
def test_what_does_not_fit_the_bag_is_one_sentence(
    start: StartNode, bag: Path, arguments: list[str], words: str
) -> None:
    end = start("replay_node", bag, *arguments).end()
    assert (end.status, end.out) == (1, "")
    assert end.err.count("\n") == 1
    assert words in end.err


def test_one_publisher_stands_for_several() -> None:
    best_effort, reliable = QosProfile(reliability="best_effort"), QosProfile(depth=7)
    assert joint_offer([]) == QosProfile()
    assert joint_offer([best_effort]) == best_effort
    assert joint_offer([best_effort, reliable]) == reliable
    assert joint_offer([LATCHED, LATCHED]) == LATCHED
    assert joint_offer([LATCHED, reliable]).durability == "volatile"


# The command line


def test_what_people_know_from_ros2_bag_play_is_understood() -> None:
    line = (
        "a b -r 2 -l -d 1 --start-offset 3 --playback-duration 4 -p --topics /x y -e /z.* "
        "--exclude-topics w -x .*v --longest-silence 5 -m /x:=/u "
        "--qos-profile-overrides-path q.yaml --clock"
    )
    assert parse(line.split()) == Options(
        bags=(Path("a"), Path("b")),
        rate=2.0,
        loop=True,
        delay=1.0,
        offset=3.0,
        duration=4.0,
        paused=True,
        longest_silence=5.0,
        selection=Selection(("/x", "/y"), re.compile("/z.*"), ("/w",), re.compile(".*v")),
        remaps=(("/x", "/u"),),
        qos_overrides=Path("q.yaml"),
        clock=40.0,
    )
    assert parse(["a"]) == Options(bags=(Path("a"),))
    assert parse(["a", "--fast", "--clock", "100"]) == Options((Path("a"),), None, clock=100.0)


@pytest.mark.parametrize(
    "arguments",
    ["", "a --rate -1", "a --start-offset -1", "a -e [", "a -m x", "a --clock 0", "a -r 1 --fast"],
)
def test_wrong_options_end_with_status_2(arguments: str) -> None:
    with pytest.raises(SystemExit) as end:
        parse(arguments.split())
    assert end.value.code == 2


def test_topics_are_chosen_by_name_and_by_pattern() -> None:
    names = ["/a", "b", "/ab", "/c"]

    def chosen(**given: Any) -> list[str]:
        return [name for name in names if Selection(**given).has(name)]

    assert chosen() == names
    assert chosen(topics=("/b",)) == ["b"]
    assert chosen(regex=re.compile("/a")) == ["/a"]
    assert chosen(topics=("/b",), regex=re.compile("/a.*")) == ["/a", "b", "/ab"]
    assert chosen(exclude=("/b",), exclude_regex=re.compile("/a.+")) == ["/a", "/c"]
    assert chosen(topics=("/a", "/b"), exclude=("/a",)) == ["b"]


def test_arguments_of_ros_are_told_from_remappings_of_ours() -> None:
    line = "a -m /x:=/y --ros-args -r /z:=/w -- b --ros-args -p rate:=2.0"
    own, of_ros = separated(line.split())
    assert " ".join(own) == "a -m /x:=/y b"
    assert " ".join(of_ros) == "--ros-args -r /z:=/w -- --ros-args -p rate:=2.0"
