"""Poses and actions of a recording as the bytes in which bags carry them, many at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.bags.cdr import encode
from bnirl_ros.demonstrations.recording import Recording
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.views.messages import Message, PoseStamped, Vector3Stamped
from bnirl_ros.views.stamped import header_of

_STAMP = slice(4, 12)  # where a stamped message has its stamp, behind the encapsulation header
_SECOND = 1_000_000_000


def encoded_poses(recording: Recording) -> list[bytes]:
    """A geometry_msgs/PoseStamped in CDR for each pose, without rotation."""
    messages = np.empty(len(recording.pose_stamps), dtype=object)
    for number, frame in enumerate(recording.frames):
        chosen = np.flatnonzero(recording.pose_frames == number)
        message = PoseStamped(header=header_of(frame, 0))
        message.pose.orientation.w = 1.0
        # Position and orientation come last: seven numbers.
        messages[chosen] = _filled(
            message, recording.pose_stamps[chosen], recording.positions[chosen], 7
        )
    return list(messages)


def encoded_actions(recording: Recording) -> list[bytes]:
    """A geometry_msgs/Vector3Stamped in CDR for each action, in the frame of the last pose."""
    frame = recording.frames[-1] if recording.frames else ""
    message = Vector3Stamped(header=header_of(frame, 0))
    steps = np.array(STEPS, dtype=np.float64).reshape(-1, 2)[recording.actions]
    return list(_filled(message, recording.action_stamps, steps, 3))


def _filled(
    message: Message,
    stamps: npt.NDArray[np.int64],
    numbers: npt.NDArray[np.float64],
    width: int,
) -> npt.NDArray[np.object_]:
    """(n,) the message's bytes with other stamps (n,) [ns] and the numbers (n, 2).

    The numbers are the first two of the `width` float64 with which the message ends.
    """
    template = np.frombuffer(encode(message), dtype=np.uint8)
    rows = np.tile(template, (len(stamps), 1))
    seconds, nanoseconds = np.divmod(stamps, _SECOND)
    both = np.column_stack([seconds.astype("<i4"), nanoseconds.astype("<u4").view("<i4")])
    rows[:, _STAMP] = np.ascontiguousarray(both).view(np.uint8)
    first = rows.shape[1] - 8 * width
    rows[:, first : first + 16] = np.ascontiguousarray(numbers, dtype="<f8").view(np.uint8)
    filled = np.empty(len(rows), dtype=object)
    filled[:] = [row.tobytes() for row in rows]
    return filled
