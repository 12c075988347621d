"""Velocity commands, as geometry_msgs/Twist gives them, and where they lead."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from bnirl_ros.demonstrations.raw_messages import Command

TICK = 0.016
"""Longest time between two poses of followed commands [s]: turtlesim's own step."""

_SECOND = 1_000_000_000

_TICK = round(TICK * _SECOND)

_STAND = Command(0.0, 0.0, 0.0)


class FollowedPose(NamedTuple):
    """Where commands lead: stamp [ns], x and y [m] and heading [rad]."""

    stamp: int
    x: float
    y: float
    heading: float


class CommandFollower:
    """Where velocity commands lead, command by command, live or through a recording.

    A command is followed along its exact arc until the next one, but for `hold` at most. Then the
    robot stands; but where two commands are further apart than `longest_silence`, nobody knows
    what happened in between, and there are no poses.

    There is a pose when a command comes and each `TICK` after it. So the poses are the same
    whenever `advance` is called, and even if it never is. Their stamps ascend.

    Attributes:
        faults: how often each fault occurred among the commands.
    """

    def __init__(
        self,
        start: tuple[float, float, float],
        hold: float,
        longest_silence: float = math.inf,
        side: float | None = None,
    ) -> None:
        """A follower that has heard nothing.

        Args:
            start: x, y and heading at the first command [m, m, rad], the frame of the poses.
            hold: [s].
            longest_silence: [s].
            side: edge of a square from (0, 0) along whose edges the robot slides [m]; None: open
                space.
        """
        self.faults: Counter[str] = Counter()
        self._start = start
        self._hold = round(hold * _SECOND)
        self._silence = longest_silence * _SECOND
        self._side = side
        self.restart()

    def restart(self) -> None:
        """Begin anew at the start, as when the clock jumped back; the faults stay."""
        self._command: Command | None = None
        self._from = self._at = FollowedPose(0, *self._start)  # where it came, where it led so far
        self._told = -math.inf  # stamp of the last pose that was returned

    def hear(self, stamp: int, command: Command) -> list[FollowedPose]:
        """The poses up to a command, that where it comes the last.

        One that is late, so that later poses have been returned, is followed from its own stamp
        all the same, and the next poses are after those. One that is older than the one before,
        or not finite, is counted and not followed; but one that is older by more than
        `longest_silence` belongs to a recording that begins anew, and restarts.

        Args:
            stamp: when it comes [ns].
            command: what is commanded.
        """
        if not all(map(math.isfinite, command)):
            self.faults["velocity command that is not finite"] += 1
            return []
        poses: list[FollowedPose] = []
        if self._from.stamp - stamp > self._silence:
            self.restart()
        if self._command:
            if stamp < self._from.stamp:
                self.faults["velocity command that is older than the one before"] += 1
                return []
            if stamp < self._at.stamp:
                self._at = self._from
            poses += self._go_on(min(stamp, self._from.stamp + self._hold))
            if stamp - self._from.stamp <= self._silence:
                self._command = _STAND
                poses += self._go_on(stamp)
        self._from = self._at = self._at._replace(stamp=stamp)
        self._command = command
        return self._new([*poses, self._at])

    def advance(self, stamp: int) -> list[FollowedPose]:
        """The poses up to a moment [ns] before which no command came but those heard."""
        elapsed = stamp - self._from.stamp
        if elapsed >= self._hold:
            return self.finish()
        return self._new(self._go_on(self._from.stamp + elapsed // _TICK * _TICK))

    def finish(self) -> list[FollowedPose]:
        """The poses for as long as the last command holds when no other comes."""
        return self._new(self._go_on(self._from.stamp + self._hold))

    def _go_on(self, until: int) -> list[FollowedPose]:
        """Follow the command from where it led so far, tick by tick."""
        poses = []
        while self._command and self._at.stamp < until:
            self._at = self._step(self._at, self._command, min(_TICK, until - self._at.stamp))
            poses.append(self._at)
        return poses

    def _step(self, pose: FollowedPose, command: Command, elapsed: int) -> FollowedPose:
        """Where a command leads within a time [ns]."""
        seconds = elapsed / _SECOND
        half = command.rate * seconds / 2
        # The chord of an arc: it points to where the robot is headed half-way.
        length = seconds * (math.sin(half) / half if half else 1.0)
        dx, dy = in_map_axes(command.forwards, command.left, pose.heading + half)
        x, y = pose.x + dx * length, pose.y + dy * length
        if self._side is not None:
            x, y = (min(max(each, 0.0), self._side) for each in (x, y))
        heading = math.remainder(pose.heading + 2 * half, math.tau)
        return FollowedPose(pose.stamp + elapsed, x, y, heading)

    def _new(self, poses: list[FollowedPose]) -> list[FollowedPose]:
        """Those that are later than all that were returned."""
        new = []
        for pose in poses:
            if pose.stamp > self._told:
                new.append(pose)
                self._told = pose.stamp
        return new


def follow(
    commands: Iterable[tuple[int, Command]], follower: CommandFollower
) -> list[FollowedPose]:
    """Where all of these commands lead, each with when it comes [ns], until the last one ends."""
    poses = [pose for stamp, command in commands for pose in follower.hear(stamp, command)]
    return poses + follower.finish()


def in_map_axes(forwards: float, left: float, heading: float) -> tuple[float, float]:
    """A velocity, forwards and to the left, turned by a heading [rad]."""
    cosine, sine = math.cos(heading), math.sin(heading)
    return forwards * cosine - left * sine, forwards * sine + left * cosine
