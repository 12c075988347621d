"""What a posterior says, in the words of its readers: subgoals, their order, their certainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Subgoal:
    """One subgoal of the posterior mode.

    Attributes:
        rank: 1 for the subgoal with most observations, and so on.
        cell: (x, y) on the map, (0, 0) at the lower left.
        position: centre of the cell (x, y) in the map frame [m].
        probability: share of the posterior draws in which the cell is a subgoal.
        observations: number of observations that the mode assigns to it.
        visit_order: 1-based positions in the visits of the first episode that visits it.
    """

    rank: int
    cell: tuple[int, int]
    position: tuple[float, float]
    probability: float
    observations: int
    visit_order: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Summary:
    """What views show of a posterior.

    Attributes:
        subgoals: those of the posterior mode, by rank.
        visit_sequence: ranks in the order in which the demonstrator first visited them.
        observations: (N, 4) int64: episode, x, y, action index, in canonical order.
        rank_of: (N,) int64: rank of the subgoal to which the mode assigns each observation.
        cell_probability: (height, width) float64: posterior probability that a cell is a subgoal.
        rhat: split R-hat, the larger one of log joint and number of partitions; None where it is
            undefined (one chain, or no variance).
        ess: effective sample size, the smaller one of the same two; None where undefined.
        chains, draws: number of chains, and of draws kept in each.
    """

    subgoals: tuple[Subgoal, ...]
    visit_sequence: tuple[int, ...]
    observations: npt.NDArray[np.int64]
    rank_of: npt.NDArray[np.int64]
    cell_probability: npt.NDArray[np.float64]
    rhat: float | None
    ess: float | None
    chains: int
    draws: int
