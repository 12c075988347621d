"""What the tests of the command and of the nodes share: a walk on a small map, in messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from bnirl_ros.bags.qos import LATCHED, RELIABLE
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.maps import GridMap, parse_text_grid
from bnirl_ros.mdp.actions import action_of_step
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.demonstration import action_message, pose_message
from bnirl_ros.views.messages import (
    Header,
    Message,
    OccupancyGrid,
    Point,
    Pose,
    PoseStamped,
    Time,
    Vector3,
    Vector3Stamped,
)

BAGS = Path(__file__).resolve().parents[1] / "bags"

GRID = """\
.......
.......
.......
...#...
.......
.......
.......
"""
MAP = parse_text_grid(GRID, "the tests' grid")
CORNERS = ((0, 0), (6, 0), (6, 6), (0, 6))
"""Where the demonstrator of `walk` turns: its subgoals."""

OBSERVATIONS_OF_WALK = 24

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND

TopicMessage = tuple[str, Message, int]
"""Name of the topic, message, and log time [ns]."""


def map_of_grid(grid_map: GridMap = MAP, stamp: int = START) -> TopicMessage:
    """The map, as a message."""
    return "map", map_message(grid_map, stamp), stamp


def walk(rounds: int = 1, grid_map: GridMap = MAP, start: int = START) -> list[TopicMessage]:
    """Rounds along the corners and back to the first, each an episode with a last pose."""
    messages: list[TopicMessage] = []
    for number in range(rounds):
        stamp = start + number * 100 * SECOND
        cell = np.array(CORNERS[0])
        for corner in (*CORNERS[1:], CORNERS[0]):
            while (step := np.sign(np.array(corner) - cell)).any():
                here = (int(cell[0]), int(cell[1]))
                action = action_of_step(float(step[0]), float(step[1]))
                assert action is not None
                messages.append(("pose", pose_message(grid_map, here, stamp), stamp))
                messages.append(("action", action_message(action, stamp, "map"), stamp))
                cell, stamp = cell + step, stamp + SECOND // 2
        messages.append(("pose", pose_message(grid_map, CORNERS[0], stamp), stamp))
    return messages


def pose_at(x: float, y: float, stamp: int, frame_id: str = "map") -> TopicMessage:
    """A pose at (x, y) [m]."""
    header = Header(Time(*divmod(stamp, SECOND)), frame_id)
    return "pose", PoseStamped(header, Pose(Point(x, y))), stamp


def action_of(dx: float, dy: float, stamp: int) -> TopicMessage:
    """An action (dx, dy), unit step or not."""
    return (
        "action",
        Vector3Stamped(Header(Time(*divmod(stamp, SECOND)), "map"), Vector3(dx, dy)),
        stamp,
    )


def bad_messages(start: int) -> dict[str, list[TopicMessage]]:
    """Messages that cannot be used, by the one fault that each makes; 100 s lie between them."""

    def at(number: int) -> int:
        return start + number * 100 * SECOND

    return {
        "pose with a coordinate that is not finite": [
            pose_at(float("nan"), 0.5, at(0)),
            pose_at(0.5, float("inf"), at(0)),
        ],
        "pose in another frame than the map": [pose_at(0.5, 0.5, at(1), "odom")],
        "pose outside the map": [pose_at(99.5, 0.5, at(2)), action_of(1.0, 0.0, at(2))],
        "pose in a blocked cell": [pose_at(3.5, 3.5, at(3)), action_of(1.0, 0.0, at(3))],
        "action that is no unit step": [action_of(0.5, 0.0, at(4)), action_of(2.0, 0.0, at(4))],
        "action without a pose of its stamp": [action_of(1.0, 0.0, at(5))],
        "pose without an action of its stamp": [pose_at(0.5, 0.5, at(6))],
    }


BAD_COUNTS = {
    fault: 2 if "finite" in fault or "unit step" in fault else 1 for fault in bad_messages(START)
}
"""How often each fault occurs in `bad_messages`."""


def bad_maps() -> dict[str, OccupancyGrid]:
    """Maps that cannot be used, by words of the fault that each makes."""
    _, good, _ = map_of_grid()
    assert isinstance(good, OccupancyGrid)
    return {
        "no cell of the map is free": replace(good, data=np.full(49, 100, dtype=np.int8)),
        "0 x 0 cells": OccupancyGrid(good.header, replace(good.info, width=0, height=0)),
        "has 48 values": replace(good, data=good.data[1:]),
    }


def write_bag(
    folder: Path,
    messages: Iterable[TopicMessage],
    topics: Sequence[str] = ("map", "pose", "action"),
    prefix: str = "/",
) -> Path:
    """A bag with the topics of the contract, their names after a prefix; returns its folder."""
    with BagWriter(folder) as writer:
        for name in topics:
            qos = LATCHED if name == "map" else RELIABLE
            writer.add_topic(f"{prefix}{name}", TOPIC_TYPES[name], qos)
        for name, message, time in messages:
            writer.write(f"{prefix}{name}", message, time)
    return folder


def mcap_of(folder: Path) -> Path:
    """The one MCAP file of a bag."""
    (file,) = folder.glob("*.mcap")
    return file


def write_odd_mcap(path: Path, topic: str) -> Path:
    """An MCAP file with a message of a type that nobody knows."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("odd_msgs/msg/Odd", "ros2msg", b"float64 oddity")
        channel = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channel, START, bytes(12), START)
        writer.finish()
    return path


def bag_with_odd_topic(folder: Path) -> Path:
    """The bag of a walk, in which /odd is of a type that nobody knows; returns its folder."""
    write_bag(folder, [map_of_grid(), *walk()])
    write_odd_mcap(folder / "odd.mcap", "/odd")
    (folder / "metadata.yaml").unlink()  # it would name one of the two files
    return folder


def truncated(bag: Path, path: Path, share: float) -> Path:
    """A file with the first part of a bag's MCAP file, that is so much of it."""
    whole = mcap_of(bag).read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    return path
