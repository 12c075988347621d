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
        return [pursuit.rank for pursuit in summary.pursuits]
    return summary.visit_sequence


def run(model: str) -> dict[str, Any]:
    """The score of a model."""
    demonstration, grid_map = drive()
    summary = summarise(infer(demonstration, grid_map, settings_of(model)), grid_map)
    return {
        "model": model,
        "positions": [subgoal.position for subgoal in summary.subgoals],
        **asdict(score(summary)),
    }


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each model."""
    return Table(
        title="A turtle driven round six waypoints",
        text=f"`{BAG}`: waypoints with a subgoal within {REACH} m, the subgoals that are at none "
        "of them or are a further one at the same, and whether those found are visited in the "
        "author's order, from wherever.",
        header=("model", "waypoints found", "at none", "further ones at the same", "in order"),
        rows=tuple(
            (
                result["model"],
                f"{result['found']} of {len(WAYPOINTS)}",
                str(result["strays"]),
                str(result["duplicates"]),
                "yes" if result["in_order"] else "no",
            )
            for result in results
        ),
    )


def cases(recordings: Path) -> Sequence[str]:
    """The models; the bag comes with the package."""
    return MODELS


PART = Part(name="turtle", cases=cases, run=run, table=table)
