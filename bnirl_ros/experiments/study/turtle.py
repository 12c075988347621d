"""The turtle's drive: does a model find the waypoints of its author, and in the author's order?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.experiments.study.part import MODELS, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.experiments.study.scores import goes_round, nearest_within, visits
from bnirl_ros.experiments.turtle import WAYPOINTS
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.summary import Summary, summarise
from bnirl_ros.maps import GridMap
from bnirl_ros.resources import share_folder

BAG = "turtle_waypoints"

REACH = 0.75
"""How far from a waypoint a subgoal may be and still be it [m]. A cell is 0.5 m wide, and the
drive itself passes the waypoints at up to half a metre."""


SEEDS = 10
"""Inferences by each model."""


@dataclass(frozen=True)
class WaypointScore:
    """How subgoals compare with the author's waypoints.

    Attributes:
        found: waypoints with a subgoal in reach.
        strays: subgoals out of reach of every waypoint.
        duplicates: subgoals beyond the first at a waypoint.
        visited: the waypoints visited, by their place in `WAYPOINTS`.
        in_order: whether these go round in the author's order, those not found left out.
    """

    found: int
    strays: int
    duplicates: int
    visited: list[int]
    in_order: bool


def drive() -> tuple[Demonstration, GridMap]:
    """The drive as it is shipped, and its map."""
    recorded = read_demonstration(share_folder() / "bags" / BAG, {})
    assert recorded.grid_map is not None
    return place(recorded.recording, recorded.grid_map).demonstration, recorded.grid_map


def score(summary: Summary) -> WaypointScore:
    """How the subgoals of a summary compare with the author's waypoints."""
    positions = [subgoal.position for subgoal in summary.subgoals]
    waypoint_of = nearest_within(positions, WAYPOINTS, REACH)
    at_waypoints = [waypoint for waypoint in waypoint_of if waypoint is not None]
    found = len(set(at_waypoints))
    visited = visits(waypoint_of[rank - 1] for rank in _ranks_visited(summary))
    return WaypointScore(
        found=found,
        strays=len(waypoint_of) - len(at_waypoints),
        duplicates=len(at_waypoints) - found,
        visited=visited,
        in_order=goes_round(visited, range(len(WAYPOINTS))),
    )


def _ranks_visited(summary: Summary) -> Sequence[int]:
    if summary.pursuits:
        return [pursuit.rank for pursuit in summary.pursuits if pursuit.arrived]
    return summary.visit_sequence


@dataclass(frozen=True)
class Case:
    """A model with a seed."""

    model: str
    seed: int


def run(case: Case) -> dict[str, Any]:
    """The score of a model."""
    demonstration, grid_map = drive()
    settings = settings_of(case.model, seed=case.seed)
    summary = summarise(infer(demonstration, grid_map, settings), grid_map)
    return {
        **asdict(case),
        "positions": [subgoal.position for subgoal in summary.subgoals],
        **asdict(score(summary)),
    }


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each model."""
    rows = []
    for model in dict.fromkeys(result["model"] for result in results):
        mine = [result for result in results if result["model"] == model]
        rows.append(
            (
                model,
                f"{_range(mine, 'found')} of {len(WAYPOINTS)}",
                _range(mine, "strays"),
                _range(mine, "duplicates"),
                f"{sum(result['in_order'] for result in mine)} of {len(mine)} times",
            )
        )
    return Table(
        title="A turtle driven round six waypoints",
        text=f"`{BAG}`: waypoints with a subgoal within {REACH} m, the subgoals that are at none "
        "of them or are a further one at the same, and whether those found are visited in the "
        f"author's order, from wherever; least and most with the seeds 0 to {SEEDS - 1}.",
        header=("model", "waypoints found", "at none", "further ones at the same", "in order"),
        rows=tuple(rows),
    )


def _range(results: Sequence[dict[str, Any]], name: str) -> str:
    values = sorted({result[name] for result in results})
    return str(values[0]) if len(values) == 1 else f"{values[0]}-{values[-1]}"


def cases(recordings: Path) -> Sequence[Case]:
    """The models; the bag comes with the package."""
    return [Case(model, seed) for model in MODELS for seed in range(SEEDS)]


PART = Part(name="turtle", cases=cases, run=run, table=table)
