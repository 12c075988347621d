"""Putting a recording on a map: pose and action paired, episodes told apart, misfits counted."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.pairing import pair_by_stamp
from bnirl_ros.demonstrations.recording import Recording
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES, ACTION_SETS

EPISODE_GAP = 2.0
"""Default time between two poses [s] beyond which a new episode begins."""


@dataclass(frozen=True, eq=False)
class Placement:
    """A demonstration on a map, and what of the recording did not fit.

    Attributes:
        demonstration: its N observations.
        poses: (N,) number of the pose of each observation, counted with those that the recording
            has forgotten: that tells which observations are the same in a later placement.
        last_poses: (L,) the same of each last pose without an action.
        messages: number of poses and actions that the recording had, forgotten ones included.
        faults: what did not fit, counted by fault.
    """

    demonstration: Demonstration
    poses: npt.NDArray[np.int64]
    last_poses: npt.NDArray[np.int64]
    messages: int
    faults: Counter[str]


def place(
    recording: Recording, grid_map: GridMap, moves: int = 8, episode_gap: float = EPISODE_GAP
) -> Placement:
    """The demonstration that a recording is on a map.

    Live and offline alike, and the same however the two topics were interleaved. Episodes without
    any observation are left out; the others are numbered from 0 in the order of their poses.

    Args:
        recording: poses and actions.
        grid_map: the map; poses in another frame than its own don't count.
        moves: 4 or 8; actions outside that set don't count.
        episode_gap: longest time between two poses of an episode [s].
    """
    faults: Counter[str] = Counter()

    def count(fault: str, where: npt.NDArray[np.bool_]) -> None:
        if where.any():
            faults[fault] += int(np.count_nonzero(where))

    same_frame = np.array([frame == grid_map.frame_id for frame in recording.frames], dtype=bool)
    in_frame = (
        same_frame[recording.pose_frames] if recording.frames else np.zeros(0, dtype=np.bool_)
    )
    count("pose in another frame than the map", ~in_frame)
    stamps = recording.pose_stamps[in_frame]
    cells = grid_map.cells_of(recording.positions[in_frame])
    episode = np.cumsum(episode_starts(stamps, cells, episode_gap))
    last_of_episode = np.append(np.diff(episode) > 0, np.ones(min(len(episode), 1), dtype=bool))

    poses, paired_actions = pair_by_stamp(stamps, recording.action_stamps)
    action = np.full(len(stamps), -1, dtype=np.int64)
    action[poses] = recording.actions[paired_actions]
    paired = action >= 0
    without_pose = np.ones(len(recording.actions), dtype=bool)
    without_pose[paired_actions] = False
    count("action without a pose of its stamp", without_pose)

    on_map = grid_map.contains(cells)
    free = grid_map.is_free(cells)
    is_move = np.zeros(len(ACTION_NAMES) + 1, dtype=np.bool_)  # the last one is for none, -1
    is_move[list(ACTION_SETS[moves])] = True
    possible = is_move[action]
    observed = paired & free & possible
    # By tables instead of sets: this is done whenever a message comes.
    is_told = np.zeros(len(episode) + 1, dtype=np.bool_)
    is_told[episode[observed]] = True
    number = np.cumsum(is_told) - 1
    last_pose = last_of_episode & ~paired & is_told[episode]
    count("pose outside the map", ~on_map)
    count("pose in a blocked cell", on_map & ~free)
    count("pose without an action of its stamp", ~paired & ~last_pose)
    count(f"action that is none of the {moves} moves", paired & ~possible)

    kept = last_pose & free
    numbers_of_poses = np.flatnonzero(in_frame) + recording.forgotten[0]
    demonstration = Demonstration(
        episode=number[episode[observed]],
        cells=cells[observed],
        action=action[observed],
        last_episode=number[episode[kept]],
        last_cells=cells[kept],
    )
    return Placement(
        demonstration=demonstration,
        poses=numbers_of_poses[observed],
        last_poses=numbers_of_poses[kept],
        messages=recording.messages,
        faults=faults,
    )


def episode_starts(
    stamps: npt.NDArray[np.int64], cells: npt.NDArray[np.int64], episode_gap: float
) -> npt.NDArray[np.bool_]:
    """Which poses begin an episode: the only place where that is decided.

    An episode ends where the stamps of consecutive poses are more than `episode_gap` apart or go
    backwards, or where their cells are no neighbours.

    Args:
        stamps: (P,) stamps in the order in which the poses came [ns].
        cells: (P, 2) cells; outside the map they count too.
        episode_gap: [s].
    """
    elapsed = np.diff(stamps)
    steps = np.diff(cells, axis=0)
    apart = (np.abs(steps[:, 0]) > 1) | (np.abs(steps[:, 1]) > 1)
    ends = (elapsed < 0) | (elapsed > episode_gap * 1e9) | apart
    return np.concatenate([np.ones(min(len(stamps), 1), dtype=bool), ends])
