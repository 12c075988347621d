"""What a posterior says, in the words of its readers: subgoals, their order, their certainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.inference.posterior import Posterior
from bnirl_ros.maps.grid_map import GridMap


@dataclass(frozen=True)
class Subgoal:
    """One subgoal of the posterior mode.

    Attributes:
        rank: 1 for the subgoal with most observations, or, where the model knows pursuits, with
            most of them, and so on.
        cell: (x, y) on the map, (0, 0) at the lower left.
        position: centre of the cell (x, y) in the map frame [m].
        probability: share of the posterior draws in which the cell is a subgoal.
        observations: number of observations that the mode assigns to it.
        visit_order: 1-based positions in the visits of the first episode that visits it.
        pursuits: expected number of pursuits of it; None for a model that knows none.
    """

    rank: int
    cell: tuple[int, int]
    position: tuple[float, float]
    probability: float
    observations: int
    visit_order: tuple[int, ...]
    pursuits: float | None = None


@dataclass(frozen=True)
class Pursuit:
    """A maximal run of observations of one episode with one subgoal, slips among them or not.

    Attributes:
        episode: its number.
        rank: of the subgoal.
        first, last: the first and the last observation that the subgoal explains, by their rows
            in `Summary.observations`.
        arrived: whether the demonstrator was at the subgoal, after `first` was observed and by
            the pose that follows `last`.
    """

    episode: int
    rank: int
    first: int
    last: int
    arrived: bool


@dataclass(frozen=True)
class Parameter:
    """What is known of a parameter of the model.

    Attributes:
        name: as in `bnirl_ros.inference.settings.Settings`.
        median: of the posterior; the value where it is fixed.
        interval: central 90 % of the posterior; both ends the value where it is fixed.
        inferred: whether it was inferred rather than fixed.
    """

    name: str
    median: float
    interval: tuple[float, float]
    inferred: bool


@dataclass(frozen=True, eq=False)
class Summary:
    """What views show of a posterior.

    Attributes:
        subgoals: those of the posterior mode, by rank.
        visit_sequence: ranks in the order in which the demonstrator first visited them.
        observations: (N, 4) int64: episode, x, y, action index, in canonical order.
        rank_of: (N,) int64: rank of the subgoal to which the mode assigns each observation; 0 for
            an unexplained one.
        cell_probability: (height, width) float64: posterior probability that a cell is a subgoal.
        rhat: split R-hat, the larger one of log joint and number of partitions; None where it is
            undefined (one chain, or no variance).
        ess: effective sample size, the smaller one of the same two; None where undefined.
        chains, draws: number of chains, and of draws kept in each.
        pursuits: those of the mode, in the order of the observations; empty for a model that
            knows none.
        repetitions: how often the pursuits go round the visit sequence, the last time perhaps not
            to its end; 0 where they are no loop.
        unexplained: expected share of observations that no subgoal explains.
        parameters: of the model, inferred or fixed.
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
    pursuits: tuple[Pursuit, ...] = ()
    repetitions: int = 0
    unexplained: float = 0.0
    parameters: tuple[Parameter, ...] = ()


def summarise(posterior: Posterior, grid_map: GridMap) -> Summary:
    """What a posterior says: the subgoals of its mode, ranked, placed and in order of visit."""
    demonstration, mode = posterior.demonstration, posterior.mode
    probability = posterior.subgoal_probability()
    candidates, index, counts = np.unique(mode.subgoal_of, return_inverse=True, return_counts=True)
    by_rank = np.argsort(-counts, kind="stable")  # equal counts: by row and column of the cell
    rank_of = (np.argsort(by_rank) + 1)[index]
    cells = posterior.candidates[candidates[by_rank]]
    visits = episode_visits(demonstration, cells, rank_of)
    height_width = grid_map.free.shape
    cell_probability = np.zeros(height_width)
    cell_probability[posterior.candidates[:, 1], posterior.candidates[:, 0]] = probability
    subgoals = tuple(
        Subgoal(
            rank=rank,
            cell=(int(cell[0]), int(cell[1])),
            position=(float(position[0]), float(position[1])),
            probability=float(probability[candidates[by_rank[rank - 1]]]),
            observations=int(counts[by_rank[rank - 1]]),
            visit_order=next(
                (
                    tuple(place + 1 for place, visit in enumerate(episode) if visit == rank)
                    for episode in visits
                    if rank in episode
                ),
                (),
            ),
        )
        for rank, (cell, position) in enumerate(
            zip(cells, grid_map.centres_of(cells), strict=True), start=1
        )
    )
    return Summary(
        subgoals=subgoals,
        visit_sequence=tuple(dict.fromkeys(visit for episode in visits for visit in episode)),
        observations=demonstration.observations,
        rank_of=rank_of,
        cell_probability=cell_probability,
        rhat=posterior.rhat,
        ess=posterior.ess,
        chains=len(posterior.draws),
        draws=posterior.draws.log_joint.shape[1],
    )


def nothing_found(grid_map: GridMap) -> Summary:
    """The summary while there is no observation: no subgoal, anywhere."""
    return Summary(
        subgoals=(),
        visit_sequence=(),
        observations=np.empty((0, 4), dtype=np.int64),
        rank_of=np.empty(0, dtype=np.int64),
        cell_probability=np.zeros(grid_map.free.shape),
        rhat=None,
        ess=None,
        chains=0,
        draws=0,
    )


def episode_visits(
    demonstration: Demonstration,
    cells: npt.NDArray[np.int64],
    rank_of: npt.NDArray[np.int64],
) -> list[list[int]]:
    """Ranks of the subgoals that each episode visits, in order, without repetitions in a row.

    The paper's model knows no order, so it is read off the path: a subgoal is visited where the
    demonstrator is in its cell, having pursued it (some observation was assigned to it) since the
    last visit. One that is pursued in an episode but never reached counts where its last
    observation was made.

    Args:
        demonstration: N observations, and last poses.
        cells: (J, 2) cells of the subgoals, rank 1 first.
        rank_of: (N,) rank of the subgoal to which each observation is assigned.
    """
    rank_of_cell = {(int(x), int(y)): rank for rank, (x, y) in enumerate(cells, start=1)}
    last_cell = {
        int(episode): (int(x), int(y))
        for episode, (x, y) in zip(
            demonstration.last_episode, demonstration.last_cells, strict=True
        )
    }
    visits = []
    for episode in np.unique(demonstration.episode):
        chosen = np.flatnonzero(demonstration.episode == episode)
        path = [(int(x), int(y)) for x, y in demonstration.cells[chosen]]
        pursued = [int(rank) for rank in rank_of[chosen]]
        pursued_at = dict(zip(pursued, range(len(pursued)), strict=True))  # the last time
        if int(episode) in last_cell:
            path.append(last_cell[int(episode)])
        under_way: set[int] = set()
        arrivals = []
        for time, cell in enumerate(path):
            under_way.update(pursued[time : time + 1])
            rank = rank_of_cell.get(cell)
            if rank in under_way:
                under_way.remove(rank)
                arrivals.append((time, rank))
        reached = {rank for _, rank in arrivals}
        missed = [(time, rank) for rank, time in pursued_at.items() if rank not in reached]
        in_order = [rank for _, rank in sorted(arrivals + missed)]
        visits.append(
            [r for r, before in zip(in_order, [0, *in_order], strict=False) if r != before]
        )
    return visits
