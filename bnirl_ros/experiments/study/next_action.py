"""Which action comes next in an episode that was held out: how surely do models foresee it?

What happened in the other episodes is all that is learnt. An action counts by what it does: a move
that is blocked is staying.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.overcooked import LAYOUTS, MOVES, read_overcooked
from bnirl_ros.experiments.study.intervals import ratio_interval
from bnirl_ros.experiments.study.part import MODELS, SEED, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.inference.posterior import grid_world, infer
from bnirl_ros.inference.prediction import predict, predict_from_mode
from bnirl_ros.inference.scoring import SMOOTHING, WITHOUT_MODEL, losses
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap

PREDICTORS = {"predictive": predict, "(19)": predict_from_mode}
"""How a posterior foresees, whichever model it is of."""

NO_MODEL = "no model"
"""What learns nothing, or counts."""


def split_trials(demonstration: Demonstration) -> tuple[Demonstration, Demonstration]:
    """The trials with even numbers, to learn from, and those with odd ones.

    A trial is the two episodes 2k and 2k + 1 of its players. These stay together: they may be in
    kitchens without a way from one to the other, and are then never in the same states.
    """
    episodes = np.unique(demonstration.episode)
    is_odd = episodes // 2 % 2 == 1
    learnt, held_out = episodes[~is_odd], episodes[is_odd]
    return demonstration.of_episodes(learnt), demonstration.of_episodes(held_out)


@dataclass(frozen=True)
class Case:
    """The predictions for a layout that come from one inference, or from none (`NO_MODEL`)."""

    recordings: Path
    layout: str
    learner: str


def foreseen_by(
    learner: str, learnt: Demonstration, held_out: Demonstration, grid_map: GridMap
) -> dict[str, npt.NDArray[np.float64]]:
    """(N, A) what each prediction of a learner says of the actions that were held out."""
    if learner == NO_MODEL:
        world = grid_world(grid_map, Settings(moves=MOVES))
        return {
            name: prediction(learnt, held_out, world) for name, prediction in WITHOUT_MODEL.items()
        }
    posterior = infer(learnt, grid_map, settings_of(learner, moves=MOVES))
    return {
        f"{learner}, {name}": predictor(posterior, held_out, grid_map).probability
        for name, predictor in PREDICTORS.items()
    }


def run(case: Case) -> dict[str, Any]:
    """The mean losses of the actions in the held-out trials, with intervals over the trials."""
    demonstration, grid_map = read_overcooked(case.recordings, case.layout)
    learnt, held_out = split_trials(demonstration)
    world = grid_world(grid_map, Settings(moves=MOVES))
    trial = held_out.episode // 2
    foreseen = foreseen_by(case.learner, learnt, held_out, grid_map)
    lost = {by: losses(values, held_out, world) for by, values in foreseen.items()}
    return {
        "layout": case.layout,
        "learnt": len(learnt),
        "held_out": len(held_out),
        "trials": len(np.unique(trial)),
        "loss": {
            by: {"log": of_trials(each.log, trial), "0-1": of_trials(each.zero_one, trial)}
            for by, each in lost.items()
        },
    }


def of_trials(
    loss: npt.NDArray[np.float64], trial: npt.NDArray[np.int64]
) -> tuple[float, float, float] | None:
    """Mean loss of an action, and its 95 % interval; None where it is infinite.

    Trials are what is drawn again, since the actions of one are no trials of their own.
    """
    if not np.isfinite(loss).all():
        return None
    _, number = np.unique(trial, return_inverse=True)
    counts = np.bincount(number)
    generator = np.random.default_rng(SEED)
    interval = ratio_interval(np.bincount(number, weights=loss), counts, generator)
    return float(loss.mean()), *interval


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each prediction, two columns for each layout."""
    loss = {
        (by, result["layout"]): lost for result in results for by, lost in result["loss"].items()
    }
    size = {result["layout"]: (result["held_out"], result["trials"]) for result in results}
    counts = ", ".join(
        f"{size[layout][0]:,} of {size[layout][1]} trials in `{layout}`" for layout in LAYOUTS
    )
    return Table(
        title="The next action of people that were not seen before",
        text="Mean losses of the next action in human play, with 95 % intervals (bootstrap over "
        "trials): less is better. Above the log loss in nats, below the 0-1 loss, the share of "
        "actions that were not the most probable one, in per cent. Learnt from every second "
        f"trial, measured on the actions of the others ({counts}). An action counts by the cell "
        "that it leads to, so a blocked move is staying. Predictive: the posterior predictive; "
        "(19): the policy of the most likely subgoal. Frequencies are those of what was done in "
        f"the cell, each with {SMOOTHING} added. Of equally probable actions one is taken by "
        "chance. To always stay loses without bound, whenever somebody moves.",
        header=("foreseen by", "loss", *(f"`{layout}`" for layout in LAYOUTS)),
        rows=tuple(
            (by, name, *(_cell(loss[by, layout][kind], scale) for layout in LAYOUTS))
            for kind, name, scale in (("log", "log", 1), ("0-1", "0-1 [%]", 100))
            for by in dict.fromkeys(by for by, _ in loss)
        ),
    )


def _cell(values: tuple[float, float, float] | None, scale: int) -> str:
    """A mean with its interval, in per cent where that is the scale."""
    if values is None:
        return "infinite"
    mean, low, high = (f"{scale * value:.{1 if scale > 1 else 3}f}" for value in values)
    return f"{mean} ({low}-{high})"


def cases(recordings: Path) -> Sequence[Case]:
    """Every learner for every layout.

    Raises:
        InputError: the recordings are missing.
    """
    for layout in LAYOUTS:
        read_overcooked(recordings, layout)
    return [
        Case(recordings, layout, learner) for learner in (*MODELS, NO_MODEL) for layout in LAYOUTS
    ]


PART = Part(name="next-action", cases=cases, run=run, table=table)
