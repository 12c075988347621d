"""From motion in metres to visits of cells and the actions that lead from one to the next."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.placement import episode_starts
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.demonstrations.velocity import in_map_axes
from bnirl_ros.maps.coarsening import with_free
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import ACTION_SETS, STEPS, action_of_step

_SECOND = 1_000_000_000

_MARGIN = 0.2
"""How far beyond a cell's edge the robot still counts as in it [cells]: one that stands on an edge
must not seem to go to and fro as its localisation trembles, nor one that cuts a corner to turn."""

_SETTLING = _SECOND
"""How long it may be out of the cell and so near, before it is in the next one [ns]."""

_STILL = 0.5
"""How far a robot that stands may be from where it stood first [cells]."""

_STAY = 0

_Cell = tuple[int, int]


@dataclass(frozen=True)
class Visit:
    """The demonstrator comes into a cell, or decides in it once more.

    Attributes:
        stamp: when it begins [ns].
        cell: (x, y) on the planning map.
        position: (x, y) of the cell's centre in that map's frame [m].
        led_by: stamp [ns] of the visit before, and the index of the action chosen in it, which
            led here; None where an episode begins.
    """

    stamp: int
    cell: _Cell
    position: tuple[float, float]
    led_by: tuple[int, int] | None


class _Pose(NamedTuple):
    """A pose: stamp [ns], position [m], heading [rad], position along the planning map [cells]."""

    stamp: int
    x: float
    y: float
    heading: float
    along: tuple[float, float]


class Discretiser:
    """Follows a demonstrator pose by pose, live or through a recording, over a planning map.

    Consecutive visits of an episode are in the same or in neighbouring cells, no further apart in
    time than `longest_silence`, and the action leads from the one to the other, past no blocked
    corner; only an intent that was held up leads nowhere. Cells that are visited though blocked
    are opened, for the demonstrator was there. An episode begins when the demonstrator first
    moves, or is held up: that it stood before tells when recording began, not what it wanted.

    Attributes:
        grid_map: the planning map, with the cells opened so far.
        opened: these cells, in the order of opening.
        faults: how often each fault occurred among the poses.
    """

    def __init__(self, grid_map: GridMap, settings: Discretising, moves: int = 8) -> None:
        """A discretiser that has seen nothing.

        Args:
            grid_map: the planning map.
            settings: how to put motion on it.
            moves: 4 or 8: which actions there are.
        """
        self.grid_map = self._given = grid_map
        self.opened: list[_Cell] = []
        self.faults: Counter[str] = Counter()
        self._places: dict[tuple[float, float], None] = {}  # the centres of visited cells
        self._silence = round(settings.longest_silence * _SECOND)
        self._dwell = round(settings.dwell * _SECOND)
        self._longest_jump = settings.longest_jump
        self._hold = round(settings.command_hold * _SECOND)
        self._moves = moves
        self._pose: _Pose | None = None
        self._visit: Visit | None = None
        self._told: Visit | None = None  # the last one that was returned
        self._is_over = False  # its episode, whatever comes
        self._is_waiting = False  # where an episode begins, until it moves
        self._stood_from: _Pose | None = None  # where and since when it stands, if it does
        self._out_since: int | None = None  # when it left its cell, but not far
        self._heard: list[tuple[float, float]] = []
        self._command_age = 0
        self._intended = np.zeros(2)

    def use_map(self, grid_map: GridMap) -> None:
        """Go on over another planning map, as when SLAM has extended it; the same changes nothing.

        What was visited is put on it by metres, as whoever has the visits as messages does, and
        opened where it is blocked there. The episode goes on if its last cell is on that map.
        """
        if grid_map.is_same_as(self._given):
            return
        if grid_map.frame_id != self.grid_map.frame_id:
            self._places.clear()
            self._told = None
            self.begin_episode()
        self.grid_map = self._given = grid_map
        cells = grid_map.cells_of(list(self._places))
        blocked = cells[grid_map.contains(cells) & ~grid_map.is_free(cells)]
        self.opened = list(dict.fromkeys((x, y) for x, y in blocked.tolist()))
        self.grid_map = with_free(grid_map, self.opened)
        if self._told:
            self._told = replace(self._told, cell=self._cell_at(self._told.position))
            self._is_over |= not bool(grid_map.contains([self._told.cell])[0])
        if self._visit and self._pose:
            self._visit = replace(self._visit, cell=self._cell_at(self._visit.position))
            self._pose = self._posed(*self._pose[:-1])
            if not grid_map.contains([self._visit.cell])[0]:
                self.begin_episode()

    def begin_episode(self) -> None:
        """The next pose begins an episode, whatever its stamp, as when the clock jumped back.

        So it does for whoever has the visits as messages, even where it is stamped and placed as
        if the demonstrator had gone on: its first visit is then stamped before the last one.
        """
        self._pose = self._visit = None
        self._is_over = True

    def hear(self, forwards: float, left: float) -> None:
        """Take in a velocity command, in the order in which poses and commands arrive.

        Args:
            forwards, left: velocity in the robot's axes [m/s].
        """
        if not (math.isfinite(forwards) and math.isfinite(left)):
            self.faults["velocity command that is not finite"] += 1
            return
        if self._command_age:  # the one before has been taken into account
            self._heard.clear()
        self._heard.append((forwards, left))
        self._command_age = 0

    def follow(self, stamp: int, x: float, y: float, heading: float = 0.0) -> list[Visit]:
        """The visits that a pose tells of, in their order: mostly none.

        Args:
            stamp: [ns].
            x, y: position in the map's frame [m].
            heading: in that frame [rad]; only commands need it.
        """
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(heading)):
            self.faults["pose with a coordinate that is not finite"] += 1
            return []
        before, pose = self._pose, self._posed(stamp, x, y, heading)
        if not self.grid_map.contains(self.grid_map.cells_of([[x, y]]))[0]:
            self.faults["pose outside the map"] += 1
            return []
        if before is None or self._visit is None:
            return self._begin(pose)
        if stamp < before.stamp:  # a recording that begins anew, or a message that was overtaken
            if stamp > self._visit.stamp:
                self.faults["pose that is older than the one before"] += 1
                return []
            self.begin_episode()
            return self._begin(pose)
        # Any shorter one may end in a neighbouring cell, where no new episode can be told.
        jump = max(self._longest_jump, 3 * self.grid_map.resolution)
        if stamp - before.stamp > self._silence or math.hypot(x - before.x, y - before.y) > jump:
            return self._begin(pose)
        self._pose = pose
        self._intend(before, pose)
        cell = self._cell_of(pose)
        left = cell != self._visit.cell
        visits = self._stays(before, pose, left)
        if left:
            visits += self._go(before, pose, cell)
        return visits

    def _cell_of(self, pose: _Pose) -> _Cell:
        """The cell that a pose counts for: the one that it is in, or still the last one."""
        assert self._visit is not None
        u, v = pose.along
        cell = (math.floor(u), math.floor(v))
        last = self._visit.cell
        if cell == last:
            self._out_since = None
            return last
        if self._out_since is None:
            self._out_since = pose.stamp
        low = -_MARGIN
        high = 1 + _MARGIN
        is_near = low <= u - last[0] <= high and low <= v - last[1] <= high
        return last if is_near and pose.stamp - self._out_since <= _SETTLING else cell

    def _posed(self, stamp: int, x: float, y: float, heading: float) -> _Pose:
        u, v = self.grid_map.coordinates_of([[x, y]])[0].tolist()
        return _Pose(stamp, x, y, heading, (u, v))

    def _cell_at(self, position: tuple[float, float]) -> _Cell:
        ((x, y),) = self.grid_map.cells_of([position]).tolist()
        return x, y

    def _begin(self, pose: _Pose) -> list[Visit]:
        """Begin an episode, of which is told when the demonstrator sets out."""
        self._pose = self._stood_from = pose
        u, v = pose.along
        cell = (math.floor(u), math.floor(v))
        told = self._told
        if told and not self._is_over and self._seems_to_go_on(told, pose.stamp, cell):
            # It seemed to be elsewhere for a moment, and nobody could tell this from going on.
            self._visit = told
            self._is_waiting = False
            return (
                self._go(pose._replace(stamp=told.stamp), pose, cell) if cell != told.cell else []
            )
        self._open(cell)
        self._is_waiting = True
        self._enter(pose.stamp, cell, None)
        return []

    def _seems_to_go_on(self, told: Visit, stamp: int, cell: _Cell) -> bool:
        """Whether a visit would seem to be of one episode with the last one that was told."""
        stamps, cells = np.array([told.stamp, stamp]), np.array([told.cell, cell])
        return not episode_starts(stamps, cells, self._silence / _SECOND)[1]

    def _enter(self, stamp: int, cell: _Cell, action: int | None) -> Visit:
        before = self._visit
        led_by = None if action is None or before is None else (before.stamp, action)
        x, y = self.grid_map.centres_of([cell])[0].tolist()
        self._places[x, y] = None
        self._visit = Visit(stamp, cell, (x, y), led_by)
        if not self._is_waiting:
            self._tell()
        self._out_since = None
        self._intended[:] = 0.0
        return self._visit

    def _open(self, cell: _Cell) -> None:
        if not self._is_free(cell):
            self.grid_map = with_free(self.grid_map, [cell])
            self.opened.append(cell)

    def _is_free(self, cell: _Cell) -> bool:
        return bool(self.grid_map.is_free([cell])[0])

    def _intend(self, before: _Pose, pose: _Pose) -> None:
        """Add up the way that was commanded between two poses."""
        elapsed = pose.stamp - before.stamp
        held = min(elapsed, max(self._hold - self._command_age, 0))
        self._command_age += elapsed
        if self._heard and held:
            forwards, left = np.mean(self._heard, axis=0).tolist()
            velocity = in_map_axes(forwards, left, before.heading)
            self._intended += np.array(velocity) * (held / _SECOND)
            self._heard = self._heard[-1:]

    def _stays(self, before: _Pose, pose: _Pose, left: bool) -> list[Visit]:
        """The visits in the cell of the last one up to a pose, most often none.

        Args:
            before: the pose before.
            pose: the pose.
            left: whether it is out of the cell.
        """
        assert self._visit is not None
        assert self._stood_from is not None
        stood = self._stood_from
        far = _STILL * self.grid_map.resolution
        moved = math.hypot(pose.x - stood.x, pose.y - stood.y) > far
        visits: list[Visit] = []
        if self._is_waiting and (moved or left):
            visits.append(self._set_out(before.stamp))
        since = pose.stamp if moved else stood.stamp
        while True:
            # One that creeps in its cell does not stand, but it is no new episode when it leaves.
            due = self._visit.stamp + self._silence
            if not left:
                due = min(due, max(since + self._dwell, self._visit.stamp + _SETTLING))
            if pose.stamp <= due:
                break
            action = self._held_up()
            if self._is_waiting and action != _STAY:
                visits.append(self._set_out(self._visit.stamp))
                continue
            visit = self._enter(due, self._visit.cell, None if self._is_waiting else action)
            if not self._is_waiting:
                visits.append(visit)
            since = due
        self._stood_from = (pose if moved else stood)._replace(stamp=since)
        return visits

    def _set_out(self, stamp: int) -> Visit:
        """The first visit of an episode, once the demonstrator moves or means to."""
        assert self._visit is not None
        self._is_waiting = False
        told = self._told
        if told and self._seems_to_go_on(told, stamp, self._visit.cell):
            # The clock jumped back by little, or the demonstrator stood until it had caught up.
            stamp = told.stamp - 1
        self._visit = replace(self._visit, stamp=stamp)
        return self._tell()

    def _tell(self) -> Visit:
        """The present visit, which is returned now."""
        assert self._visit is not None
        self._told, self._is_over = self._visit, False
        return self._visit

    def _held_up(self) -> int:
        """The action of one that does not get on: where it was bound for, or stay."""
        length = float(np.hypot(*self._intended))
        if length < _STILL * self.grid_map.resolution:
            return _STAY
        actions = list(ACTION_SETS[self._moves][1:])
        directions = STEPS[actions] / np.linalg.norm(STEPS[actions], axis=1, keepdims=True)
        # The map's own axes may be turned against the frame's.
        x, y = self._intended.tolist()
        along = in_map_axes(x, y, -self.grid_map.origin[2])
        return actions[int(np.argmax(directions @ along))]

    def _go(self, before: _Pose, pose: _Pose, cell: _Cell) -> list[Visit]:
        """The visits on the way from the last one to another cell, the one there the last."""
        assert self._visit is not None
        line = fill_jumps(np.array([self._visit.cell, cell])).tolist()
        self._open(cell)
        way: list[_Cell] = []
        for start, end in pairwise(line):
            sides = [(end[0], start[1]), (start[0], end[1])]
            if start[0] != end[0] and start[1] != end[1] and not self._is_diagonal_free(sides):
                sides.sort(key=lambda side: (not self._is_free(side), _off(side, before, pose)))
                if len(line) == 2:
                    self._open(sides[0])
                way.append(sides[0])
            way.append((end[0], end[1]))
        if not all(map(self._is_free, way)):
            self.faults["jump over blocked cells, where a new episode begins"] += 1
            return self._begin(pose)
        visits = []
        start_stamp = max(before.stamp, self._visit.stamp)
        for number, after in enumerate(way, start=1):
            x, y = self._visit.cell
            action = action_of_step(after[0] - x, after[1] - y)
            stamp = start_stamp + (pose.stamp - start_stamp) * number // len(way)
            visits.append(self._enter(stamp, after, action))
        return visits

    def _is_diagonal_free(self, sides: list[_Cell]) -> bool:
        """Whether a diagonal step past these side cells is among the moves and not blocked."""
        return self._moves == 8 and all(map(self._is_free, sides))


def _off(cell: _Cell, before: _Pose, after: _Pose) -> float:
    """How far the centre of a cell is off the line through two poses, times their distance."""
    (u, v), (s, t) = before.along, after.along
    return abs((s - u) * (cell[1] + 0.5 - v) - (t - v) * (cell[0] + 0.5 - u))


def record(recorder: Recorder, visit: Visit, frame_id: str) -> None:
    """Hand a visit to a recorder as the contract's pose, and the action that led to it."""
    if visit.led_by:
        stamp, action = visit.led_by
        dx, dy = STEPS[action].tolist()
        recorder.add_action(stamp, dx, dy)
    recorder.add_pose(visit.stamp, frame_id, *visit.position)


def fill_jumps(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The cells (M, 2) entered on the way through the cells (N, 2), each next to the one before.

    Cells in between are those on the straight line; a cell that repeats the one before is left
    out.
    """
    jump = np.diff(cells, axis=0)
    count = np.abs(jump).max(axis=1, initial=0)
    jump, before, length = (np.repeat(each, count, axis=0) for each in (jump, cells[:-1], count))
    ordinal = np.arange(len(length)) - np.repeat(np.cumsum(count) - count, count) + 1
    # Rounded to the nearest cell, in whole numbers.
    between = before + (2 * ordinal[:, None] * jump + length[:, None]) // (2 * length[:, None])
    return np.concatenate([cells[:1], between])
