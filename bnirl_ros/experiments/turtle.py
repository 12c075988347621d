"""A turtlesim robot driven round six waypoints, as a demonstration on a map.

The recording holds nothing but the commands, so the drive is integrated again as turtlesim does.
In the first lap each waypoint is passed within 0.46 m and in the author's order. What is off has
gathered since the start, for when the simulator's ticks fell is not in the recording.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.bags.cdr import decode
from bnirl_ros.bags.qos import RELIABLE
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.motion import fill_jumps
from bnirl_ros.demonstrations.raw_messages import Command
from bnirl_ros.demonstrations.velocity import CommandFollower, follow
from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import STEPS

TOPIC = "/turtlesim1/turtle1/cmd_vel"
TYPE = "geometry_msgs/msg/Twist"

WAYPOINTS = ((3.9, 5.4), (1.4, 1.6), (2.2, 9.4), (7.2, 6.1), (4.0, 2.6), (8.2, 1.5))
"""What the author had the robot driven to, in that order and round again: (x, y) [m]."""

START = (*WAYPOINTS[0], 0.0)
"""Pose of the robot before the first command: x, y and heading [m, m, rad]."""

SIDE = 11.09
"""Edge of the square that the robot cannot leave [m]."""

HOLD = 1.0
"""How long turtlesim follows a command when no other comes [s]."""

STEP = 0.5
"""Time between two poses in the bag [s], our choice: at the robot's own pace each of its halts, of
2 s and more, would end an episode."""

_NOTICE = """\
This bag was converted from a recording of a turtlesim robot that its author, a student, had driven
round six waypoints in September 2025. The recording names neither its author nor a copyright
holder. {}

The recording is under the Apache License 2.0, and so is this bag:

"""

NOTICE = _NOTICE.format(
    """\
Its commands (geometry_msgs/Twist) were integrated to a drive, the drive was put on a grid,
and the changes of cell became poses and actions; the map is the open square of turtlesim."""
)
"""What goes before the licence of the recording: whose it is, and what was changed."""

COMMANDS_NOTICE = _NOTICE.format(
    """\
All its commands (geometry_msgs/Twist) are here, byte for byte, with the times at which
they were recorded; what was written anew is the file around them."""
)
"""The same for a bag of the commands themselves."""


def read_turtle(folder: Path, resolution: float = 0.5) -> tuple[Demonstration, GridMap]:
    """The demonstration in the recording of the robot's commands, and its map.

    The map is the open square with the frame `map`. There is one observation for each change of
    cell, none for standing still, and the cell after the last one is the last pose.

    Args:
        folder: the recording, a rosbag2 folder.
        resolution: edge of a cell, above 0 [m].

    Raises:
        InputError: the recording is missing, damaged or another one, or the robot stays in a cell.
    """
    _, positions = drive(*read_commands(folder))
    # One more than fit in whole, as the square's far edges belong to it.
    size = int(SIDE / resolution) + 1
    grid_map = GridMap(np.ones((size, size), dtype=bool), resolution)
    path = fill_jumps(grid_map.cells_of(positions))
    steps = np.diff(path, axis=0)
    if not len(steps):
        raise InputError(
            f"{folder}: the robot never leaves a cell of {resolution} m; take smaller cells"
        )
    demonstration = Demonstration(
        episode=np.zeros(len(steps), dtype=np.int64),
        cells=path[:-1],
        action=(steps[:, None] == STEPS).all(axis=2).argmax(axis=1),
        last_episode=np.zeros(1, dtype=np.int64),
        last_cells=path[-1:],
    )
    return demonstration, grid_map


def read_commands(folder: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """When each command was recorded, (N,) [s] from the first, and the commands (N, 3).

    A command is the velocities forwards and to the left [m/s] and the turning rate [rad/s].

    Raises:
        InputError: the recording is missing, damaged or another one.
    """
    bag = Bag(folder)
    if TYPE not in [topic.type_name for topic in bag.topics() if topic.name == TOPIC]:
        raise InputError(f"{folder}: has no topic {TOPIC} ({TYPE}); name the turtle's recording")
    stamps, commands = [], []
    for raw in bag.messages([TOPIC]):
        try:
            twist: Any = decode(TYPE, raw.data)
        except InputError as error:
            raise InputError(f"{folder}: {error}") from None
        stamps.append(raw.log_time)
        commands.append((twist.linear.x, twist.linear.y, twist.angular.z))
    if bag.damage is not None:
        raise InputError(f"{bag.damage}; name the whole recording")
    if not np.isfinite(commands).all() or not commands:
        raise InputError(f"{folder}: has no commands, or not all are numbers; record it again")
    return (np.array(stamps) - stamps[0]) / 1e9, np.array(commands, dtype=np.float64)


def copy_commands(folder: Path, bag: Path) -> None:
    """Write the recorded commands as they are, each with its log time, into another bag.

    Args:
        folder: the recording, a rosbag2 folder.
        bag: the folder to write, whose name is the bag's; what is there as a bag is replaced.

    Raises:
        InputError: the recording is missing, damaged or another one, or the bag cannot be written.
    """
    read_commands(folder)  # refuses what is none of the turtle's
    with BagWriter(bag, overwrite=True) as writer:
        writer.add_topic(TOPIC, TYPE, RELIABLE)
        for raw in Bag(folder).messages([TOPIC]):
            writer.write_encoded(TOPIC, raw.data, raw.log_time)


def drive(
    times: npt.NDArray[np.float64],
    commands: npt.NDArray[np.float64],
    start: tuple[float, float, float] = START,
    side: float = SIDE,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Where commands lead in turtlesim: times (M,) [s], and positions (M, 2) [m].

    As `CommandFollower` has it; at the edges of the square the robot slides along.

    Args:
        times: (N,) when each command comes, ascending [s].
        commands: (N, 3) velocities forwards and to the left [m/s], turning rate [rad/s].
        start: x, y and heading at the first command [m, m, rad].
        side: edge of the square, from (0, 0) [m].
    """
    stamps = np.rint(times * 1e9).astype(np.int64).tolist()
    heard = zip(stamps, (Command(*each) for each in commands.tolist()), strict=True)
    poses = np.array(follow(heard, CommandFollower(start, HOLD, side=side)))
    return poses[:, 0] / 1e9, poses[:, 1:3]
