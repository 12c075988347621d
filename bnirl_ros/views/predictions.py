"""What is foreseen: predictions.csv, and tables for the terminal."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.inference.prediction import Prediction, by_outcome
from bnirl_ros.inference.scoring import Losses
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.model.candidates import Candidates
from bnirl_ros.views.results import write_whole
from bnirl_ros.views.tables import aligned

_SHOWN = 20  # cells on the terminal; all of them are in the file
_LIKELIEST = 3  # actions of a cell on the terminal


@dataclass(frozen=True, eq=False)
class Foreseen:
    """What was foreseen of a demonstration, or in cells.

    Attributes:
        source: name of what was held out; empty where nothing was done in the cells.
        demonstration: the N observations; where nothing was done, an episode for each cell.
        prediction: of each.
    """

    source: str
    demonstration: Demonstration
    prediction: Prediction


def write_predictions(
    folder: Path, everything: Sequence[Foreseen], candidates: Candidates
) -> list[Path]:
    """Write predictions.csv, whole or not at all; returns its path.

    A row for each observation: `held_out`, the file that it is from; `episode`, `x`, `y` and the
    `action` that was taken, by name; the probability of each action, in a column of its name;
    `foreseen`, the first action that does what is most probable; the subgoal that is most probably
    pursued, as `subgoal_x` and `subgoal_y`, or its feature coordinates as `subgoal_feature` with
    spaces between them, and `subgoal_probability`. Where cells are foreseen in which nothing was
    done, `held_out`, `episode` and `action` are empty. There is one prediction at least.

    Raises:
        InputError: the folder cannot be written to.
    """

    def write(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(_heading(everything[0].prediction, candidates))
            for each in everything:
                table.writerows(_rows(each, candidates))

    return write_whole(folder, {"predictions.csv": write})


def _heading(prediction: Prediction, candidates: Candidates) -> list[str]:
    subgoal = ["subgoal_feature"] if candidates.are_features else ["subgoal_x", "subgoal_y"]
    names = [ACTION_NAMES[action] for action in prediction.actions]
    before = ["held_out", "episode", "x", "y", "action"]
    return [*before, *names, "foreseen", *subgoal, "subgoal_probability"]


def _rows(each: Foreseen, candidates: Candidates) -> Iterator[list[object]]:
    told, demonstration = each.prediction, each.demonstration
    subgoals = candidates.coordinates[told.subgoal].tolist()
    for row, (episode, x, y, action) in enumerate(demonstration.observations.tolist()):
        done = [each.source, episode, x, y, ACTION_NAMES[action]]
        if not each.source:
            done = ["", "", x, y, ""]
        subgoal = subgoals[row]
        if candidates.are_features:
            subgoal = [" ".join(map(str, subgoal))]
        yield [
            *done,
            *(f"{probability:.6g}" for probability in told.probability[row]),
            ACTION_NAMES[told.most_probable[row]],
            *subgoal,
            f"{told.subgoal_probability[row]:.6g}",
        ]


def loss_table(lost: Mapping[str, Losses]) -> str:
    """Mean log loss and 0-1 loss of each prediction, a line for each; no newline at the end."""
    rows = [
        (name, f"{each.log.mean():.3f}", f"{each.zero_one.mean():.3f}")
        for name, each in lost.items()
    ]
    return aligned([("foreseen by", "log loss [nats]", "0-1 loss"), *rows])


def cell_table(each: Foreseen, candidates: Candidates, grid_map: GridMap) -> str:
    """What is done first by who begins in a cell, a line for each; no newline at the end.

    The likeliest actions, with the probability of all that do the same, and the subgoal that is
    most probably pursued. Of many cells only the first are shown.
    """
    told = each.prediction
    outcomes = by_outcome(told.probability, told.same)
    rows = []
    for row, (x, y) in enumerate(each.demonstration.cells[:_SHOWN].tolist()):
        likeliest = np.argsort(-outcomes[row], kind="stable")[:_LIKELIEST]
        actions = ", ".join(
            f"{ACTION_NAMES[told.actions[column]]} {outcomes[row, column]:.2f}"
            for column in likeliest
            if outcomes[row, column] > 0.0
        )
        subgoal = name_of(candidates, int(told.subgoal[row]), grid_map)
        probability = f"{told.subgoal_probability[row]:.2f}"
        rows.append((f"({x}, {y})", actions, subgoal, probability))
    lines = aligned([("begins in", "and does", "going for", "probability"), *rows])
    more = len(each.demonstration) - len(rows)
    return f"{lines}\nand {more} cells more" if more else lines


def name_of(candidates: Candidates, candidate: int, grid_map: GridMap) -> str:
    """A subgoal's cell, or the name of its feature, or its coordinates."""
    coordinates = tuple(candidates.coordinates[candidate].tolist())
    names = grid_map.features.names if candidates.are_features and grid_map.features else {}
    return names.get(coordinates) or f"({', '.join(map(str, coordinates))})"
