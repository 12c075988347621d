"""What was received of a demonstration, in metres and seconds, before it is put on a grid."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass
from threading import Lock

import numpy as np
import numpy.typing as npt

from bnirl_ros.mdp.actions import action_of_step


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
    """

    pose_stamps: npt.NDArray[np.int64]
    positions: npt.NDArray[np.float64]
    pose_frames: npt.NDArray[np.int64]
    frames: tuple[str, ...]
    action_stamps: npt.NDArray[np.int64]
    actions: npt.NDArray[np.int64]


class Recorder:
    """Takes in poses and actions, as cheaply as a callback must, and counts what is no use.

    One thread may add while another takes snapshots.

    Attributes:
        faults: how often each fault occurred among the messages that were refused.
    """

    def __init__(self, waiting_limit: int = 40_000) -> None:
        """`waiting_limit`: how many poses, and actions, may wait for the first map."""
        self._waiting_limit = waiting_limit
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
            self._drained = 0, 0  # poses and actions

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
            self._drained = len(self._pose_stamps), len(self._actions)

    def __len__(self) -> int:
        """Number of messages taken in."""
        return len(self._pose_stamps) + len(self._action_stamps)

    def snapshot(self) -> Recording:
        """All that was taken in so far, as arrays of its own."""
        with self._lock:
            return self._since(0, 0)

    def drain(self) -> Recording:
        """What was taken in since the last call, for one who keeps it elsewhere."""
        with self._lock:
            new = self._since(*self._drained)
            self._drained = len(self._pose_stamps), len(self._actions)
        return new

    def _since(self, pose: int, action: int) -> Recording:
        """What was taken in from a pose and an action on, by their numbers."""
        return Recording(
            pose_stamps=np.array(self._pose_stamps[pose:], dtype=np.int64),
            positions=np.array(self._positions[2 * pose :], dtype=np.float64).reshape(-1, 2),
            pose_frames=np.array(self._pose_frames[pose:], dtype=np.int64),
            frames=tuple(self._frames),
            action_stamps=np.array(self._action_stamps[action:], dtype=np.int64),
            actions=np.array(self._actions[action:], dtype=np.int64),
        )

    def _refuse(self, fault: str) -> str:
        self.faults[fault] += 1
        return fault
