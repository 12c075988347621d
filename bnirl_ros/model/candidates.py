"""The support of P(g): which cells, or sets of cells with equal features, may be subgoals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import FeatureMap
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.grid_world import GridWorld

CANDIDATE_KINDS = ("visited", "free")
"""Proposition 1's support, and every free cell."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """G candidate subgoals: cells (Definition 1), or sets of cells with equal features (3).

    Attributes:
        coordinates: (G, k) int64: the cell (x, y) of each, or its feature coordinates.
        goals: their states in the grid world.
        cells: (M, 2) int64 the cells of `goals.states`.
        are_features: whether they are feature subgoals.
    """

    coordinates: npt.NDArray[np.int64]
    goals: Goals
    cells: npt.NDArray[np.int64]
    are_features: bool = False

    def __len__(self) -> int:
        return len(self.goals)

    def cells_of(self, candidate: int) -> npt.NDArray[np.int64]:
        """(M_g, 2) the cells of one candidate."""
        return self.cells[self.goals.first[candidate] : self.goals.first[candidate + 1]]

    def take(self, chosen: npt.ArrayLike) -> Candidates:
        """Some of the candidates, by index."""
        indices = np.asarray(chosen, dtype=np.int64)
        entries = np.concatenate(
            [
                np.empty(0, dtype=np.int64),
                *(np.arange(*self.goals.first[index : index + 2]) for index in indices),
            ]
        )
        return Candidates(
            coordinates=self.coordinates[indices],
            goals=Goals(
                np.concatenate([[0], np.cumsum(self.goals.sizes[indices])]).astype(np.int64),
                self.goals.states[entries],
            ),
            cells=self.cells[entries],
            are_features=self.are_features,
        )

    def reachable_from(
        self, world: GridWorld, states: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """(U,) whether any candidate lies in the same part of the map as each of the states."""
        return np.isin(world.parts_of(states), world.parts_of(self.goals.states))

    def reached_in(
        self, world: GridWorld, cells: npt.NDArray[np.int64], radius: float = 0.0
    ) -> npt.NDArray[np.bool_]:
        """(N, G) whether each of the cells (N, 2) is a candidate's own, or within a radius of one.

        Args:
            world: of the candidates.
            cells: cells in it.
            radius: largest distance between two centres [cells].
        """
        if radius < 1.0:  # the centres of two cells are at least that far apart
            return self.goals.hold(world.states_of(cells))
        from scipy.spatial import KDTree  # here, since only this needs it

        distinct, row_of = np.unique(cells, axis=0, return_inverse=True)
        reached = np.zeros((len(distinct), len(self)), dtype=np.bool_)
        if len(distinct) and len(self):
            near = KDTree(distinct).sparse_distance_matrix(
                KDTree(self.cells), radius, output_type="ndarray"
            )
            reached[near["i"], self.goals.goal_of[near["j"]]] = True
        return np.asarray(reached[row_of.reshape(-1)])


def candidates_of(
    kind: str,
    demonstration: Demonstration,
    world: GridWorld,
    features: FeatureMap | None = None,
    by_part: bool = False,
) -> Candidates:
    """The candidate subgoals, in an order that does not depend on that of the visits.

    Cells are ordered by row and column, feature coordinates by their first number, then the next.

    Args:
        kind: "visited": the cells in which an observation was made, and the last pose of every
            episode, though no action was taken there, or their feature coordinates (Proposition
            1); "free": all free cells, or the coordinates of all of them.
        demonstration: the observations.
        world: where they were made.
        features: of the cells, for feature subgoals; None for state subgoals.
        by_part: whether cells with equal features in different connected parts of the map are
            subgoals of their own: who is in one part never pursues a goal in another.

    Raises:
        InputError: no visited cell has features.
    """
    if kind not in CANDIDATE_KINDS:
        raise ValueError(f"candidates must be one of {', '.join(CANDIDATE_KINDS)}, not {kind}")
    visited = np.unique(
        world.states_of(np.concatenate([demonstration.cells, demonstration.last_cells]))
    )
    free = np.flatnonzero(world.free)
    if features is None:
        states = visited if kind == "visited" else free
        cells = world.cells_of(states)
        return Candidates(cells, Goals.of_states(states), cells)
    known = features.known.reshape(-1)
    if not known[visited].any():
        raise InputError(
            "no visited cell has features; check that their layer lies where the map does"
        )
    states = free[known[free]]
    coordinates = features.coordinates.reshape(world.state_count, -1)
    part = world.parts_of(states) if by_part else np.zeros(len(states), dtype=np.int64)
    keys, goal_of = np.unique(
        np.column_stack([coordinates[states], part]), axis=0, return_inverse=True
    )
    goal_of = goal_of.reshape(-1)
    if kind == "visited":
        seen = np.unique(goal_of[np.isin(states, visited)])
        kept = np.isin(goal_of, seen)
        states, goal_of, keys = states[kept], np.searchsorted(seen, goal_of[kept]), keys[seen]
    by_goal = np.argsort(goal_of, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(goal_of, minlength=len(keys)))])
    goals = Goals(first.astype(np.int64), states[by_goal])
    return Candidates(keys[:, :-1], goals, world.cells_of(goals.states), are_features=True)
