"""Velocity commands, as geometry_msgs/Twist gives them, and where they lead."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import numpy.typing as npt

TICK = 0.016
"""Longest time between two poses of followed commands [s]: turtlesim's own step."""


def follow(
    times: npt.NDArray[np.float64],
    commands: npt.NDArray[np.float64],
    start: tuple[float, float, float],
    hold: float,
    side: float | None = None,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Where commands lead: times (M,) [s], no more than `TICK` apart, and poses (M, 3).

    A command holds until the next one, but for `hold` at most. It is followed along its exact arc.

    Args:
        times: (N,) when each command comes, ascending [s].
        commands: (N, 3) velocities forwards and to the left [m/s], turning rate [rad/s], as
            REP-103 has a body's axes.
        start: x, y and heading at the first command [m, m, rad], the frame of the poses.
        hold: [s].
        side: edge of a square from (0, 0) along whose edges the robot slides [m]; None: open
            space.
    """
    last = np.flatnonzero(np.diff(times, append=np.inf) > hold)
    times = np.insert(times, last + 1, times[last] + hold)
    commands = np.insert(commands, last + 1, 0.0, axis=0)

    held = np.diff(times)
    parts = np.maximum(np.ceil(held / TICK), 1).astype(np.int64)
    duration = np.repeat(held / parts, parts)
    forwards, left, rate = np.repeat(commands[:-1], parts, axis=0).T
    turn = rate * duration
    heading = np.append(start[2], start[2] + np.cumsum(turn))
    # The chord of an arc: it points to where the robot is headed half-way.
    length = duration * np.sinc(turn / (2 * np.pi))
    steps = in_map_axes(np.column_stack([forwards, left]), heading[1:] - turn / 2)
    steps *= length[:, np.newaxis]
    if side is None:
        positions = np.cumsum(np.concatenate([[start[:2]], steps]), axis=0)
    else:
        positions = np.array(
            list(
                accumulate(
                    steps,
                    lambda at, step: np.clip(at + step, 0.0, side),
                    initial=np.array(start[:2]),
                )
            )
        )
    return (
        np.append(times[0], times[0] + np.cumsum(duration)),
        np.column_stack([positions, heading]),
    )


def in_map_axes(
    velocities: npt.NDArray[np.float64], headings: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Velocities (N, 2), forwards and to the left, turned by headings (N,) [rad]."""
    forwards, left = velocities.T
    cosine, sine = np.cos(headings), np.sin(headings)
    return np.column_stack([forwards * cosine - left * sine, forwards * sine + left * cosine])
