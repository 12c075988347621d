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
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from bnirl_ros.baselines import Observed, initialised
from bnirl_ros.baselines.abbeel_ng import solver
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.overcooked import LAYOUTS, MOVES, read_overcooked
from bnirl_ros.experiments.paper.courses import RIVAL_NAMES
from bnirl_ros.experiments.study.intervals import ratio_interval
from bnirl_ros.experiments.study.part import MODELS, SEED, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.inference.posterior import grid_world, infer
from bnirl_ros.inference.prediction import predict, predict_from_mode, shared_evenly
from bnirl_ros.inference.scoring import SMOOTHING, WITHOUT_MODEL, losses, what_was_done
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.grid_world import GridWorld

PREDICTORS = {"predictive": predict, "(19)": predict_from_mode}
"""How a posterior foresees, whichever model it is of."""

NO_MODEL = "no model"
"""What learns nothing, or counts."""

ITERATIONS = {"abbeel_ng": 100, "max_margin": 100, "policy_walk": 2000}
"""Of each rival; with several times as many, its log loss changes by 0.02 nats at most."""

_CONFIDENCES = (1e-4, 1e4)  # sought for the largest difference between values; nats


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
    if learner in RIVAL_NAMES:
        world = grid_world(grid_map, Settings(moves=MOVES))
        values = values_of_rival(learner, learnt, world)
        return {learner: predict_by_values(values, learnt, held_out, world)}
    posterior = infer(learnt, grid_map, settings_of(learner, moves=MOVES))
    return {
        f"{learner}, {name}": predictor(posterior, held_out, grid_map).probability
        for name, predictor in PREDICTORS.items()
    }


def values_of_rival(
    rival: str, learnt: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(S, A) Q* of the reward that a rival finds; its features are the indicators of free cells.

    So its reward may be any function of the cell.

    Raises:
        InputError: a solver that it needs is not installed.
    """
    features = np.eye(world.state_count)[:, world.free.reshape(-1)]
    observed, generator = Observed.of(learnt, world), np.random.default_rng(SEED)
    algorithm = initialised(RIVAL_NAMES[rival], world, observed, features, generator)
    for _ in range(ITERATIONS[RIVAL_NAMES[rival]] - 1):
        algorithm.iterate()
    return algorithm.iterate().action_values


def predict_by_values(
    values: npt.NDArray[np.float64],
    learnt: Demonstration,
    held_out: Demonstration,
    world: GridWorld,
) -> npt.NDArray[np.float64]:
    """(N, A) the softmax of a confidence times Q*; actions that do the same are one action in it.

    The confidence is that under which what was learnt from is most probable. What is most probable
    is the greedy action, whatever the confidence.

    Args:
        values: (S, A) Q*.
        learnt, held_out: to fit the confidence, and to foresee.
        world: where both were made.
    """
    known, taken = world.states_of(learnt.cells), what_was_done(learnt, world)[1]
    rows = np.arange(len(known))

    def mean_loss(log_confidence: float) -> float:
        log_policy = _log_softmax(values, np.exp(log_confidence) / largest, known, world)
        return -float(log_policy[rows, taken].mean())

    largest = np.ptp(values[known], axis=1).max() or 1.0
    fitted = minimize_scalar(mean_loss, bounds=np.log(_CONFIDENCES), method="bounded")
    states = world.states_of(held_out.cells)
    log_policy = _log_softmax(values, np.exp(fitted.x) / largest, states, world)
    return shared_evenly(np.exp(log_policy), world.same_action(states))


def _log_softmax(
    values: npt.NDArray[np.float64],
    confidence: float,
    states: npt.NDArray[np.int64],
    world: GridWorld,
) -> npt.NDArray[np.float64]:
    """(N, A) in the column of the first action that does something; -inf in the others."""
    same = world.same_action(states)
    logits = np.where(same == np.arange(same.shape[1]), confidence * values[states], -np.inf)
    return logits - logsumexp(logits, axis=1, keepdims=True)


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
        "(19): the policy of the most likely subgoal. The three algorithms that the paper "
        "compares with (`bnirl_ros/baselines`) each find one reward, which may be any function of "
        "the cell, and foresee by the softmax of its Q*, with the confidence under which what "
        "they learnt from is most probable. Frequencies are those of what was done in the cell, "
        f"each with {SMOOTHING} added. Of equally probable actions one is taken by chance. To "
        "always stay loses without bound when somebody moves.",
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
        InputError: the recordings are missing, or the solver that a rival needs.
    """
    for layout in LAYOUTS:
        read_overcooked(recordings, layout)
    solver()
    return [
        Case(recordings, layout, learner)
        for learner in (*MODELS, *RIVAL_NAMES, NO_MODEL)
        for layout in LAYOUTS
    ]


PART = Part(name="next-action", cases=cases, run=run, table=table)
