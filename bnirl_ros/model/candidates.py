"""The support of P(g): which cells may be subgoals."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.mdp.grid_world import GridWorld

CANDIDATE_KINDS = ("visited", "free")
"""Proposition 1's support, and every free cell."""


def candidate_cells(
    kind: str, demonstration: Demonstration, world: GridWorld
) -> npt.NDArray[np.int64]:
    """Candidate subgoals (G, 2), ordered by row and column whatever the order of the visits.

    Args:
        kind: "visited": the cells in which an observation was made, and the last pose of every
            episode, though no action was taken there (Proposition 1); "free": all free cells.
    """
    if kind == "visited":
        cells = np.concatenate([demonstration.cells, demonstration.last_cells])
        return world.cells_of(np.unique(world.states_of(cells)))
    if kind == "free":
        return world.cells_of(np.flatnonzero(world.free))
    raise ValueError(f"candidates must be one of {', '.join(CANDIDATE_KINDS)}, not {kind}")
