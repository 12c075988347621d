"""What was received of a demonstration, in metres and seconds, before it is put on a grid."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass
from threading import Lock

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.pairing import pair_by_stamp
from bnirl_ros.mdp.actions import action_of_step

_TOO_MANY = "oldest pose or action, where there are more than are kept"


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses and actions as they came, each in the order of its own topic.

    Attributes:
        pose_stamps: (P,) int64 [ns].
        positions: (P, 2) float64 [m] in the pose's frame.
        pose_frames: (P,) int64 index into `frames`.
        frames: the frames that occur.
        action_stamps: (Q,) int64 [ns].
        actions: (Q,) int64 index into `ACTION_NAMES`.
        forgotten: how many poses, and actions, came before these and were forgotten.
    """

    pose_stamps: npt.NDArray[np.int64]
    positions: npt.NDArray[np.float64]
    pose_frames: npt.NDArray[np.int64]
    frames: tuple[str, ...]
    action_stamps: npt.NDArray[np.int64]
    actions: npt.NDArray[np.int64]
    forgotten: tuple[int, int] = (0, 0)

    @property
    def messages(self) -> int:
        """Number of poses and actions, those that were forgotten among them."""
        return len(self.pose_stamps) + len(self.actions) + sum(self.forgotten)


class Recorder:
    """Takes in poses and actions, as cheaply as a callback must, and counts what is no use.

    One thread may add while another takes snapshots.

    Attributes:
        faults: how often each fault occurred among the messages that were refused or forgotten.
    """

    def __init__(self, waiting_limit: int = 40_000, limit: int | None = None) -> None:
        """Nothing has come yet.

        Args:
            waiting_limit: how many poses, and actions, may wait for the first map.
            limit: how many poses, and actions, are kept: of more the oldest eighth is forgotten,
                poses with their actions. None for no limit.
        """
        self._waiting_limit, self._limit = waiting_limit, limit
        self._lock = Lock()
        self._waiting = True
        self.clear()

    def clear(self) -> None:
        """Forget all poses, actions and faults."""
        with self._lock:
            self.faults: Counter[str] = Counter()
            self._frames: dict[str, int] = {}
            self._pose_stamps = array("q")
            self._positions = array("d")
            self._pose_frames = array("q")
            self._action_stamps = array("q")
            self._actions = array("q")
            self._forgotten = self._drained = 0, 0  # poses and actions

    def map_arrived(self) -> None:
        """There is a map now: nothing has to wait for one any more."""
        self._waiting = False

    def add_pose(self, stamp: int, frame_id: str, x: float, y: float) -> str | None:
        """Take in a pose.

        Args:
            stamp: header stamp [ns].
            frame_id: frame of the position.
            x, y: position [m].

        Returns:
            None, or the fault for which the pose was refused; it is then in `faults`.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            return self._refuse("pose with a coordinate that is not finite")
        if self._waiting and len(self._pose_stamps) >= self._waiting_limit:
            return self._refuse("pose before the first map, when the buffer was full")
        with self._lock:
            self._pose_stamps.append(stamp)
            self._positions.extend((x, y))
            self._pose_frames.append(self._frames.setdefault(frame_id, len(self._frames)))
            self._forget_what_is_too_old()
        return None

    def add_action(self, stamp: int, dx: float, dy: float) -> str | None:
        """Take in an action: the unit step (dx, dy) chosen in the pose of the same stamp [ns].

        Returns:
            None, or the fault for which the action was refused; it is then in `faults`.
        """
        action = action_of_step(dx, dy)
        if action is None:
            return self._refuse("action that is no unit step")
        if self._waiting and len(self._action_stamps) >= self._waiting_limit:
            return self._refuse("action before the first map, when the buffer was full")
        with self._lock:
            self._action_stamps.append(stamp)
            self._actions.append(action)
            self._forget_what_is_too_old()
        return None

    def restore(self, recording: Recording) -> None:
        """Take in at once what was recorded before, waiting for a map or not; it is drained."""
        numbers = [self._frames.setdefault(name, len(self._frames)) for name in recording.frames]
        with self._lock:
            self._pose_stamps.extend(recording.pose_stamps.tolist())
            self._positions.extend(recording.positions.ravel().tolist())
            self._pose_frames.extend(numbers[frame] for frame in recording.pose_frames.tolist())
            self._action_stamps.extend(recording.action_stamps.tolist())
            self._actions.extend(recording.actions.tolist())
            self._drained = self._taken
            self._forget_what_is_too_old()

    def __len__(self) -> int:
        """Number of messages taken in, those that were forgotten among them."""
        return sum(self._taken)

    def snapshot(self) -> Recording:
        """All that was taken in so far and is not forgotten, as arrays of its own."""
        with self._lock:
            return self._since(self._forgotten)

    def drain(self) -> Recording:
        """What was taken in since the last call, for one who keeps it elsewhere."""
        with self._lock:
            new = self._since(self._drained)
            self._drained = self._taken
        return new

    @property
    def _taken(self) -> tuple[int, int]:
        """How many poses and actions were taken in."""
        poses, actions = self._forgotten
        return poses + len(self._pose_stamps), actions + len(self._actions)

    def _since(self, taken: tuple[int, int]) -> Recording:
        """What was taken in after so many poses and actions, and is not forgotten."""
        first = tuple(
            max(0, count - gone) for count, gone in zip(taken, self._forgotten, strict=True)
        )
        pose, action = first
        return Recording(
            pose_stamps=np.array(self._pose_stamps[pose:], dtype=np.int64),
            positions=np.array(self._positions[2 * pose :], dtype=np.float64).reshape(-1, 2),
            pose_frames=np.array(self._pose_frames[pose:], dtype=np.int64),
            frames=tuple(self._frames),
            action_stamps=np.array(self._action_stamps[action:], dtype=np.int64),
            actions=np.array(self._actions[action:], dtype=np.int64),
            forgotten=(self._forgotten[0] + pose, self._forgotten[1] + action),
        )

    def _forget_what_is_too_old(self) -> None:
        """Forget the oldest where there is too much: a lot at once, so that it is rare."""
        most = max(len(self._pose_stamps), len(self._actions))
        if self._limit is None or most <= self._limit:
            return
        excess = [len(each) - self._limit for each in (self._pose_stamps, self._actions)]
        poses, at_least = (each + self._limit // 8 if each > 0 else 0 for each in excess)
        paired, with_action = pair_by_stamp(
            np.array(self._pose_stamps, dtype=np.int64),
            np.array(self._action_stamps, dtype=np.int64),
        )
        # Of the actions those before the first one of any pose that is kept.
        kept = with_action[paired >= poses]
        actions = max(at_least, int(kept.min()) if len(kept) else 0)
        self.faults[_TOO_MANY] += poses + actions
        del self._pose_stamps[:poses], self._positions[: 2 * poses], self._pose_frames[:poses]
        del self._action_stamps[:actions], self._actions[:actions]
        self._forgotten = self._forgotten[0] + poses, self._forgotten[1] + actions

    def _refuse(self, fault: str) -> str:
        self.faults[fault] += 1
        return fault
