"""Which action comes next in an episode that was held out: how surely do models foresee it?

What happened in the other episodes is all that is learnt. An action counts by its outcome: a move
that is blocked is staying.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.overcooked import LAYOUTS, MOVES, read_overcooked
from bnirl_ros.experiments.study.part import MODELS, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.inference.posterior import Posterior, grid_world, infer
from bnirl_ros.inference.prediction import log_predictive
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.mixture import subgoal_mixture

SMOOTHING = 0.5
"""What is added to every count of an outcome, Jeffreys' prior."""


class Predictor(Protocol):
    """Foresees the actions of a demonstration that its posterior does not know."""

    def __call__(
        self, posterior: Posterior, held_out: Demonstration, grid_map: GridMap, settings: Settings
    ) -> npt.NDArray[np.float64]:
        """(N,) log P of each action's outcome given its episode so far."""
        ...


def predict_exchangeable(
    posterior: Posterior, held_out: Demonstration, grid_map: GridMap, settings: Settings
) -> npt.NDArray[np.float64]:
    """The paper's posterior predictive: (N,) log sum_g w_g P(a | s, g).

    The urn gives the next observation's subgoal: w_g = (n_g + eta P(g)) / (N + eta), the mean over
    the draws. The held-out observations before it are left out of the counts.
    """
    world = grid_world(grid_map, settings)
    mixture = subgoal_mixture(
        world,
        world.states_of(held_out.cells),
        held_out.action,
        posterior.candidates.goals,
        **settings.fixed,
    )
    drawn = posterior.draws.subgoal_of.reshape(-1)
    count = np.bincount(drawn, minlength=len(posterior.candidates)) / (
        len(drawn) / len(posterior.demonstration)
    )
    prior = np.exp(mixture.log_prior)
    weights = (count + mixture.eta * prior) / (len(posterior.demonstration) + mixture.eta)
    of_action = np.log(np.exp(mixture.log_likelihood) @ weights)[mixture.pair_of]
    # Actions with the same outcome are equally probable.
    return np.asarray(of_action + np.log(actions_alike(held_out, world)))


def predict_in_sequence(
    posterior: Posterior, held_out: Demonstration, grid_map: GridMap, settings: Settings
) -> npt.NDArray[np.float64]:
    """(N,) the sequential model's prediction, to which such actions are one action."""
    return log_predictive(posterior, held_out, grid_map)


PREDICTORS: dict[str, Predictor] = {
    "sequential": predict_in_sequence,
    "paper": predict_exchangeable,
}
"""How each model foresees. A model that none is given for has no row."""


def outcomes_of(demonstration: Demonstration, world: GridWorld) -> npt.NDArray[np.int64]:
    """(N, 2) state, and the state to which its action leads when it succeeds."""
    states = world.states_of(demonstration.cells)
    positions = np.searchsorted(world.actions, demonstration.action)
    return np.column_stack([states, world.outcomes()[states, positions]])


def actions_alike(demonstration: Demonstration, world: GridWorld) -> npt.NDArray[np.int64]:
    """(N,) how many actions of its state have the outcome of an observation's own."""
    states, outcomes = outcomes_of(demonstration, world).T
    return np.asarray((world.outcomes()[states] == outcomes[:, None]).sum(axis=1))


def predict_uniform(
    learnt: Demonstration, held_out: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(N,) log P of each outcome where all those of its state are equally probable."""
    possible = [len(set(row)) for row in world.outcomes()[world.states_of(held_out.cells)]]
    return -np.log(possible)


def predict_frequency(
    learnt: Demonstration, held_out: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(N,) log P of each outcome by how often it was seen in its state, `SMOOTHING` added."""
    seen = np.zeros((world.state_count, world.state_count))
    np.add.at(seen, tuple(outcomes_of(learnt, world).T), 1.0)
    states, outcomes = outcomes_of(held_out, world).T
    possible = np.exp(-predict_uniform(learnt, held_out, world))
    share = (seen[states, outcomes] + SMOOTHING) / (
        seen[states].sum(axis=1) + SMOOTHING * possible
    )
    return np.asarray(np.log(share))


BASELINES: dict[str, Callable[..., npt.NDArray[np.float64]]] = {
    "all outcomes alike": predict_uniform,
    "frequency in the state": predict_frequency,
}
"""Predictions that need no model."""


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
    """A prediction for a layout: by a model or by one of `BASELINES`."""

    recordings: Path
    layout: str
    by: str


def run(case: Case) -> dict[str, Any]:
    """The mean log loss of the outcomes in the held-out trials [nats]."""
    demonstration, grid_map = read_overcooked(case.recordings, case.layout)
    learnt, held_out = split_trials(demonstration)
    if case.by in BASELINES:
        world = grid_world(grid_map, Settings(moves=MOVES))
        foreseen = BASELINES[case.by](learnt, held_out, world)
    else:
        settings = settings_of(case.by, moves=MOVES)
        posterior = infer(learnt, grid_map, settings)
        foreseen = PREDICTORS[case.by](posterior, held_out, grid_map, settings)
    return {
        "layout": case.layout,
        "by": case.by,
        "learnt": len(learnt),
        "held_out": len(held_out),
        "log_loss": float(-foreseen.mean()),
        "log_loss_of_trial": {
            int(trial): float(-foreseen[held_out.episode // 2 == trial].mean())
            for trial in np.unique(held_out.episode // 2)
        },
    }


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each prediction, a column for each layout."""
    loss = {(result["by"], result["layout"]): result["log_loss"] for result in results}
    held_out = {result["layout"]: result["held_out"] for result in results}
    counts = ", ".join(f"{held_out[layout]:,} in `{layout}`" for layout in LAYOUTS)
    return Table(
        title="The next action of people that were not seen before",
        text="Mean log loss of the next action in human play, in nats: less is better. Learnt "
        f"from every second trial, measured on the actions of the others ({counts}). An action "
        "counts by the cell that it leads to, so a blocked move is staying. Frequencies are those "
        f"of the outcome in its state, each with {SMOOTHING} added.",
        header=("foreseen by", *(f"`{layout}`" for layout in LAYOUTS)),
        rows=tuple(
            (by, *(f"{loss[by, layout]:.3f}" for layout in LAYOUTS))
            for by in dict.fromkeys(by for by, _ in loss)
        ),
    )


def cases(recordings: Path) -> Sequence[Case]:
    """Every prediction for every layout.

    Raises:
        InputError: the recordings are missing.
    """
    for layout in LAYOUTS:
        read_overcooked(recordings, layout)
    models = [model for model in MODELS if model in PREDICTORS]
    return [Case(recordings, layout, by) for by in (*BASELINES, *models) for layout in LAYOUTS]


PART = Part(name="next-action", cases=cases, run=run, table=table)
