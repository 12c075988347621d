"""The recorder as other nodes meet it: what it hears, how, and what every end leaves of it."""

from __future__ import annotations

import importlib
import signal
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from bnirl_ros.bags.definitions import type_hash
from bnirl_ros.bags.reader import Bag
from demonstration_support import map_of_grid, walk
from ros_support import LATCHED, RELIABLE, NodeProcess, Peer

from bnirl_ros.nodes.conversion import message_class, to_ros  # isort: skip  # needs rclpy
from bnirl_ros.nodes.record_node import contract, parse  # isort: skip

rclpy_qos = importlib.import_module("rclpy.qos")

pytestmark = pytest.mark.timeout(120)

StartNode = Callable[..., NodeProcess]
POSE = "geometry_msgs/msg/PoseStamped"
MAP = "nav_msgs/msg/OccupancyGrid"
BEST_EFFORT = rclpy_qos.QoSProfile(depth=100, reliability=rclpy_qos.ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_recording_has_all_that_was_published_however_it_ends(
    start: StartNode, peer: Peer, tmp_path: Path, number: signal.Signals
) -> None:
    # Latched before the recorder is there; and one of two publishers offers best effort only.
    latched = peer.node.create_publisher(message_class(MAP), "/map", LATCHED)
    latched.publish(to_ros(map_of_grid()[1]))
    peer.node.create_publisher(message_class(POSE), "/pose", BEST_EFFORT)
    bag = tmp_path / "bag"
    process = start("record_node", "/map", "/pose", "/none", "-o", bag)
    publisher = peer.publisher(message_class(POSE), "/pose", RELIABLE)
    peer.let_them_find_us()
    poses = [to_ros(message) for name, message, _ in walk(rounds=4) if name == "pose"]
    for pose in poses:
        publisher.publish(pose)
        peer.rest(0.02)  # heard with best effort: what comes faster than it is read is lost
    expected = {"/map": 1, "/pose": len(poses)}

    def recorded() -> bool:
        return Counter(each.topic for each in Bag(bag).messages()) == expected

    peer.until(recorded, "all of it on the disk")  # after the age of a chunk
    end = process.end(number)
    assert recorded()
    if number is not signal.SIGKILL:
        assert (end.status, Bag(bag).warnings) == (0, [])
        assert end.out == (
            f"recorded {len(poses) + 1} messages: /map 1, /pose {len(poses)}, "
            "/none not recorded (nobody published it)\n"
        )
    topics = {topic.name: topic for topic in Bag(bag).topics()}
    assert {each.durability for each in topics["/map"].qos} == {"transient_local"}
    assert {each.reliability for each in topics["/pose"].qos} >= {"best_effort"}
    assert {topic.type_hash for topic in topics.values()} == {type_hash(MAP), type_hash(POSE)}


def test_without_names_it_records_what_the_contract_has() -> None:
    names = contract()
    assert {"pose", "action", "map", "subgoals", "waypoints", "/diagnostics"} <= {*names}
    assert parse([]).topics == names
    assert parse(["/a", "b"]).topics == ("/a", "b")
    assert parse(["--all"]).topics is None
    assert parse(["-e", "/a.*"]).topics is None
    with pytest.raises(SystemExit, match=r"^2$"):
        parse(["/a", "--all"])
