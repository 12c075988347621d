"""Human play in Overcooked: are the cells from which players interact the first ones by rank?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.experiments.interactions import shares
from bnirl_ros.experiments.overcooked import (
    LAYOUTS,
    MOVES,
    read_interactions,
    read_overcooked,
    read_paths,
)
from bnirl_ros.experiments.study.part import MODELS, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.experiments.study.scores import Cell, top_hits
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.summary import summarise
from bnirl_ros.mdp.actions import ACTION_NAMES

LEAST_SHARE = 0.03
"""Of the interactions that had an effect, how many a cell has at least that is truly a subgoal."""

_STAY = ACTION_NAMES.index("stay")


@dataclass(frozen=True)
class Case:
    """A way to rank the cells of a layout: a model or one of `BASELINES`."""

    recordings: Path
    layout: str
    ranking: str


def true_cells(interactions: npt.NDArray[np.int64]) -> set[Cell]:
    """The cells with at least `LEAST_SHARE` of the interactions (M, 2)."""
    return {cell for cell, part in shares(interactions) if part >= LEAST_SHARE}


def by_count(cells: npt.NDArray[np.int64]) -> list[Cell]:
    """The distinct ones of the cells (M, 2), the most frequent first."""
    return [cell for cell, _ in shares(cells)]


def entries(paths: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Cells (M, 2) entered along paths (N, 3) of episode and cell; an episode's first one too."""
    entered = np.ones(len(paths), dtype=np.bool_)
    entered[1:] = np.diff(paths, axis=0).any(axis=1)
    return paths[entered, 1:]


def rank_by_dwell(recordings: Path, layout: str) -> list[Cell]:
    """Where players are for longest, in the recording with all its steps."""
    return by_count(read_paths(recordings, layout)[:, 1:])


def rank_by_visits(recordings: Path, layout: str) -> list[Cell]:
    """Where players come most often."""
    return by_count(entries(read_paths(recordings, layout)))


def rank_by_stays(recordings: Path, layout: str) -> list[Cell]:
    """Where the demonstration that a model gets has most actions of staying: interactions."""
    demonstration, _ = read_overcooked(recordings, layout)
    return by_count(demonstration.cells[demonstration.action == _STAY])


BASELINES = {"dwell time": rank_by_dwell, "visits": rank_by_visits, "stays": rank_by_stays}
"""Rankings that need no model."""


def rank_by_model(recordings: Path, layout: str, model: str) -> list[Cell]:
    """The subgoals of a model's mode by rank."""
    demonstration, grid_map = read_overcooked(recordings, layout)
    summary = summarise(infer(demonstration, grid_map, settings_of(model, moves=MOVES)), grid_map)
    return [subgoal.cell for subgoal in summary.subgoals]


def run(case: Case) -> dict[str, Any]:
    """How many of a layout's true cells come first in a ranking."""
    truth = true_cells(read_interactions(case.recordings, case.layout))
    baseline = BASELINES.get(case.ranking)
    ranked = (
        baseline(case.recordings, case.layout)
        if baseline
        else rank_by_model(case.recordings, case.layout, case.ranking)
    )
    return {
        "layout": case.layout,
        "ranking": case.ranking,
        "true": sorted(truth),
        "ranked": ranked,
        "hits": top_hits(ranked, truth),
    }


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each ranking, a column for each layout."""
    cell_of = {
        (result["ranking"], result["layout"]): f"{result['hits']} of {len(result['true'])}"
        for result in results
    }
    rankings = dict.fromkeys(ranking for ranking, _ in cell_of)
    return Table(
        title="Human play in Overcooked",
        text="True cells are those with at least "
        f"{LEAST_SHARE:.0%} of the interactions that had an effect. Of the k true cells of a "
        "layout, how many are among the first k: of the cells ranked by the time that players "
        "spend there, by how often they come there (both in the recording with all its steps), by "
        "how often they stay there in the demonstration that the models get, and of the models' "
        "subgoals.",
        header=("first by", *(f"`{layout}`" for layout in LAYOUTS)),
        rows=tuple(
            (ranking, *(cell_of[ranking, layout] for layout in LAYOUTS)) for ranking in rankings
        ),
    )


def cases(recordings: Path) -> Sequence[Case]:
    """Every ranking of every layout.

    Raises:
        InputError: the recordings are missing.
    """
    for layout in LAYOUTS:
        read_interactions(recordings, layout)
    return [
        Case(recordings, layout, ranking)
        for ranking in (*BASELINES, *MODELS)
        for layout in LAYOUTS
    ]


PART = Part(name="overcooked", cases=cases, run=run, table=table)
