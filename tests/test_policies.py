"""The access policies of the nodes allow what real nodes do, and nothing else."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from bnirl_ros.experiments.scenarios import PAPER_LOOP
from bnirl_ros.nodes.conversion import message_class
from bnirl_ros.nodes.policies import policies
from ros_support import NodeProcess, Peer, as_arguments, assert_silent_end

pytestmark = pytest.mark.timeout(180)

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "policies"
NODES = ("discretiser_node", "record_node", "replay_node", "subgoal_node")

# Kinds and ways of sros2's policies, format 0.2.0.
WAYS = {
    "topics": {"publish", "subscribe"},
    "services": {"reply", "request"},
    "actions": {"call", "execute"},
}


def allowed(node: str) -> dict[str, set[str]]:
    """What a node's policy allows, as whole names by way."""
    profile = ElementTree.parse(FOLDER / f"{node}.policy.xml").find(
        f"enclaves/enclave[@path='/bnirl_ros/{node}']/profiles/profile[@ns='/'][@node='{node}']"
    )
    assert profile is not None
    names: dict[str, set[str]] = {way: set() for way in ("publish", "subscribe", "reply")}
    for rule in profile:
        ((way, qualifier),) = rule.items()
        assert qualifier == "ALLOW"
        for each in rule:
            name = (each.text or "").replace("~/", f"/{node}/")
            names[way].add(name if name.startswith("/") else f"/{name}")
    return names


def test_the_files_are_current() -> None:
    written = {path.name: path.read_text() for path in FOLDER.iterdir()}
    assert written == policies(), "run make policies"
    assert set(written) == {f"{node}.policy.xml" for node in NODES}


@pytest.mark.parametrize("node", NODES)
def test_a_policy_is_one_of_sros2(node: str) -> None:
    policy = ElementTree.parse(FOLDER / f"{node}.policy.xml").getroot()
    assert (policy.tag, policy.attrib) == ("policy", {"version": "0.2.0"})
    levels = {"enclaves": set(), "enclave": {"path"}, "profiles": set(), "profile": {"ns", "node"}}
    inner = policy
    for tag, attributes in levels.items():
        (inner,) = inner
        assert (inner.tag, set(inner.attrib)) == (tag, attributes)
    for rule in inner:
        assert rule.attrib
        assert set(rule.attrib) <= WAYS[rule.tag]
        assert set(rule.attrib.values()) <= {"ALLOW", "DENY"}
        assert len(rule) > 0
        assert {each.tag for each in rule} == {rule.tag.removesuffix("s")}
        assert all(each.text and each.text == each.text.strip() for each in rule)


def test_real_nodes_do_what_they_may_and_nothing_else(
    start: Callable[..., NodeProcess], peer: Peer, tmp_path: Path
) -> None:
    """All nodes at once, so that there is everything that one of them records or follows."""
    kinds = {
        "amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "cmd_vel": "geometry_msgs/msg/Twist",
    }
    sources = [
        peer.node.create_publisher(message_class(kind), f"/{name}", 1)
        for name, kind in kinds.items()
    ]
    simulated = as_arguments({"use_sim_time": True})
    follow = ["-p", "source:=amcl_pose", "-p", "intent:=cmd_vel"]
    bag = ROOT / "bags" / PAPER_LOOP.name
    processes = [
        start("subgoal_node", *simulated),
        start("discretiser_node", *simulated, *follow),
        start("replay_node", bag, "--clock", "10", "--start-paused"),
        start("record_node", "--output", tmp_path / "recorded"),
    ]
    graph: dict[str, Callable[..., Any]] = {
        "publish": peer.node.get_publisher_names_and_types_by_node,
        "subscribe": peer.node.get_subscriber_names_and_types_by_node,
        "reply": peer.node.get_service_names_and_types_by_node,
    }
    not_here = {
        ("subgoal_node", "subscribe"): {"/planning_map"},
        ("discretiser_node", "subscribe"): {"/odom", "/tf", "/tf_static"},
    }

    def done() -> dict[tuple[str, str], set[str]]:
        there = dict(peer.node.get_node_names_and_namespaces())
        return {
            (node, way): {name for name, _ in ask(node, "/")} if node in there else set()
            for node in NODES
            for way, ask in graph.items()
        }

    def differences() -> dict[tuple[str, str], set[str]]:
        found = done()
        wanted = {key: allowed(key[0])[key[1]] - not_here.get(key, set()) for key in found}
        return {key: found[key] ^ wanted[key] for key in found if found[key] != wanted[key]}

    peer.until(lambda: not differences(), lambda: f"what is allowed; differs: {differences()}")
    for node in NODES:
        assert not peer.node.get_client_names_and_types_by_node(node, "/")
    for process in processes:
        assert_silent_end(process, signal.SIGINT)
    assert len(sources) == len(kinds)


def test_a_node_that_is_not_let_in_says_so(
    start: Callable[..., NodeProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no keystore, and ROS's wheels are built without security in any case."""
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
    monkeypatch.setenv("ROS_SECURITY_KEYSTORE", str(tmp_path / "none"))
    enclave = ["--ros-args", "--enclave", "/bnirl_ros/subgoal_node"]
    end = start("subgoal_node", *enclave).end()
    assert end.status == 1
    assert "subgoal_node: was not let in by ROS's security" in end.err
    assert "Traceback" not in end.err
