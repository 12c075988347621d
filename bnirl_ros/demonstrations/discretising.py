"""The settings by which raw motion becomes observations: for the command line and the node."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bnirl_ros.errors import InputError
from bnirl_ros.limits import check, setting


@dataclass(frozen=True)
class Discretising:
    """How raw motion is taken and put on the planning map.

    Raises:
        InputError: a value is out of its range; the sentence names it.
    """

    planning_resolution: float = setting(
        0.5,
        "edge of the planning map's cells [m]; a map with larger cells stays as it is",
        above=0,
    )
    # That of a TurtleBot, and of Nav2's example configuration.
    robot_radius: float = setting(
        0.22, "the planning map keeps free what a disc of this radius can pass [m]", lowest=0.0
    )
    dwell: float = setting(4.0, "standing longer than this is a stay, each time [s]", above=0.0)
    longest_silence: float = setting(
        10.0, "longest time between two poses of one episode [s]", above=0.0
    )
    longest_jump: float = setting(
        2.0, "longest way between two poses of one episode, if not three cells [m]", above=0.0
    )
    command_hold: float = setting(
        1.0, "how long a velocity command holds when no other comes [s]", above=0.0
    )
    source: str = setting(
        "",
        "topic of the motion: odometry, poses with or without covariance, tf, or velocity "
        "commands; empty: the first of these kinds that can be used",
    )
    intent: str = setting(
        "",
        "topic of velocity commands that tell where the robot was bound for while it was held up; "
        "empty: none",
    )
    map_frame: str = setting("", "frame of the map; empty: the one that the map names")
    base_frame: str = setting("base_link", "frame of the robot, whose way in tf is followed")
    start: str = setting(
        "", "pose x,y,heading [m,m,rad] from which velocity commands alone are followed"
    )

    def __post_init__(self) -> None:
        check(self)
        if self.dwell >= self.longest_silence:
            raise InputError(
                f"dwell must be below longest_silence, {self.longest_silence:g} s, "
                f"not {self.dwell:g}"
            )
        if self.start:
            _ = self.start_pose

    @property
    def start_pose(self) -> tuple[float, float, float]:
        """The start (x, y, heading) [m, m, rad].

        Raises:
            InputError: it is not three finite numbers.
        """
        try:
            x, y, heading = (float(word) for word in self.start.split(","))
        except ValueError:
            x = y = heading = math.nan
        if not all(map(math.isfinite, (x, y, heading))):
            raise InputError(f"start must be x,y,heading in m, m and rad, not {self.start!r}")
        return x, y, heading
