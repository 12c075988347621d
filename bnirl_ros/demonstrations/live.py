"""What a robot publishes, message by message as it comes, put on a planning map."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.frames import frame_name
from bnirl_ros.demonstrations.motion import Discretiser, Visit
from bnirl_ros.demonstrations.planning import on_opened, open_space_round, planning_map
from bnirl_ros.demonstrations.raw_messages import Command, RawPose
from bnirl_ros.demonstrations.velocity import CommandFollower, FollowedPose
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.maps.occupancy import check_geometry

_Step = Callable[[], list[Visit]]
"""What a message does as soon as there is a map: it may tell of visits."""


class News(NamedTuple):
    """What is to be published after a message, in this order.

    Attributes:
        grid_map: the planning map, where it is a new one or cells of it were opened; else None.
        visits: each to be told as the action that led to it, if any, and then as its pose.
        warnings: sentences on the planning map, to be logged.
    """

    grid_map: GridMap | None = None
    visits: tuple[Visit, ...] = ()
    warnings: tuple[str, ...] = ()


class LiveMotion:
    """Takes in what a robot publishes as it comes, and tells what is to be published of it.

    From equal messages it makes the visits that `read_raw_demonstration` makes. What comes
    before the first map waits for it.

    Attributes:
        poses: how many poses were followed, those to which commands led among them.
        visits: how many visits they told of.
    """

    def __init__(
        self,
        settings: Discretising,
        moves: int = 8,
        open_space: float = 0.0,
        waiting_limit: int = 40_000,
    ) -> None:
        """One that has taken in nothing.

        Args:
            settings: how to put motion on a map; which topics to hear is the caller's business.
            moves: 4 or 8: which actions there are.
            open_space: without a map, take a square with this edge round the first pose, or round
                the start of commands, for free until a map comes [m]; 0: wait for one.
            waiting_limit: how many poses and commands may wait for the first map.

        Raises:
            InputError: the open space has too many cells.
        """
        resolution = settings.planning_resolution
        size = math.ceil(open_space / resolution) + 3
        check_geometry(size, size, resolution, (0.0, 0.0, 0.0), "open space")
        self.poses = self.visits = 0
        self._settings = settings
        self._moves = moves
        self._open_space = open_space
        self._waiting_limit = waiting_limit
        self._waiting: list[_Step] = []
        self._discretiser: Discretiser | None = None
        self._follower: CommandFollower | None = None
        if settings.start:
            self._follower = CommandFollower(
                settings.start_pose, settings.command_hold, settings.longest_silence
            )
        self._map: GridMap | None = None  # the robot's
        self._told_map: GridMap | None = None
        self._faults: Counter[str] = Counter()
        self._warnings: list[str] = []

    @property
    def grid_map(self) -> GridMap | None:
        """The planning map, with the cells opened so far; None before the first."""
        return self._discretiser.grid_map if self._discretiser else None

    @property
    def frame_id(self) -> str | None:
        """The frame into which poses have to be brought; None until that is known."""
        return self.grid_map.frame_id if self.grid_map else self._settings.map_frame or None

    @property
    def opened(self) -> int:
        """How many blocked cells of the planning map were opened."""
        return len(self._discretiser.opened) if self._discretiser else 0

    @property
    def waiting(self) -> int:
        """How many poses and commands wait for the first map."""
        return len(self._waiting)

    @property
    def faults(self) -> Counter[str]:
        """How often each fault occurred among maps, poses and commands."""
        parts = (self._discretiser, self._follower)
        return sum((part.faults for part in parts if part), Counter(self._faults))

    def take_map(self, grid_map: GridMap) -> News:
        """Take in the robot's map: the first one, a new one, or the same again.

        One in which the robot fits nowhere is counted, and not used.
        """
        if self._map and grid_map.is_same_as(self._map):
            return News()
        try:
            planning, warning = planning_map(grid_map, self._settings, self.grid_map)
        except InputError as error:
            self._faults[str(error)] += 1
            return News(warnings=(str(error),))
        self._map = grid_map
        self._warnings += [warning] if warning else []
        return self._use(planning)

    def take_pose(self, pose: RawPose) -> News:
        """Take in a pose of the robot, in `frame_id`; in another frame it is only counted."""
        here = FollowedPose(pose.stamp, *pose.position[:2], pose.heading)
        return self._take(lambda: self._follow([here], pose.frame_id), here, pose.frame_id)

    def take_intent(self, command: Command) -> News:
        """Take in a velocity command that tells where the robot is bound for, beside its poses."""
        return self._take(lambda: self._hear(command))

    def take_command(self, stamp: int, command: Command) -> News:
        """Take in a velocity command where commands alone tell of motion, from `settings.start`.

        Args:
            stamp: when it comes [ns].
            command: to be followed.

        Raises:
            InputError: the settings have no start.
        """
        follower = self._follower
        if follower is None:
            raise InputError(
                "velocity commands tell no place; give the pose x,y,heading from which they are "
                "followed as start"
            )
        start = FollowedPose(stamp, *self._settings.start_pose)
        return self._take(lambda: self._follow(follower.hear(stamp, command)), start)

    def advance(self, stamp: int) -> News:
        """Follow commands up to a moment [ns] before which no command came but those taken in."""
        if self._follower is None or self._discretiser is None:
            return News()
        return self._tell(self._follow(self._follower.advance(stamp)))

    def clock_jumped_back(self) -> News:
        """What comes from now on is another episode, and commands begin anew at the start."""
        return self._take(self._begin_anew)

    def _take(self, step: _Step, here: FollowedPose | None = None, frame_id: str = "") -> News:
        """Do what is to be done on a map: now, or when there is one.

        Args:
            step: what is to be done.
            here: where the robot is, if the message tells.
            frame_id: in which frame; empty: the map's.
        """
        if self._discretiser:
            return self._tell(step())
        if len(self._waiting) >= self._waiting_limit:
            self._faults["pose or command before the first map, when the buffer was full"] += 1
            return News()
        self._waiting.append(step)
        if here and self._open_space and all(map(math.isfinite, here)):
            frame = self.frame_id or frame_name(frame_id) or "map"
            if frame_name(frame_id) in ("", frame_name(frame)):
                return self._open(here, frame)
        return News()

    def _open(self, here: FollowedPose, frame_id: str) -> News:
        """Take the robot's surroundings for free."""
        half = self._open_space / 2
        corners = np.array([[here.x - half, here.y - half], [here.x + half, here.y + half]])
        resolution = self._settings.planning_resolution
        try:
            return self._use(open_space_round(corners, resolution, frame_id, "open space"))
        except InputError as error:
            self._faults[str(error)] += 1
            return News()

    def _use(self, planning: GridMap) -> News:
        """Go on over a planning map, with what waited for the first one."""
        if self._discretiser:
            self._discretiser.use_map(planning)
        else:
            self._discretiser = Discretiser(planning, self._settings, self._moves)
        waiting, self._waiting = self._waiting, []
        return self._tell([visit for step in waiting for visit in step()])

    def _tell(self, visits: list[Visit]) -> News:
        """These visits, and what else has come up since the last news."""
        grid_map = self.grid_map if self.grid_map is not self._told_map else None
        self._told_map = self.grid_map
        warnings, self._warnings = tuple(self._warnings), []
        self.visits += len(visits)
        return News(grid_map, tuple(visits), warnings)

    def _follow(self, poses: Iterable[FollowedPose], frame_id: str = "") -> list[Visit]:
        """The visits that poses tell of, in a frame or in the map's."""
        assert self._discretiser
        here = self._discretiser.grid_map.frame_id
        visits = []
        for pose in poses:
            if frame_id and frame_name(frame_id) != frame_name(here):
                self._faults[
                    f"pose in frame {frame_id!r}, which was not brought to the map's, {here!r}"
                ] += 1
                continue
            opened = self.opened
            visits += self._discretiser.follow(*pose)
            self.poses += 1
            if self._map and self.opened > opened:
                at = np.array([[pose.x, pose.y]])
                new = self._discretiser.opened[opened:]
                self._warnings.append(on_opened(new, self._discretiser.grid_map, at, self._map))
        return visits

    def _hear(self, command: Command) -> list[Visit]:
        assert self._discretiser
        self._discretiser.hear(command.forwards, command.left)
        return []

    def _begin_anew(self) -> list[Visit]:
        assert self._discretiser
        self._discretiser.begin_episode()
        if self._follower:
            self._follower.restart()
        return []
