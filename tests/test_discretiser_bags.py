"""Bags of what robots publish anyway are read, brought into the map's frame and discretised."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.demonstration import RecordedDemonstration, read_demonstration
from bnirl_ros.bags.qos import RELIABLE
from bnirl_ros.bags.raw_demonstration import is_raw, read_raw_demonstration
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.cli import main
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.study.turtle import score
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Summary, summarise
from bnirl_ros.maps import GridMap, load_map
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.messages import (
    Header,
    Message,
    OccupancyGrid,
    Odometry,
    Point,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from demonstration_support import BAGS, SECOND
from test_discretiser_frames import transform

WALL = 1_700_000_000 * SECOND
"""When the first message is received: header stamps are simulation time, from 0 [ns]."""

MAP = GridMap(np.pad(np.ones((38, 38), dtype=bool), 1), 0.1)
"""4 m square, with a wall of a cell all round."""

NOWHERE = PoseWithCovariance(Pose(Point(math.nan, 0.0)))

Timed = tuple[str, float, Message]
"""Topic, time [s] and message."""


def header(time: float, frame: str = "map") -> Header:
    return Header(Time(*divmod(round(time * SECOND), SECOND)), frame)


def pose(x: float, y: float, yaw: float = 0.0) -> Pose:
    return Pose(Point(x, y), Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2)))


def drive(end: float = 8.0, step: float = 0.1) -> list[tuple[float, float, float]]:
    """Time and position of one that goes right from (0.6, 0.6), and then up, at 0.4 m/s."""
    times = np.arange(0.0, end + step / 2, step)
    along = 0.4 * times
    return [
        (time, 0.6 + min(way, 1.6), 0.6 + max(way - 1.6, 0.0))
        for time, way in zip(times.tolist(), along.tolist(), strict=True)
    ]


ACTIONS = "E E E N N N"
"""What `drive` does on cells of 0.5 m."""


def odometry(topic: str = "/odom", frame: str = "odom") -> list[Timed]:
    """The drive as odometry tells it, whose frame is turned by 90 degrees and shifted."""
    return [
        (topic, time, Odometry(header(time, frame), "base_link", PoseWithCovariance(pose(y, -x))))
        for time, x, y in drive()
    ]


def corrections(start: float = 0.0, end: float = 8.0) -> list[Timed]:
    """The transform from odometry's frame to the map's."""
    return [
        ("/tf", float(time), transform("map", "odom", float(time), 0.0, 0.0, math.pi / 2))
        for time in np.arange(start, end + 0.1, 0.5)
    ]


def amcl(topic: str = "/amcl_pose", frame: str = "map") -> list[Timed]:
    return [
        (
            topic,
            time,
            PoseWithCovarianceStamped(header(time, frame), PoseWithCovariance(pose(x, y))),
        )
        for time, x, y in drive(step=0.6)
    ]


def commands(topic: str = "/cmd_vel") -> list[Timed]:
    """The drive as commands, forwards and then to the left."""
    return [
        (topic, tick / 10, Twist(Vector3(0.4 if tick < 40 else 0.0, 0.0 if tick < 40 else 0.4)))
        for tick in range(80)
    ]


def write(folder: Path, messages: Iterable[Timed]) -> Path:
    """A bag of these messages, received in the order of their times."""
    messages = sorted(messages, key=lambda message: message[1])
    with BagWriter(folder) as writer:
        for topic, kind in {topic: message.TYPE for topic, _, message in messages}.items():
            writer.add_topic(topic, kind, RELIABLE)
        for topic, time, message in messages:
            writer.write(topic, message, WALL + round(2 * time * SECOND))
    return folder


def read(
    bag: Path, grid_map: GridMap | None = MAP, moves: int = 8, **settings: object
) -> tuple[RecordedDemonstration, str]:
    return read_raw_demonstration(bag, Discretising(**settings), grid_map, moves)  # type: ignore[arg-type]


def actions_in(recorded: RecordedDemonstration, moves: int = 8) -> str:
    assert recorded.grid_map is not None
    placement = place(recorded.recording, recorded.grid_map, moves, 10.0)
    assert not placement.faults
    return " ".join(ACTION_NAMES[action] for action in placement.demonstration.action)


SOURCES: dict[str, list[Timed]] = {
    "/odom": [*odometry(), *corrections()],
    "/amcl_pose": amcl(),
    "/robot/pose": [
        ("/robot/pose", time, PoseStamped(header(time), pose(x, y))) for time, x, y in drive()
    ],
    "/tf": [
        ("/tf", time, transform("odom", "base_link", time, y, -x, 0.0)) for time, x, y in drive()
    ]
    + corrections(),
}


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("named", [True, False])
def test_every_source_tells_the_same_drive(tmp_path: Path, source: str, named: bool) -> None:
    bag = write(tmp_path / "bag", SOURCES[source])
    assert is_raw(bag, Discretising())
    recorded, words = read(bag, source=source if named else "")
    assert actions_in(recorded) == ACTIONS
    assert f"{source} (" in words
    assert ("by tf" in words) == (source in ("/odom", "/tf"))
    assert recorded.warnings == ()
    assert not recorded.faults
    assert recorded.recording.frames == ("map",)
    assert recorded.recording.pose_stamps[-1] < 9 * SECOND  # the header's, not the log's
    positions = recorded.recording.positions
    assert (np.abs(positions[0] - 0.75) < 1e-9).all()
    assert recorded.grid_map is not None
    assert recorded.grid_map.resolution == 0.5


def test_the_first_kind_that_can_be_used_is_taken(tmp_path: Path) -> None:
    everything = [*SOURCES["/odom"], *SOURCES["/amcl_pose"], *SOURCES["/robot/pose"], *commands()]
    _, words = read(write(tmp_path / "all", everything))
    assert "/odom (nav_msgs/msg/Odometry), brought from odom to map by tf" in words
    recorded, words = read(write(tmp_path / "bag", [*odometry(), *amcl()]))
    assert "/amcl_pose (geometry_msgs/msg/PoseWithCovarianceStamped)" in words
    (warning,) = recorded.warnings
    assert "81 x pose of /odom in frame 'odom', which tf does not join to 'map'" in warning
    assert actions_in(recorded) == ACTIONS


def test_goals_are_no_motion(tmp_path: Path) -> None:
    goals = [
        ("/goal_pose", 0.0, PoseStamped(header(0.0), pose(3.0, 3.0))),
        ("/initialpose", 0.0, PoseWithCovarianceStamped(header(0.0))),
    ]
    assert not is_raw(write(tmp_path / "goals", goals), Discretising())
    _, words = read(write(tmp_path / "bag", [*goals, *SOURCES["/robot/pose"]]))
    assert "/robot/pose" in words


def test_poses_that_cannot_be_brought_into_the_maps_frame_are_counted(tmp_path: Path) -> None:
    strange = [("/amcl_pose", 3.05, amcl(frame="marsh")[0][2])] * 2
    recorded, _ = read(write(tmp_path / "strange", [*amcl(), *strange]))
    assert recorded.faults == {
        "pose of /amcl_pose in frame 'marsh', which tf does not join to 'map'": 2
    }
    assert actions_in(recorded) == ACTIONS
    recorded, _ = read(write(tmp_path / "late", [*odometry(), *corrections(1.05)]))
    assert recorded.faults == {"pose of /odom at a time of which tf tells nothing": 11}
    assert actions_in(recorded) == ACTIONS.removeprefix("E ")  # it was there after 1 s already
    nan = ("/amcl_pose", 3.05, PoseWithCovarianceStamped(header(3.05), NOWHERE))
    recorded, _ = read(write(tmp_path / "nan", [*amcl(), nan]))
    assert recorded.faults == {"pose with a coordinate that is not finite": 1}


def test_all_sources_that_cannot_be_used_are_named_and_what_to_do_once(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [*SOURCES["/odom"], *SOURCES["/amcl_pose"]])
    with pytest.raises(InputError) as caught:
        read(bag, map_frame="ship")
    words = str(caught.value)
    assert all(f"{topic} tells no pose" in words for topic in ("/odom", "/amcl_pose"))
    assert words.count("--map-frame") == 1


def test_the_map_may_have_another_frame(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", amcl(frame="robot1/map"))
    recorded, _ = read(bag, map_frame="robot1/map")
    assert actions_in(recorded) == ACTIONS
    assert recorded.recording.frames == ("robot1/map",)
    own, _ = read(bag, replace(MAP, frame_id="robot1/map"))
    assert actions_in(own) == ACTIONS


def test_commands_alone_are_followed_from_a_start(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [(topic, t / 2, each) for topic, t, each in commands()])
    recorded, words = read(bag, start="0.6,0.6,0")
    assert actions_in(recorded) == ACTIONS
    assert "followed from (0.6, 0.6), 0 rad" in words
    with pytest.raises(InputError, match=r"/cmd_vel has velocity commands.*--start x,y,heading"):
        read(bag)
    # Stamped ones have the time in their header; turned by 90 degrees they go up, then left.
    stamped: list[Timed] = [
        ("/cmd", time, TwistStamped(header(time, "base_link"), message))
        for _, time, message in commands()
        if isinstance(message, Twist)
    ]
    recorded, _ = read(write(tmp_path / "stamped", stamped), start="2.2,0.6,1.5707963")
    assert actions_in(recorded) == "N N N W W W W"  # the last one holds for a second
    # Where nothing was commanded for long, nobody knows what happened.
    later = [(topic, time + 20.0, message) for topic, time, message in stamped]
    paused: list[Timed] = [
        (topic, time, replace(message, header=header(time)))  # type: ignore[type-var]
        for topic, time, message in [*stamped[:20], *later[20:]]
    ]
    recorded, _ = read(write(tmp_path / "paused", paused), start="2.2,0.6,1.5707963")
    assert recorded.grid_map is not None
    placement = place(recorded.recording, recorded.grid_map, 8, 10.0)
    assert set(placement.demonstration.episode) == {0, 1}
    broken: list[Timed] = [("/cmd", 0.0, Twist(Vector3(math.nan)))]
    with pytest.raises(InputError, match="/cmd has no velocity command that can be used"):
        read(write(tmp_path / "broken", broken), start="1,1,0")


@pytest.mark.parametrize("source", ["/odom", "/tf", "/amcl_pose"])
def test_intent_is_heard_where_the_robot_is_held_up(tmp_path: Path, source: str) -> None:
    held = drive()[-1]
    times = [held[0] + tick / 10 for tick in range(1, 60)]
    messages = [*SOURCES[source], *corrections(8.0, 14.0)]
    for time in times:
        _, x, y = held
        stood: dict[str, Message] = {
            "/odom": Odometry(header(time, "odom"), pose=PoseWithCovariance(pose(y, -x))),
            "/tf": transform("odom", "base_link", time, y, -x, 0.0),
            "/amcl_pose": PoseWithCovarianceStamped(header(time), PoseWithCovariance(pose(x, y))),
        }
        messages += [(source, time, stood[source]), ("/cmd_vel", time, Twist(Vector3(0.2)))]
    bag = write(tmp_path / "bag", messages)
    recorded, _ = read(bag, source=source)
    assert actions_in(recorded) == f"{ACTIONS} stay"
    recorded, words = read(bag, source=source, intent="cmd_vel")
    # Odometry's heading is 0 in a frame that is turned by 90 degrees.
    assert actions_in(recorded) == f"{ACTIONS} {'E' if source == '/amcl_pose' else 'N'}"
    assert words.endswith("; intent from /cmd_vel (59 commands)")
    with pytest.raises(InputError, match=r"no velocity commands .* on /odometry; .*--intent"):
        read(bag, source=source, intent="/odometry")


def test_the_map_in_the_bag_is_taken_and_coarsened(tmp_path: Path) -> None:
    grid = map_message(MAP, 0)
    assert isinstance(grid, OccupancyGrid)
    bag = write(tmp_path / "bag", [("/map", 0.0, grid), *amcl()])
    recorded, _ = read(bag, None)
    assert recorded.grid_map is not None
    assert recorded.grid_map.free.shape == (8, 8)
    assert actions_in(recorded) == ACTIONS
    given, _ = read(bag, replace(MAP, free=np.ones((60, 60), dtype=bool)))
    assert given.grid_map is not None
    assert given.grid_map.free.shape == (12, 12)


def test_without_a_map_there_is_open_space(tmp_path: Path) -> None:
    recorded, _ = read(write(tmp_path / "bag", amcl()), None)
    assert actions_in(recorded) == ACTIONS
    assert recorded.grid_map is not None
    assert recorded.grid_map.free.all()
    assert recorded.grid_map.free.shape == (6, 6)
    assert "has no map" in recorded.warnings[0]


def test_blocked_cells_on_the_way_are_opened_and_reported(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", amcl())
    free = MAP.free.copy()
    free[:9, 10:15] = False
    recorded, _ = read(bag, replace(MAP, free=free))
    assert actions_in(recorded) == ACTIONS
    assert recorded.grid_map is not None
    assert recorded.grid_map.free[1, 2]
    (warning,) = recorded.warnings
    assert warning.endswith("was in 1 blocked cells of 0.5 m, which are open now: (2, 1)")
    # The robot is not as wide as it is said to be: it was where the map is free.
    recorded, _ = read(bag, robot_radius=1.5)
    assert actions_in(recorded) == ACTIONS
    (warning,) = recorded.warnings
    assert "; 5 of them only the coarsening had closed, for which robot_radius or" in warning


def test_a_map_topic_of_another_type_is_named(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", [("/map", 0.0, PoseStamped()), *amcl()])
    recorded, _ = read(bag, None, source="/amcl_pose")
    assert "topic /map is of type geometry_msgs/msg/PoseStamped, not" in recorded.warnings[0]


def test_far_poses_make_no_endless_map(tmp_path: Path) -> None:
    far = PoseWithCovarianceStamped(header(9.0), PoseWithCovariance(pose(1e6, 1e6)))
    with pytest.raises(InputError, match=r"bag: the map has .* cells, more than"):
        read(write(tmp_path / "bag", [*amcl(), ("/amcl_pose", 9.0, far)]), None)


@pytest.mark.parametrize(
    ("messages", "settings", "says"),
    [
        (amcl(), {"source": "/odom"}, r"bag: /odom tells no motion; there are /amcl_pose \("),
        (amcl(frame="ice"), {}, r"14 x pose of /amcl_pose in frame 'ice'.*--map-frame"),
        (SOURCES["/tf"], {"base_frame": "sled"}, r"how 'sled' moves; name one of base_link, map"),
        (
            [("/amcl_pose", 0.0, PoseWithCovarianceStamped(header(0.0), NOWHERE))],
            {},
            r"/amcl_pose tells no pose that can be used \(1 x .* not finite\)",
        ),
        (amcl()[:2], {}, r"by /amcl_pose \(.*\) the robot never leaves a cell of 0.5 m"),
        (amcl(), {"robot_radius": 9.0}, r"bag: the map has no place for a robot with a radius of"),
    ],
)
def test_what_cannot_be_read_is_named(
    tmp_path: Path, messages: list[Timed], settings: dict[str, object], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        read(write(tmp_path / "bag", messages), **settings)


def test_bags_with_pose_and_action_are_left_as_they_are(tmp_path: Path) -> None:
    assert not is_raw(BAGS / "paper_loop", Discretising())
    assert is_raw(BAGS / "paper_loop", Discretising(source="/pose"))
    poses = write(tmp_path / "poses", SOURCES["/robot/pose"])
    assert is_raw(poses, Discretising(), {"map": "/robot/map"})
    assert not is_raw(poses, Discretising(), {"pose": "/robot/pose"})
    # What was discretised and is so again is the same.
    before = read_demonstration(BAGS / "paper_loop")
    recorded, _ = read(
        BAGS / "paper_loop", None, source="/pose", planning_resolution=1.0, longest_jump=9.0
    )
    assert before.grid_map is not None
    assert recorded.grid_map is not None
    assert (recorded.grid_map.free == before.grid_map.free).all()
    known = place(before.recording, before.grid_map).demonstration.cells
    again = place(recorded.recording, recorded.grid_map, 8, 10.0).demonstration.cells
    assert {tuple(cell) for cell in again.tolist()} <= {tuple(cell) for cell in known.tolist()}


def test_the_command_takes_a_raw_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write(tmp_path / "bag", SOURCES["/odom"])
    few = ["--sweeps", "20", "--burn-in", "5", "--chains", "1", "--out", str(tmp_path / "out")]
    assert main(["infer", str(bag), *few]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("Discretised: 7 visits of cells of 0.5 m from 81 poses: /odom (nav_msgs")
    assert "6 observations" in out
    assert "has no map" in err
    assert main(["infer", str(bag), *few, "--map-frame", "ship"]) == 1
    _, err = capsys.readouterr()
    assert len(err.splitlines()) == 1
    assert "which tf does not join to 'ship'" in err
    with pytest.raises(SystemExit, match="2"):
        main(["infer", str(bag), "--dwell", "20"])
    assert "dwell must be below longest_silence" in capsys.readouterr().err


def test_a_start_may_be_left_of_the_maps_origin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write(tmp_path / "bag", commands())
    few = ["--sweeps", "20", "--burn-in", "5", "--chains", "1", "--out", str(tmp_path / "out")]
    assert main(["infer", str(bag), "--start", "-.6,0.6,0", *few]) == 0
    assert "followed from (-0.6, 0.6), 0 rad" in capsys.readouterr().out


def test_the_command_tells_what_is_in_a_bag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    everything = [*SOURCES["/odom"], *SOURCES["/amcl_pose"], *commands()]
    assert main(["bag", "info", str(write(tmp_path / "bag", everything))]) == 0
    _, _, *table, words, lacks = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in table] == [
        ["motion", "messages", "type", "topic"],
        ["2", "14", "geometry_msgs/msg/PoseWithCovarianceStamped", "/amcl_pose"],
        ["4", "80", "geometry_msgs/msg/Twist", "/cmd_vel"],
        ["1", "81", "nav_msgs/msg/Odometry", "/odom"],
        ["3", "17", "tf2_msgs/msg/TFMessage", "/tf"],
    ]
    assert words.startswith("bnirl infer takes motion from /odom (nav_msgs/msg/Odometry), 81 ")
    assert lacks.startswith("missing: no map: give one with `--map`")
    assert main(["bag", "info", str(BAGS / "paper_loop")]) == 0
    table = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in table[3:6]] == ["-", "-", "-"]
    assert table[-1].startswith("bnirl infer takes poses and actions from /pose and /action; the ")
    goal = [("/goal_pose", 0.0, PoseStamped(header(0.0)))]
    assert main(["bag", "info", str(write(tmp_path / "goal", goal))]) == 0
    told = capsys.readouterr().out
    assert "bnirl infer takes nothing\nmissing: no topic tells where the demonstrator was" in told
    assert main(["bag", "info", str(tmp_path / "none")]) == 1


def inferred(
    bag: str, grid_map: GridMap | None, **settings: object
) -> tuple[Summary, GridMap, str]:
    recorded, _ = read(SHARED_BAGS / bag, grid_map, **settings)
    assert recorded.grid_map is not None
    placement = place(recorded.recording, recorded.grid_map, 8, 10.0)
    assert not placement.faults
    posterior = infer(placement.demonstration, recorded.grid_map, Settings())
    return summarise(posterior, recorded.grid_map), recorded.grid_map, " ".join(recorded.warnings)


@needs_shared_bags
def test_the_turtles_waypoints_come_out_of_its_raw_commands() -> None:
    summary, _, warnings = inferred("turtle_waypoints", None, start="3.9,5.4,0")
    found = score(summary)
    assert found.found == 6
    assert found.in_order
    assert len(summary.subgoals) <= 9
    assert "names rosbag2_2025_09_30-22_35_34_0.mcap, which is not there" in warnings


@needs_shared_bags
def test_a_turtlebots_odometry_and_localisation_tell_the_same() -> None:
    depot = load_map(SHARED_BAGS.parent / "maps" / "depot.yaml")
    driven = read(SHARED_BAGS / "nav2_turtlebot", depot, source="/amcl_pose")[0].recording
    cells = []
    for source in ("/odom", "/amcl_pose"):
        summary, planning, _ = inferred("nav2_turtlebot", depot, source=source)
        goals = np.array([subgoal.cell for subgoal in summary.subgoals])
        assert planning.is_free(goals).all()
        path = planning.cells_of(driven.positions)
        assert (np.abs(goals[:, None] - path).max(axis=2).min(axis=1) <= 1).all()
        cells.append(goals)
    apart = np.abs(cells[0][:, None] - cells[1]).max(axis=2)
    assert apart.min(axis=1).max() <= 1
    assert apart.min(axis=0).max() <= 1
