"""The doors: wherever something comes in that others made, with good input for each."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, fields
from io import BytesIO, StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from bnirl_ros.bags.cdr import decode, encode
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.inspection import inspect
from bnirl_ros.bags.qos import read_overrides
from bnirl_ros.demonstrations.csv_file import read_csv
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.frames import TransformBuffer
from bnirl_ros.demonstrations.live import LiveMotion
from bnirl_ros.demonstrations.messages import TOPIC_TYPES, map_of, take_action, take_pose
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.demonstrations.raw_messages import (
    COMMAND_TYPES,
    POSE_TYPES,
    TF,
    command_of,
    pose_of,
)
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.demonstration_bag import write_demonstration
from bnirl_ros.fleet.reading import Reading, read
from bnirl_ros.inference.checkpoint import checkpoint_from
from bnirl_ros.inference.running import RunningPosterior
from bnirl_ros.inference.settings import Settings
from bnirl_ros.journal.bag import open_journal
from bnirl_ros.maps import GridMap, load_features, load_map, parse_text_grid
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.demonstration import action_message, pose_message
from bnirl_ros.views.messages import (
    Header,
    Message,
    Odometry,
    Point,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from bnirl_ros.views.results import read_visits
from bnirl_ros.views.waypoint_files import read_waypoints

_GRID = """\
......
.##...
......
...#..
"""
_MAP = parse_text_grid(_GRID, "grid")
_SECOND = 1_000_000_000


@dataclass(frozen=True)
class Door:
    """Where something comes in.

    Attributes:
        name: of the door.
        seeds: good input, one at least.
        enter: takes input, in a folder of its own; raises `InputError` where it refuses it.
    """

    name: str
    seeds: tuple[bytes, ...]
    enter: Callable[[bytes, Path], object]


def doors() -> Iterator[Door]:
    """All doors; those whose good input takes a while to make come last."""
    yield from _topics()
    yield from _raw_topics()
    yield from _maps()
    yield from _demonstrations()
    yield from _results()
    yield _settings()
    yield _command_line()
    yield from _state()


def door_called(name: str) -> Door:
    """The door of that name."""
    return next(door for door in doors() if door.name == name)


# What comes over the network: the bytes of a message are what DDS takes fields of any value from.


def _topics() -> tuple[Door, ...]:
    def enter_pose(data: bytes, _: Path) -> None:
        recorder = _walked()
        take_pose(recorder, decode(TOPIC_TYPES["pose"], data))
        place(recorder.snapshot(), _MAP)

    def enter_action(data: bytes, _: Path) -> None:
        recorder = _walked()
        take_action(recorder, decode(TOPIC_TYPES["action"], data))
        place(recorder.snapshot(), _MAP)

    def enter_map(data: bytes, _: Path) -> None:
        place(_walked().snapshot(), map_of(decode(TOPIC_TYPES["map"], data), "topic map"))

    turned = GridMap(_MAP.free, 0.05, (-3.0, 2.0, 0.7), "map")
    return (
        Door("topic pose", (encode(pose_message(_MAP, (1, 0), _SECOND)),), enter_pose),
        Door("topic action", (encode(action_message(2, _SECOND, "map")),), enter_action),
        Door(
            "topic map",
            (encode(map_message(_MAP, 0)), encode(map_message(turned, _SECOND))),
            enter_map,
        ),
    )


def _walked() -> Recorder:
    recorder = Recorder()
    for number in range(3):
        recorder.add_pose(number * _SECOND, "map", number + 0.5, 0.5)
        recorder.add_action(number * _SECOND, 1.0, 0.0)
    return recorder


def _raw_topics() -> tuple[Door, ...]:
    header = Header(Time(1, 500_000_000), "map")
    pose = Pose(Point(2.0, 1.0, 0.0), Quaternion(0.0, 0.0, 0.1, 0.9))
    transform = Transform(Vector3(1.0, 2.0, 0.0), pose.orientation)
    twist = Twist(Vector3(0.2, 0.0, 0.0), Vector3(0.0, 0.0, 0.1))
    messages: dict[str, Message] = {
        "nav_msgs/msg/Odometry": Odometry(header, "base_link", PoseWithCovariance(pose)),
        "geometry_msgs/msg/PoseWithCovarianceStamped": PoseWithCovarianceStamped(
            header, PoseWithCovariance(pose)
        ),
        "geometry_msgs/msg/PoseStamped": PoseStamped(header, pose),
        TF: TFMessage([TransformStamped(header, "base_link", transform)] * 2),
        "geometry_msgs/msg/TwistStamped": TwistStamped(header, twist),
        "geometry_msgs/msg/Twist": twist,
    }

    def enter(kind: str, data: bytes) -> None:
        message: Any = decode(kind, data)
        settings = Discretising(start="0,0,0" if kind in COMMAND_TYPES else "")
        motion = LiveMotion(settings)
        motion.take_map(_ROOM)
        if kind == TF:
            buffer = TransformBuffer()
            buffer.add(message, static=False)
            buffer.add(messages[TF], static=False)
            stamps = buffer.stamps_of("base_link")
            buffer.look_up("map", "base_link", stamps)
        elif kind in COMMAND_TYPES:
            for second in (1, 2):
                motion.take_command(second * _SECOND, command_of(message))
        else:
            assert kind in POSE_TYPES
            for each in (messages[kind], message, messages[kind]):
                motion.take_pose(pose_of(each))

    def door_of(kind: str) -> Door:
        name = f"message {kind.rsplit('/', 1)[1]}"
        return Door(name, (encode(messages[kind]),), lambda data, _: enter(kind, data))

    return tuple(map(door_of, messages))


_ROOM = GridMap(np.ones((60, 60), dtype=bool), 0.1)


# Files


def _of_file(
    name: str,
    file: str,
    seeds: tuple[bytes, ...],
    enter: Callable[[Path], object],
    beside: Mapping[str, bytes] | None = None,
) -> Door:
    """A door that takes a file, with other files beside it."""

    def enter_file(data: bytes, folder: Path) -> None:
        for other, content in (beside or {}).items():
            (folder / other).write_bytes(content)
        (folder / file).write_bytes(data)
        enter(folder / file)

    return Door(name, seeds, enter_file)


def _maps() -> tuple[Door, ...]:
    def image(form: str, **options: Any) -> bytes:
        buffer = BytesIO()
        pixels = np.where(_MAP.free, 254, 0).astype(np.uint8)
        Image.fromarray(pixels).save(buffer, form, **options)
        return buffer.getvalue()

    nav2 = (
        b"image: map.png\nresolution: 0.05\norigin: [-1.5, 2.0, 0.3]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.25\nmode: trinary\n"
    )
    labels = b"image: map.png\nresolution: 1.0\norigin: [0, 0, 0]\nnames: {254: room, 0: wall}\n"
    places = b"places:\n  door: [1.5, 0.5]\n  desk: [4, 3]\nstep: 0.5\n"
    images = {"map.png": image("PNG")}

    def layer(path: Path) -> None:
        load_features(path).features_of(_MAP)

    return (
        _of_file("map YAML", "map.yaml", (nav2,), load_map, images),
        *(
            _of_file(
                f"map image {form}",
                f"map.{form.lower()}",
                (image(form),),
                lambda path: load_map(path.with_name("map.yaml")),
                {"map.yaml": nav2.replace(b"map.png", f"map.{form.lower()}".encode())},
            )
            for form in ("PNG", "PPM", "BMP")
        ),
        _of_file("text grid", "map.txt", (_GRID.encode(),), load_map),
        _of_file("features YAML", "features.yaml", (labels, places), layer, images),
        _of_file("features text", "features.txt", (b"1 1 1 2 2 2\n" * 4,), layer),
    )


def _demonstrations() -> tuple[Door, ...]:
    rows = b"episode,x,y,action\n0,0,0,E\n0,1,0,E\n0,2,0,NE\n1,5,3,S\n1,5,2,stay\n"

    def read_bag(path: Path) -> None:
        inspect(path)
        read_demonstration(path)

    def read_any_bag(path: Path) -> None:
        read(path, Reading(), lambda _: None)

    with TemporaryDirectory() as folder:
        bag = Path(folder, "bag")
        write_demonstration(bag, _DEMONSTRATION, _MAP, 0.5)
        mcap, metadata = (bag / "bag_0.mcap").read_bytes(), (bag / "metadata.yaml").read_bytes()
    overrides = b"/pose:\n  reliability: best_effort\n  depth: 7\n  history: keep_last\n"
    return (
        _of_file("CSV", "demonstration.csv", (rows,), lambda path: read_csv(path, _MAP)),
        _of_file("bag", "bag.mcap", (mcap,), read_bag),
        _of_file("bag of any kind", "bag.mcap", (mcap,), read_any_bag),
        _of_file(
            "metadata.yaml",
            "metadata.yaml",
            (metadata,),
            lambda path: read_bag(path.parent),
            {"bag_0.mcap": mcap},
        ),
        _of_file("QoS overrides", "qos.yaml", (overrides,), read_overrides),
    )


_DEMONSTRATION = Demonstration(
    episode=np.zeros(4, dtype=np.int64),
    cells=np.array([(0, 0), (1, 0), (2, 0), (3, 0)]),
    action=np.full(4, 1),
    last_episode=np.zeros(1, dtype=np.int64),
    last_cells=np.array([(4, 0)]),
)


def _results() -> tuple[Door, ...]:
    waypoints = (
        b"frame_id: map\nwaypoints:\n  waypoint0:\n    pose: [1.0, 2.0, 0.0]\n"
        b"    orientation: [1.0, 0.0, 0.0, 0.0]\n"
    )
    subgoal = {
        "rank": 1,
        "cell": [1, 2],
        "position": [1.5, 2.5],
        "probability": 0.9,
        "observations": 10,
        "visit_order": [1],
        "pursuits": 1.0,
    }
    document = {
        "format": 1,
        "frame_id": "map",
        "resolution": 1.0,
        "subgoals": [subgoal, {**subgoal, "rank": 2, "cell": None, "cells": [[3, 3]]}],
        "visit_sequence": [1, 2],
        "repetitions": 0,
    }
    return (
        _of_file("waypoints.yaml", "waypoints.yaml", (waypoints,), read_waypoints),
        _of_file("subgoals.json", "subgoals.json", (json.dumps(document).encode(),), read_visits),
    )


# What the node kept


def _state() -> tuple[Door, ...]:
    recorder = _walked()
    placement = place(recorder.snapshot(), _MAP)
    running = RunningPosterior(placement, _MAP, Settings())
    running.advance(2)
    with TemporaryDirectory() as folder:
        journal = open_journal(Path(folder)).journal
        journal.append(recorder.drain(), encode(map_message(_MAP, 0)))
        kept = next(journal.folder.glob("*.mcap")).read_bytes()
        journal.close()

    def enter_checkpoint(data: bytes, _: Path) -> None:
        RunningPosterior.resumed(checkpoint_from(data, "checkpoint"), _MAP, Settings())

    def enter_journal(data: bytes, folder: Path) -> None:
        place_of_one = folder / "journals" / "0001_night"
        place_of_one.mkdir(parents=True)
        (place_of_one / "0001_night_0.mcap").write_bytes(data)
        open_journal(folder / "journals").journal.close()

    return (
        Door("checkpoint", (running.checkpoint().to_bytes(),), enter_checkpoint),
        Door("journal", (kept,), enter_journal),
    )


# What users say


def _settings() -> Door:
    """Parameters and options: a JSON object of settings, which no value may take by surprise."""

    def enter(data: bytes, _: Path) -> None:
        try:
            given = json.loads(data)
        except (ValueError, RecursionError) as fault:
            raise InputError("no values of Python") from fault
        if not isinstance(given, dict):
            raise InputError("values have names")
        for table in (Settings, Discretising):
            names = {each.name for each in fields(table)}
            table(**{name: value for name, value in given.items() if name in names})

    defaults = {each.name: each.default for each in (*fields(Settings), *fields(Discretising))}
    shown = {
        name: value for name, value in defaults.items() if isinstance(value, int | float | str)
    }
    seeds = [
        shown,
        {"alpha": 3.0, "chains": 2, "sweeps": 5, "burn_in": 0},
        {"success": 1.0},
    ]
    return Door("settings", tuple(json.dumps(each).encode() for each in seeds), enter)


def _command_line() -> Door:
    """The words after `bnirl`, as a shell splits them; what they ask for is not done."""
    from bnirl_ros import cli

    seeds = (
        b"infer bag --map map.yaml --out out --alpha 3 --sweeps 100 --chains 2 --moves 4",
        b"infer a b --each --remap pose:=/robot/pose --success 0.9 --candidates free",
        b"bag info bag",
        b"bag repair bag --out other",
        b"predict bag --seed 3",
        b"waypoints subgoals.json --out out",
        b"reproduce 4.1 --runs 3",
    )

    def enter(data: bytes, _: Path) -> None:
        try:
            words = shlex.split(data.decode(errors="surrogateescape"))
        except ValueError as fault:
            raise InputError("no shell would split it") from fault
        said = StringIO()
        try:
            with redirect_stderr(said), redirect_stdout(said):
                cli.parser().parse_args(words)
        except SystemExit as end:
            if end.code == 2:
                raise InputError(said.getvalue()) from None
            if end.code:
                raise

    return Door("command line", seeds, enter)
