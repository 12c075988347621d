"""What comes too fast, or from peers that stop, die and come again."""

from __future__ import annotations

import importlib
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bnirl_ros.maps import GridMap
from demonstration_support import (
    CORNERS,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    map_of_grid,
    pose_at,
    walk,
    write_bag,
)
from ros_support import (
    LATCHED,
    RELIABLE,
    NodeProcess,
    Peer,
    Subgoals,
    Watched,
    as_arguments,
)

from bnirl_ros.nodes.conversion import message_class, to_ros  # isort: skip  # needs rclpy
from bnirl_ros.nodes.subscriptions import Losses  # isort: skip

QoSProfile = importlib.import_module("rclpy.qos").QoSProfile

pytestmark = pytest.mark.timeout(180)

QUICK: dict[str, Any] = {"sweeps": 300, "burn_in": 100, "journal": False}
CORNER_PLACES = {tuple(place) for place in MAP.centres_of(list(CORNERS)).tolist()}


# Counting what was lost


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_gaps_of_one_publisher_are_losses(taken: list[bool]) -> None:
    losses = Losses(lambda: 1)
    counted = [losses.taken(number) for number, came in enumerate(taken, 1) if came]
    rows = [number for number, came in enumerate(taken) if came]
    missing = rows[-1] - rows[0] + 1 - len(rows) if rows else 0
    assert sum(counted) == missing


@given(
    st.integers(1, 4).flatmap(
        lambda publishers: st.tuples(
            st.just(publishers),
            st.lists(st.tuples(st.integers(0, publishers - 1), st.booleans()), max_size=100),
        )
    )
)
def test_of_several_publishers_no_more_is_counted_than_was_lost(
    sent: tuple[int, list[tuple[int, bool]]],
) -> None:
    publishers, messages = sent
    losses, numbers = Losses(lambda: publishers), [0] * publishers
    counted = lost = 0
    for publisher, came in messages:
        numbers[publisher] += 1
        if came:
            counted += losses.taken(numbers[publisher])
        else:
            lost += 1
    assert counted <= lost


def test_what_the_middleware_tells_is_not_counted_twice() -> None:
    losses = Losses(lambda: 1)
    assert losses.told(5) == 5  # before the first message that came
    assert losses.taken(6) == 0
    assert losses.taken(9) == 0  # no more than was told of
    assert losses.taken(15) == 2
    assert losses.told(1) == 0
    assert losses.told(3) == 2
    assert losses.taken(None) == 0


def test_a_publisher_that_comes_again_begins_anew() -> None:
    losses = Losses(lambda: 1)
    assert [losses.taken(number) for number in (100, 101, 1, 2, 3, 5)] == [0] * 5 + [1]


# Too much


@pytest.mark.parametrize("kept", [100, 5000])
def test_what_a_full_queue_has_no_room_for_is_counted(
    start: Callable[..., NodeProcess], peer: Peer, kept: int
) -> None:
    """`kept` by the publisher, for whoever is slow; the node hangs for a while."""
    process = start("subgoal_node", *as_arguments({**QUICK, "queue_depth": 200}))
    node = Watched(process, peer, "subgoal_node")
    kind = message_class("geometry_msgs/msg/PoseStamped")
    publisher = peer.publisher(kind, "/pose", QoSProfile(depth=kept))
    peer.let_them_find_us()
    messages = [to_ros(pose_at(0.5, 0.5, START + number)[1]) for number in range(3000)]
    publisher.publish(messages[0])
    node.until_health("the first", queue="1")
    process.send(signal.SIGSTOP)
    for message in messages[1:]:
        publisher.publish(message)
    process.send(signal.SIGCONT)

    def all_known() -> bool:
        health = node.health()
        lost = int(health.get("left out: message lost on its way", 0))
        return int(health["queue"]) + lost == len(messages)

    peer.until(all_known, lambda: f"every message, says {node.health()}")


def test_of_more_than_may_be_kept_the_oldest_is_forgotten(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(**QUICK, observation_limit=80)
    node.send([map_of_grid()], *(walk(start=START + 1000 * SECOND * turn) for turn in range(5)))
    health = node.until_health("the last ones", state="settled", queue="0")
    assert 3 * OBSERVATIONS_OF_WALK - 10 <= int(health["observations"]) <= 80
    forgotten = health["left out: oldest pose or action, where there are more than are kept"]
    # 125 poses with 120 actions came in all.
    assert 245 - 2 * 80 <= int(forgotten) <= 245 - 2 * 68  # at least 69 poses, and 68 actions
    node.until_shown(CORNER_PLACES)
    assert "left out" in node.process.err
    assert node.call("infer").success


# Several nodes, and peers that fail


def places_in(markers: Any) -> set[tuple[float, float]]:
    """Where subgoals are shown."""
    return {
        (marker.pose.position.x, marker.pose.position.y)
        for marker in markers.markers
        if marker.ns == "subgoal"
    }


def test_ten_nodes_in_namespaces_of_their_own_do_not_hear_each_other(
    start: Callable[..., NodeProcess], peer: Peer
) -> None:
    names = [f"robot{number}" for number in range(10)]
    nodes = [start("subgoal_node", *as_arguments(QUICK), "-r", f"__ns:=/{name}") for name in names]
    shown = {
        name: peer.listen(message_class("visualization_msgs/msg/MarkerArray"), f"/{name}/subgoals")
        for name in names
    }
    maps = {
        name: GridMap(MAP.free, origin=(100.0 * number, 0.0, 0.0))
        for number, name in enumerate(names)
    }
    for name, grid_map in maps.items():
        publishers = {}
        for topic, message, _ in [map_of_grid(grid_map), *walk(grid_map=grid_map)]:
            if topic not in publishers:
                publishers[topic] = peer.publisher(
                    message_class(message.TYPE),
                    f"/{name}/{topic}",
                    LATCHED if topic == "map" else RELIABLE,
                )
            publishers[topic].publish(to_ros(message))
    for name, grid_map in maps.items():
        places = {tuple(place) for place in grid_map.centres_of(list(CORNERS)).tolist()}
        peer.until(
            lambda heard=shown[name], places=places: heard and places_in(heard[-1]) == places,
            f"the subgoals of {name}",
        )
    assert all(node.running for node in nodes)


LISTENER = """
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from visualization_msgs.msg import MarkerArray

rclpy.init()
node = rclpy.create_node("listener")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
for topic in ("subgoals", "assignments", "intent"):
    node.create_subscription(MarkerArray, topic, lambda _: print("heard", flush=True), latched)
rclpy.spin(node)
"""


@pytest.fixture
def listener(own_domain: None) -> Iterator[subprocess.Popen[str]]:
    """A process that subscribes to what the node publishes."""
    with subprocess.Popen(
        [sys.executable, "-c", LISTENER], stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.kill()


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_subscriber_that_hangs_or_dies_holds_nobody_up(
    subgoals: Callable[..., Subgoals], listener: subprocess.Popen[str], number: signal.Signals
) -> None:
    node = subgoals(**QUICK)
    node.send([map_of_grid()], walk())
    assert listener.stdout is not None
    assert listener.stdout.readline() == "heard\n"
    listener.send_signal(number)
    for turn in range(1, 4):
        node.send(walk(start=START + 1000 * SECOND * turn))
        node.until_settled(OBSERVATIONS_OF_WALK * (turn + 1))
        assert node.call("infer").success
    node.until_shown(CORNER_PLACES)
    assert node.health()["drops"] == "0"


def test_a_replayer_that_dies_can_begin_again(
    subgoals: Callable[..., Subgoals], start: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    """Its stamps go back then, so that what it plays again are further episodes."""
    node = subgoals(**QUICK)
    bag = write_bag(tmp_path / "bag", [map_of_grid(), *walk()])
    first = start("replay_node", bag, "--rate", "4")
    node.peer.until(
        lambda: int(node.health().get("observations", "0")) >= 5, "the first observations"
    )
    first.end(signal.SIGKILL)
    health = node.until_health("rest", state="settled", queue="0")
    before = int(health["observations"])
    assert before < OBSERVATIONS_OF_WALK
    assert start("replay_node", bag, "--fast").end().status == 0
    # The pose in which the first one died may have got no action from it, and gets the second's.
    node.peer.until(
        lambda: abs(int(node.health()["observations"]) - before - OBSERVATIONS_OF_WALK) <= 1,
        lambda: f"all, says {node.health()}",
    )
    node.until_shown(CORNER_PLACES)
