"""What a posterior says, in the words of its readers: subgoals, their order, their certainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.inference.chains import Sampling
from bnirl_ros.inference.convergence import NOTHING_DRAWN, Convergence
from bnirl_ros.inference.posterior import Posterior, grid_world
from bnirl_ros.inference.runs import runs
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.model.candidates import Candidates
from bnirl_ros.model.pursuits import PRIORS


@dataclass(frozen=True)
class Subgoal:
    """One subgoal of the posterior mode.

    Attributes:
        rank: 1 for the subgoal with most observations, or, where the model knows pursuits, with
            most of them, and so on.
        cell: (x, y) on the map, (0, 0) at the lower left; of a feature subgoal, that of its cells
            which is nearest to their middle.
        position: centre of the cell (x, y) in the map frame [m].
        probability: share of the posterior draws in which it is a subgoal.
        observations: number of observations that the mode assigns to it.
        visit_order: 1-based positions in the visits of the first episode that visits it.
        pursuits: expected number of pursuits of it; None for a model that knows none.
        feature: coordinates of a feature subgoal; None for a cell.
        cells: all cells of a feature subgoal; none for a cell.
        name: that the feature layer has for it; may be empty.
    """

    rank: int
    cell: tuple[int, int]
    position: tuple[float, float]
    probability: float
    observations: int
    visit_order: tuple[int, ...]
    pursuits: float | None = None
    feature: tuple[int, ...] | None = None
    cells: tuple[tuple[int, int], ...] = ()
    name: str = ""


@dataclass(frozen=True)
class Pursuit:
    """A maximal run of observations of one episode with one subgoal, slips among them or not.

    Attributes:
        episode: its number.
        rank: of the subgoal.
        first, last: the first and the last observation that the subgoal explains, by their rows
            in `Summary.observations`.
        arrived: whether the demonstrator was at the subgoal between `first` and the beginning of
            the next pursuit, or the last pose of the episode.
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
        convergence: how far the chains agree.
        sampling: how many sweeps there were, and what stopped them; None without observations.
        pursuits: those of the mode, in the order of the observations; empty for a model that
            knows none.
        repetitions: how often the pursuits go round the visit sequence, the last time perhaps not
            to its end; 0 where they are no loop.
        unexplained: expected share of observations that no subgoal explains.
        parameters: of the model, inferred or fixed.
        rank_of_candidate: (G,) int64: rank of the subgoal that each candidate counts as, be it
            that it lies within the arrival radius of it; 0 for one that is no subgoal of the mode.
    """

    subgoals: tuple[Subgoal, ...]
    visit_sequence: tuple[int, ...]
    observations: npt.NDArray[np.int64]
    rank_of: npt.NDArray[np.int64]
    cell_probability: npt.NDArray[np.float64]
    convergence: Convergence
    sampling: Sampling | None
    pursuits: tuple[Pursuit, ...] = ()
    repetitions: int = 0
    unexplained: float = 0.0
    parameters: tuple[Parameter, ...] = ()
    rank_of_candidate: npt.NDArray[np.int64] = field(
        default_factory=lambda: np.empty(0, dtype=np.int64)
    )

    @property
    def rhat(self) -> float | None:
        """The largest split R-hat of all that is watched; None where undefined."""
        return self.convergence.rhat

    @property
    def ess(self) -> float | None:
        """The smallest effective sample size of all that is watched; None where undefined."""
        return self.convergence.ess

    @property
    def chains(self) -> int:
        """Number of chains."""
        return self.convergence.chains

    @property
    def draws(self) -> int:
        """Number of draws kept in each chain."""
        return self.convergence.draws


def summarise(posterior: Posterior, grid_map: GridMap) -> Summary:
    """What a posterior says: the subgoals of its mode, ranked, placed and in order of visit.

    For the sequential model, subgoals within the arrival radius of one with more pursuits count as
    that one.
    """
    demonstration, settings = posterior.demonstration, posterior.settings
    in_sequence = settings.model == "sequential"
    counts = posterior.pursuit_counts()
    cell_probability = np.zeros(grid_map.free.shape)
    all_cells = posterior.candidates.cells
    goal_of = posterior.candidates.goals.goal_of
    cell_probability[all_cells[:, 1], all_cells[:, 0]] = (counts > 0).mean(axis=0)[goal_of]

    subgoal_of = posterior.mode.subgoal_of
    region_of = np.arange(len(posterior.candidates), dtype=np.int32)
    if in_sequence and settings.arrival_radius > 0.0:
        region_of = _regions(posterior, counts, settings.arrival_radius / grid_map.resolution)
        counts = posterior.pursuit_counts(region_of)
        subgoal_of = np.append(region_of, np.int32(-1))[subgoal_of]
    explained = subgoal_of >= 0
    candidates, index, observations = np.unique(
        subgoal_of[explained], return_inverse=True, return_counts=True
    )
    pursuits = counts.mean(axis=0)[candidates]
    # Equal ones by row and column of the cell.
    by_rank = np.argsort(-pursuits if in_sequence else -observations, kind="stable")
    rank_of = np.zeros(len(demonstration), dtype=np.int64)
    rank_of[explained] = (np.argsort(by_rank) + 1)[index]
    ranked = candidates[by_rank]
    found = posterior.candidates.take(ranked)
    rank_of_region = np.zeros(len(posterior.candidates), dtype=np.int64)
    rank_of_region[ranked] = np.arange(len(ranked)) + 1
    sequence = _pursuits(demonstration, rank_of, _at_subgoal(posterior, grid_map, found))
    visits = _visits(sequence) if in_sequence else episode_visits(demonstration, found, rank_of)
    places = np.array(
        [middle_of(found.cells_of(index)) for index in range(len(found))], dtype=np.int64
    ).reshape(-1, 2)
    names = grid_map.features.names if grid_map.features else {}
    probability = (counts > 0).mean(axis=0)
    subgoals = tuple(
        Subgoal(
            rank=rank,
            cell=(int(cell[0]), int(cell[1])),
            position=(float(position[0]), float(position[1])),
            probability=float(probability[candidate]),
            observations=int(observations[by_rank[rank - 1]]),
            visit_order=next(
                (
                    tuple(place + 1 for place, visit in enumerate(episode) if visit == rank)
                    for episode in visits
                    if rank in episode
                ),
                (),
            ),
            pursuits=float(pursuits[by_rank[rank - 1]]) if in_sequence else None,
            **_feature(found, rank - 1, names),
        )
        for rank, (candidate, cell, position) in enumerate(
            zip(ranked, places, grid_map.centres_of(places), strict=True), start=1
        )
    )
    return Summary(
        subgoals=subgoals,
        visit_sequence=tuple(dict.fromkeys(visit for episode in visits for visit in episode)),
        observations=demonstration.observations,
        rank_of=rank_of,
        cell_probability=cell_probability,
        convergence=posterior.convergence,
        sampling=posterior.sampling,
        pursuits=tuple(sequence) if in_sequence else (),
        repetitions=_repetitions(visits) if in_sequence else 0,
        unexplained=float((posterior.draws.subgoal_of < 0).mean()),
        parameters=_parameters(posterior) if in_sequence else (),
        rank_of_candidate=rank_of_region[region_of],
    )


def _regions(
    posterior: Posterior, counts: npt.NDArray[np.int64], radius: float
) -> npt.NDArray[np.int32]:
    """(G,) for each candidate the one that stands for it: the first within the radius [cells].

    Those of the mode stand for others, the one with most pursuits first. Features stand for
    themselves.
    """
    region_of = np.arange(len(posterior.candidates), dtype=np.int32)
    if posterior.candidates.are_features:
        return region_of
    cells = posterior.candidates.coordinates
    found = posterior.mode.subgoal_of[posterior.mode.subgoal_of >= 0]
    taken = np.zeros(len(region_of), dtype=np.bool_)
    for candidate in sorted(set(found.tolist()), key=lambda g: (-counts[:, g].sum(), g)):
        if not taken[candidate]:
            apart = np.linalg.norm(cells - cells[candidate], axis=1)
            region = (apart <= radius) & ~taken
            region_of[region] = candidate
            taken |= region
    return region_of


def _at_subgoal(
    posterior: Posterior, grid_map: GridMap, found: Candidates
) -> npt.NDArray[np.bool_]:
    """(N + L, J) whether each observation, then each last pose, is at each subgoal's cells."""
    demonstration, settings = posterior.demonstration, posterior.settings
    places = np.concatenate([demonstration.cells, demonstration.last_cells])
    radius = settings.arrival_radius / grid_map.resolution
    return found.reached_in(grid_world(grid_map, settings), places, radius)


def middle_of(cells: npt.NDArray[np.int64]) -> tuple[int, int]:
    """That of the cells (M, 2) which is nearest to their mean: the first of equals."""
    apart = np.linalg.norm(cells - cells.mean(axis=0), axis=1)
    x, y = cells[int(np.argmin(apart))]
    return int(x), int(y)


def _feature(
    found: Candidates, index: int, names: Mapping[tuple[int, ...], str]
) -> dict[str, Any]:
    """The fields of a `Subgoal` that only a feature subgoal has."""
    if not found.are_features:
        return {}
    feature = tuple(found.coordinates[index].tolist())
    return {
        "feature": feature,
        "cells": tuple((int(x), int(y)) for x, y in found.cells_of(index)),
        "name": names.get(feature, ""),
    }


def _pursuits(
    demonstration: Demonstration,
    rank_of: npt.NDArray[np.int64],
    at_subgoal: npt.NDArray[np.bool_],
) -> list[Pursuit]:
    """The pursuits that ranks (N,), 0 for unexplained, are made of."""
    firsts, lasts = runs(rank_of - 1, demonstration.starts)
    last_pose = {
        int(episode): len(demonstration) + index
        for index, episode in enumerate(demonstration.last_episode)
    }
    pursuits = []
    for number, (first, last) in enumerate(zip(firsts.tolist(), lasts.tolist(), strict=True)):
        episode, rank = int(demonstration.episode[first]), int(rank_of[first])
        following = firsts[number + 1] if number + 1 < len(firsts) else len(demonstration)
        end = int(np.searchsorted(demonstration.episode, episode, side="right"))
        places = list(range(first, min(following + 1, end)))
        if following >= end and episode in last_pose:
            places.append(last_pose[episode])
        arrived = bool(at_subgoal[places, rank - 1].any())
        pursuits.append(Pursuit(episode, rank, first, last, arrived))
    return pursuits


def _visits(pursuits: Sequence[Pursuit]) -> list[list[int]]:
    """Ranks that each episode visits, in order, without repetitions in a row.

    Pursuits that arrived; where a subgoal was never reached in an episode, its last pursuit there.
    """
    visits = []
    for _, group in groupby(pursuits, key=lambda pursuit: pursuit.episode):
        episode = list(group)
        reached = {pursuit.rank for pursuit in episode if pursuit.arrived}
        last = {pursuit.rank: pursuit for pursuit in episode}
        ranks = [
            pursuit.rank
            for pursuit in episode
            if pursuit.arrived or (pursuit.rank not in reached and last[pursuit.rank] is pursuit)
        ]
        visits.append([rank for rank, _ in groupby(ranks)])
    return visits


def _repetitions(visits: Sequence[Sequence[int]]) -> int:
    """How often the visits go round one loop of two subgoals or more; 0 for once, or no loop.

    Every episode begins the loop anew; its last time round may break off.
    """
    loop = list(dict.fromkeys(visits[0])) if visits else []
    if len(loop) < 2 or any(
        rank != loop[place % len(loop)] for episode in visits for place, rank in enumerate(episode)
    ):
        return 0
    rounds = sum(len(episode) // len(loop) for episode in visits)
    return rounds if rounds > 1 else 0


def _parameters(posterior: Posterior) -> tuple[Parameter, ...]:
    """Median and central 90 % interval of each parameter of the sequential model."""
    drawn = posterior.draws.parameters.reshape(-1, len(PRIORS))
    low, median, high = np.quantile(drawn, (0.05, 0.5, 0.95), axis=0).tolist()
    return tuple(
        Parameter(name, median[column], (low[column], high[column]), name not in fixed)
        for fixed in (posterior.settings.fixed,)
        for column, name in enumerate(PRIORS)
    )


def nothing_found(grid_map: GridMap) -> Summary:
    """The summary while there is no observation: no subgoal, anywhere."""
    return Summary(
        subgoals=(),
        visit_sequence=(),
        observations=np.empty((0, 4), dtype=np.int64),
        rank_of=np.empty(0, dtype=np.int64),
        cell_probability=np.zeros(grid_map.free.shape),
        convergence=NOTHING_DRAWN,
        sampling=None,
    )


def episode_visits(
    demonstration: Demonstration,
    found: Candidates,
    rank_of: npt.NDArray[np.int64],
) -> list[list[int]]:
    """Ranks of the subgoals that each episode visits, in order, without repetitions in a row.

    The paper's model knows no order, so it is read off the path: a subgoal is visited where the
    demonstrator is in its cell, or one of its cells, having pursued it (some observation was
    assigned to it) since the last visit. One that is pursued in an episode but never reached
    counts where its last observation was made.

    Args:
        demonstration: N observations, and last poses.
        found: the J subgoals, rank 1 first.
        rank_of: (N,) rank of the subgoal to which each observation is assigned.
    """
    ranks = (found.goals.goal_of + 1).tolist()
    rank_of_cell = {(x, y): rank for (x, y), rank in zip(found.cells.tolist(), ranks, strict=True)}
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
