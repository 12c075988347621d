"""Several demonstrations as one: on one map, their episodes numbered on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.planning import open_space_round
from bnirl_ros.errors import InputError
from bnirl_ros.fleet.reading import Taken
from bnirl_ros.maps.coarsening import with_free
from bnirl_ros.maps.grid_map import GridMap

_REMEDY = "give one map for all with --map, or infer from each with --each"


def common_map(demonstrations: Sequence[Taken]) -> GridMap:
    """The map that demonstrations have in common, whatever their order.

    They must have the same one. Cells that were opened since a robot was in them are open for all;
    open space, which was taken for lack of a map, is as large as all of them need.

    Raises:
        InputError: two of them have different maps; the sentence names them and a difference.
    """
    first = demonstrations[0]
    for other in demonstrations[1:]:
        if difference := _difference(first, other):
            raise InputError(
                f"{other.path}: its map is not that of {first.path} ({difference}); {_REMEDY}"
            )
    if first.is_assumed:
        # Open space has a margin of a cell round all that was visited.
        corners = [
            taken.grid_map.centres_of([(1, 1), np.subtract(taken.grid_map.free.shape[::-1], 2)])
            for taken in demonstrations
        ]
        whole = np.concatenate(corners)
        source = ", ".join(str(taken.path) for taken in demonstrations)
        return open_space_round(whole, first.grid_map.resolution, first.grid_map.frame_id, source)
    opened = {cell for taken in demonstrations for cell in taken.opened}
    return with_free(first.grid_map, sorted(opened)) if opened else first.grid_map


def joined(demonstrations: Sequence[Demonstration]) -> Demonstration:
    """One demonstration of the episodes of several, in their order.

    Episodes are numbered from 0; those of a single demonstration keep their numbers.
    """
    if len(demonstrations) == 1:
        return demonstrations[0]
    episodes, last_episodes, before = [], [], 0
    for each in demonstrations:
        numbers, episode = np.unique(each.episode, return_inverse=True)
        episodes.append(episode + before)
        last_episodes.append(np.searchsorted(numbers, each.last_episode) + before)
        before += len(numbers)
    return Demonstration(
        episode=np.concatenate(episodes),
        cells=np.concatenate([each.cells for each in demonstrations]),
        action=np.concatenate([each.action for each in demonstrations]),
        last_episode=np.concatenate(last_episodes),
        last_cells=np.concatenate([each.last_cells for each in demonstrations]),
    )


def _difference(one: Taken, other: Taken) -> str:
    """Words on how the maps of two differ; none where they don't."""
    mine, its = one.grid_map, other.grid_map
    if one.is_assumed != other.is_assumed:
        return "one of them has none, and was put in open space"
    if mine.frame_id != its.frame_id:
        return f"frame {its.frame_id!r}, not {mine.frame_id!r}"
    if mine.resolution != its.resolution:
        return f"cells of {its.resolution:g} m, not {mine.resolution:g} m"
    if one.is_assumed:
        return ""
    if mine.origin != its.origin:
        return "origin ({:g}, {:g}, {:g}), not ({:g}, {:g}, {:g})".format(
            *its.origin, *mine.origin
        )
    if mine.free.shape != its.free.shape:
        sizes = (*its.free.shape[::-1], *mine.free.shape[::-1])
        return "{} x {} cells, not {} x {}".format(*sizes)
    unlike = int(np.count_nonzero(_as_recorded(one) != _as_recorded(other)))
    return f"{unlike} cells are free on one of them alone" if unlike else ""


def _as_recorded(taken: Taken) -> np.ndarray:
    """(height, width) bool free space, without the cells that were opened."""
    free = taken.grid_map.free.copy()
    if taken.opened:
        x, y = np.array(taken.opened).T
        free[y, x] = False
    return free
