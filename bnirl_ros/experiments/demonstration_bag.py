"""A demonstration as a bag: the topics of the contract, one episode after the other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bnirl_ros.bags.qos import LATCHED, RELIABLE
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.demonstration import action_message, pose_message

BEGINNING = 1_348_444_800_000_000_000
"""Stamp of the first message [ns]: 24 September 2012, 00:00 UTC, the first day of the conference
at which the paper was presented. A fixed date makes equal demonstrations equal bags."""

BETWEEN_EPISODES = 10.0
"""Time from the last pose of an episode to the first one of the next [s]."""

SIZE_LIMIT = 2 * 1024 * 1024
"""What a bag that comes with the package stays below [bytes]."""

_SECOND = 1_000_000_000


def write_demonstration(
    folder: Path, demonstration: Demonstration, grid_map: GridMap, step: float
) -> None:
    """Write a demonstration on a map as a rosbag2 folder; what is there as a bag is replaced.

    The map comes first and is latched; pose and action have equal stamps, which are the log times
    too; a last pose has no action. Equal arguments write equal bytes.

    Args:
        folder: the bag; its name is the bag's name.
        demonstration: observations and last poses on free cells of the map.
        grid_map: the map.
        step: time between two poses of an episode [s].

    Raises:
        InputError: the folder cannot be written to.
    """
    with BagWriter(folder, overwrite=True) as writer:
        for name, type_name in TOPIC_TYPES.items():
            qos = LATCHED if name == "map" else RELIABLE
            writer.add_topic(f"/{name}", type_name, qos)
        writer.write("/map", map_message(grid_map, BEGINNING), BEGINNING)
        for stamp, cell, action in _poses(demonstration, step):
            writer.write("/pose", pose_message(grid_map, cell, stamp), stamp)
            if action is not None:
                message = action_message(action, stamp, grid_map.frame_id)
                writer.write("/action", message, stamp)


def _poses(
    demonstration: Demonstration, step: float
) -> Iterator[tuple[int, tuple[int, int], int | None]]:
    """Stamp [ns], cell and action index of each pose, the action None for a last pose."""
    stamp = BEGINNING
    last_cells = dict(
        zip(demonstration.last_episode.tolist(), demonstration.last_cells.tolist(), strict=True)
    )
    for episode in np.unique(demonstration.episode).tolist():
        chosen = demonstration.episode == episode
        path: list[tuple[list[int], int | None]] = list(
            zip(
                demonstration.cells[chosen].tolist(),
                demonstration.action[chosen].tolist(),
                strict=True,
            )
        )
        if episode in last_cells:
            path.append((last_cells[episode], None))
        for (x, y), action in path:
            yield stamp, (x, y), action
            stamp += round(step * _SECOND)
        stamp += round((BETWEEN_EPISODES - step) * _SECOND)


def first_episodes(demonstration: Demonstration, count: int) -> Demonstration:
    """The first so many episodes of a demonstration."""
    return demonstration.of_episodes(np.unique(demonstration.episode)[:count])


def write_what_fits(
    folder: Path,
    demonstration: Demonstration,
    grid_map: GridMap,
    step: float,
    limit: int = SIZE_LIMIT,
) -> int:
    """Write as many whole episodes, the first ones, as keep the bag below a size.

    Args:
        folder, demonstration, grid_map, step: as in `write_demonstration`.
        limit: for the bag's own files together [bytes].

    Returns:
        How many episodes are in the bag.

    Raises:
        InputError: not even one fits, or the folder cannot be written to.
    """
    for count in range(len(np.unique(demonstration.episode)), 0, -1):
        write_demonstration(folder, first_episodes(demonstration, count), grid_map, step)
        if bag_size(folder) < limit:
            return count
    raise InputError(f"{folder}: not one episode fits into {limit} bytes; allow for more")


def bag_size(folder: Path) -> int:
    """Size of a bag's own files, whatever else lies in its folder [bytes]."""
    files = (folder / "metadata.yaml", *folder.glob("*.mcap"))
    return sum(file.stat().st_size for file in files)
