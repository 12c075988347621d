"""The discretiser node over DDS: from what a robot publishes to what the subgoal node hears."""

from __future__ import annotations

import importlib
import re
import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.raw_demonstration import read_raw_demonstration
from bnirl_ros.cli import main
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.messages import stamp_of
from bnirl_ros.demonstrations.recording import Recording
from bnirl_ros.maps import GridMap, load_map
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.messages import (
    Message,
    Odometry,
    PoseWithCovariance,
    Twist,
    TwistStamped,
    Vector3,
)
from test_discretiser_bags import (
    ACTIONS,
    MAP,
    Timed,
    amcl,
    commands,
    drive,
    header,
    odometry,
    pose,
)

pytest.importorskip("rclpy", reason="rclpy is not installed")

from bnirl_ros.nodes.conversion import message_class, to_ros
from bnirl_ros.nodes.discretiser_node import OUTPUTS
from ros_support import (
    LATCHED,
    RELIABLE,
    NodeProcess,
    Peer,
    Subgoals,
    Watched,
    as_arguments,
    assert_same_results,
    assert_silent_end,
)

rclpy_qos = importlib.import_module("rclpy.qos")
rosgraph_msgs = importlib.import_module("rosgraph_msgs.msg")

pytestmark = pytest.mark.timeout(180)

DEPOT = SHARED_BAGS.parent / "maps" / "depot.yaml"
STEP_NAMES = {(1, 0): "E", (0, 1): "N", (0, 0): "stay"}


class Discretised(Watched):
    """A discretiser node in a process, and all that it publishes."""

    def __init__(self, process: NodeProcess, peer: Peer) -> None:
        super().__init__(process, peer, "discretiser_node")
        self.outputs = {
            topic.name: peer.listen(
                message_class(topic.type_name),
                f"/{topic.name}",
                LATCHED if topic.latched else RELIABLE,
            )
            for topic in OUTPUTS
        }
        self._publishers: dict[str, Any] = {}

    def announce(self, topic: str, view: Message, qos: Any = RELIABLE) -> None:
        """Begin to publish messages such as this one, and wait until the node hears them."""
        publisher = self.peer.node.create_publisher(message_class(view.TYPE), topic, qos)
        self._publishers[topic] = publisher
        self.peer.until(
            lambda: publisher.get_subscription_count() > 0,
            lambda: f"a subscriber of {topic}; says {self.health()}, {self.process.err}",
        )
        self.peer.let_them_find_us()

    def send(self, messages: Iterable[Timed]) -> None:
        for topic, _, view in messages:
            self._publishers[topic].publish(to_ros(view))

    def send_map(self, grid_map: GridMap = MAP) -> None:
        view = map_message(grid_map, 0)
        if "/map" not in self._publishers:
            self.announce("/map", view, LATCHED)
        self._publishers["/map"].publish(to_ros(view))

    def actions(self) -> str:
        """What was done, in words; what has no pose yet as well."""
        return " ".join(
            STEP_NAMES[message.vector.x, message.vector.y] for message in self.outputs["action"]
        )

    def until_done(self, actions: str, episodes: int = 1) -> None:
        """Wait until exactly this was done, and the last pose is there too."""
        wanted = (len(actions.split()), len(actions.split()) + episodes)
        self.peer.until(
            lambda: (len(self.outputs["action"]), len(self.outputs["pose"])) >= wanted,
            lambda: f"{actions}; has {self.actions()}, {self.health()}",
        )
        assert self.actions() == actions


@pytest.fixture
def discretiser(start: Callable[..., NodeProcess], peer: Peer) -> Callable[..., Discretised]:
    """Start a discretiser node with parameters."""

    def start_it(**parameters: Any) -> Discretised:
        return Discretised(start("discretiser_node", *as_arguments(parameters)), peer)

    return start_it


def assert_as_recorded(node: Discretised, recording: Recording) -> None:
    """All that was published is what is offline in the recording."""
    poses, actions = node.outputs["pose"], node.outputs["action"]
    node.peer.until(
        lambda: len(poses) >= len(recording.positions) and len(actions) >= len(recording.actions),
        lambda: f"{len(recording.positions)} poses; has {len(poses)}, {node.health()}",
    )
    positions = [(each.pose.position.x, each.pose.position.y) for each in poses]
    assert [stamp_of(each) for each in poses] == recording.pose_stamps.tolist()
    assert positions == [tuple(each) for each in recording.positions.tolist()]
    assert {each.header.frame_id for each in poses} == set(recording.frames)
    assert [stamp_of(each) for each in actions] == recording.action_stamps.tolist()


# The whole way


@needs_shared_bags
def test_from_amcl_to_subgoals_live_and_offline_are_the_same(
    discretiser: Callable[..., Discretised],
    start: Callable[..., NodeProcess],
    peer: Peer,
    tmp_path: Path,
) -> None:
    bag = SHARED_BAGS / "nav2_turtlebot"
    gap = Discretising().longest_silence
    subgoals = Subgoals(
        start(
            "subgoal_node",
            *as_arguments({"episode_gap": gap, "result_folder": tmp_path / "live"}),
            *("-r", "map:=planning_map"),
        ),
        peer,
    )
    node = discretiser(source="/amcl_pose")
    node.until_health("both to hear it, the test and the node of the subgoals", subscribers="2")
    # Nobody would hear the other topics, and it waits until somebody hears all.
    arguments = (bag, "--map", DEPOT, "--fast", "--topics", "/amcl_pose")
    assert start("replay_node", *arguments).end().status == 0
    offline, _ = read_raw_demonstration(bag, Discretising(source="/amcl_pose"), load_map(DEPOT))
    assert_as_recorded(node, offline.recording)
    assert offline.grid_map
    shown = node.outputs["planning_map"][-1]
    height, width = offline.grid_map.free.shape
    assert (shown.info.width, shown.info.height) == (width, height)
    assert [value == 0 for value in shown.data] == offline.grid_map.free.ravel().tolist()

    subgoals.until_settled(len(offline.recording.actions))
    assert subgoals.call("infer").success
    arguments = ("infer", bag, "--map", DEPOT, "--source", "/amcl_pose", "--out", tmp_path / "off")
    assert main([str(each) for each in arguments]) == 0
    assert_same_results(tmp_path / "live", tmp_path / "off")

    # Waypoints for Nav2: on the way that was driven, in free space.
    fine = load_map(DEPOT)
    driven = offline.recording.positions
    for waypoint in subgoals.outputs["waypoints"][-1].poses:
        assert waypoint.header.frame_id == "map"
        place = [waypoint.pose.position.x, waypoint.pose.position.y]
        assert np.hypot(*(driven - place).T).min() < 1e-9
        assert fine.is_free(fine.cells_of([place]))[0]


# Sources


def test_amcl_is_found_by_itself_and_followed_once_there_is_a_map(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser(planning_resolution=0.5)
    poses = amcl()
    node.announce("/amcl_pose", poses[0][2])
    assert "follows /amcl_pose (geometry_msgs/msg/PoseWithCovarianceStamped)" in node.process.err
    node.send(poses)
    node.until_health("waiting", state="waiting for a map", queue=str(len(poses)))
    assert not node.outputs["pose"]
    node.send_map()
    node.until_done(ACTIONS)
    (shown,) = node.outputs["planning_map"]
    assert (shown.info.width, shown.info.height) == (8, 8)
    node.until_health("all", state="following", queue="0", poses=str(len(poses)), drops="0")
    assert_silent_end(node.process, signal.SIGINT)


def test_odometry_in_the_maps_frame_by_best_effort(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser(source="odom", map_frame="odom")
    told = [
        (
            "/odom",
            time,
            Odometry(header(time, "odom"), "base_link", PoseWithCovariance(pose(x, y))),
        )
        for time, x, y in drive()
    ]
    node.send_map()
    best_effort = rclpy_qos.QoSProfile(
        depth=1000, reliability=rclpy_qos.ReliabilityPolicy.BEST_EFFORT
    )
    node.announce("/odom", told[0][2], best_effort)
    node.send(told)
    node.until_done(ACTIONS)
    assert node.outputs["pose"][-1].header.frame_id == "odom"


def test_poses_in_a_frame_that_nobody_joins_to_the_maps_are_counted(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser(source="/odom", transform_patience=0.1)
    told = odometry()
    node.send_map()
    node.announce("/odom", told[0][2])
    node.send(told)
    node.until_fault("pose in frame 'odom'", len(told))
    node.peer.until(lambda: "x pose in frame 'odom'" in node.process.err, "a word in the log")
    assert not node.outputs["pose"]
    assert node.health()["level"] == 1


def stamped_commands() -> list[Timed]:
    """Those of the drive, and one to stand at its end."""
    return [
        (topic, moment, TwistStamped(header(moment), twist))
        for topic, moment, twist in [*commands(), ("/cmd_vel", 8.0, Twist())]
        if isinstance(twist, Twist)
    ]


def at(message: Any, moment: float) -> Any:
    """A message with another stamp [s]."""
    return replace(message, header=header(moment, message.header.frame_id))


def test_commands_alone_are_followed_from_the_start_in_open_space(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser(source="/cmd_vel", start="0.6,0.6,0", open_space=8.0)
    told = stamped_commands()
    node.announce("/cmd_vel", told[0][2])
    node.send(told)
    node.until_done(ACTIONS)
    last = node.outputs["pose"][-1].pose.position
    assert (last.x, last.y) == (2.25, 2.25)


def test_commands_without_a_stamp_are_followed_as_they_are_published(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser(source="/cmd_vel", start="0.6,0.6,0", open_space=8.0, command_hold=0.2)
    node.announce("/cmd_vel", Twist())
    for velocity in (Vector3(2.0, 0.0), Vector3(0.0, 2.0)):
        for _ in range(10):
            node.send([("/cmd_vel", 0.0, Twist(velocity))])
            node.peer.rest(0.1)
    # The last command holds, although none comes after it.
    node.peer.until(lambda: node.actions().count("N") >= 2, node.actions)
    assert re.fullmatch("(E ){2,}(N ?){2,}", node.actions())


def test_an_intent_counts_where_the_robot_is_held_up(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser(source="/amcl_pose", intent="/cmd_vel", dwell=2.0)
    way, push = amcl(), commands()
    node.send_map()
    node.announce("/amcl_pose", way[0][2])
    node.until_health("one", state="following, waiting for the topic of intent, /cmd_vel")
    node.announce("/cmd_vel", push[0][2])
    node.send(way)
    node.until_done(ACTIONS)
    _, end, (last) = way[-1]
    held = [
        ("/amcl_pose", end + later, at(last, end + later)) for later in np.arange(0.5, 4.0, 0.5)
    ]
    for each in held:  # one after the other, as they are heard by two subscriptions
        node.send([push[0]])
        node.peer.rest(0.02)
        node.send([each])
    node.until_done(f"{ACTIONS} E")


# What it cannot take, and what it does then


def test_nothing_is_heard_before_somebody_hears_of_it(
    start: Callable[..., NodeProcess], peer: Peer
) -> None:
    node = Watched(start("discretiser_node"), peer, "discretiser_node")
    poses = amcl()
    publisher = peer.node.create_publisher(message_class(poses[0][2].TYPE), "/amcl_pose", RELIABLE)
    node.until_health(
        "it waits", state="waiting for a subscriber of pose and the topic of source and a map"
    )
    assert not publisher.get_subscription_count()
    peer.listen(message_class("geometry_msgs/msg/PoseStamped"), "/pose", RELIABLE)
    peer.until(publisher.get_subscription_count, "a subscriber of the robot's poses")


def test_a_source_that_tells_no_motion_is_told_and_waited_for(
    discretiser: Callable[..., Discretised], peer: Peer
) -> None:
    node = discretiser(source="/scan")
    node.until_health("a topic", state="waiting for the topic of source, /scan and a map")
    kind = message_class("geometry_msgs/msg/Vector3Stamped")
    peer.node.create_publisher(kind, "/scan", 10)
    health = node.until_health("an error", level=2)
    assert "/scan is of type geometry_msgs/msg/Vector3Stamped; source takes" in health["message"]


def test_commands_without_a_start_are_told(
    discretiser: Callable[..., Discretised], peer: Peer
) -> None:
    node = discretiser(source="/cmd_vel")
    peer.node.create_publisher(message_class("geometry_msgs/msg/Twist"), "/cmd_vel", 10)
    health = node.until_health("an error", level=2)
    assert (
        "give the pose from which they are followed with the parameter start"
        in (health["message"])
    )


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"planning_resolution": 0.0}, "planning_resolution must be above 0, not 0.0"),
        ({"dwell": 20.0}, "dwell must be below longest_silence, 10 s, not 20"),
        ({"start": "1,2"}, "start must be x,y,heading in m, m and rad, not '1,2'"),
        ({"moves": 6}, "parameter moves must be one of 4, 8, not 6"),
        ({"open_space": 9999.0, "planning_resolution": 0.01}, "open space"),
    ],
)
def test_parameters_that_cannot_be_are_one_sentence(
    start: Callable[..., NodeProcess], parameters: dict[str, Any], sentence: str
) -> None:
    end = start("discretiser_node", *as_arguments(parameters)).end()
    assert end.status == 1
    assert sentence in end.err
    assert end.err.count("\n") == 1


# Maps and clocks that change


def test_a_cell_that_the_robot_is_in_is_opened_and_the_map_sent_again(
    discretiser: Callable[..., Discretised],
) -> None:
    node = discretiser()
    free = MAP.free.copy()
    free[5:10, 15:20] = False  # a cell of the planning map that lies on the way
    node.send_map(GridMap(free, MAP.resolution))
    poses = amcl()
    node.announce("/amcl_pose", poses[0][2])
    node.send(poses)
    node.until_done(ACTIONS)
    node.peer.until(lambda: len(node.outputs["planning_map"]) == 2, "a second map")
    shown = [np.reshape(each.data, (8, 8)) for each in node.outputs["planning_map"]]
    (changed,) = np.argwhere(shown[0] != shown[1]).tolist()
    assert changed == [1, 3]
    assert "the robot was in 1 blocked cells of 0.5 m, which are open now" in node.process.err
    node.send_map(GridMap(free, MAP.resolution))  # the same again
    node.until_health("nothing new", opened_cells="1")
    assert len(node.outputs["planning_map"]) == 2


def test_a_clock_that_jumps_back_begins_an_episode_and_follows_from_the_start(
    discretiser: Callable[..., Discretised], peer: Peer
) -> None:
    node = discretiser(source="/cmd_vel", start="0.6,0.6,0", open_space=8.0, use_sim_time=True)
    clock = peer.publisher(rosgraph_msgs.Clock, "/clock")
    told = stamped_commands()
    node.announce("/cmd_vel", told[0][2])

    def tick(moment: int) -> None:
        message = rosgraph_msgs.Clock()
        message.clock.sec = moment
        clock.publish(message)
        peer.until(lambda: node.clock == moment, "the node's clock")

    def go(begin: int) -> None:
        tick(begin)
        node.send((topic, 0.0, at(view, begin + moment)) for topic, moment, view in told)

    go(100)
    node.until_done(ACTIONS)
    tick(108)
    go(102)  # within the way that was gone: without the clock this would be out of order
    node.until_done(f"{ACTIONS} {ACTIONS}", episodes=2)
    places = [(each.pose.position.x, each.pose.position.y) for each in node.outputs["pose"]]
    assert places[7:] == places[:7]
    node.until_health("nothing left out", drops="0")
