"""How good predictions of actions are, and the predictions that need no model.

All are distributions over the actions of a world at each observation of a demonstration. An action
counts by what it does: a move that is blocked is staying.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.inference.prediction import by_outcome, shared_evenly
from bnirl_ros.mdp.grid_world import GridWorld

SMOOTHING = 0.5
"""What is added to every count of what was done in a state, Jeffreys' prior."""

_TIE = 1e-9  # relative; probabilities that differ less are equal but for rounding


@dataclass(frozen=True, eq=False)
class Losses:
    """What a prediction loses at each of N observations.

    Attributes:
        log: (N,) minus the log probability of what was done [nats]; infinite where it was ruled
            out.
        zero_one: (N,) 1 where something else than the most probable was done, else 0; where k are
            equally probable, one of them is taken by chance: 1 - 1 / k.
    """

    log: npt.NDArray[np.float64]
    zero_one: npt.NDArray[np.float64]


def losses(
    probability: npt.NDArray[np.float64], demonstration: Demonstration, world: GridWorld
) -> Losses:
    """What is lost by predicting the actions of a demonstration.

    Args:
        probability: (N, A) of each action of the world, given what was known before it.
        demonstration: N observations, what was really done.
        world: where they were made.
    """
    same, taken = what_was_done(demonstration, world)
    rows = np.arange(len(taken))
    outcomes = by_outcome(probability, same)
    best = outcomes >= outcomes.max(axis=1, keepdims=True) * (1.0 - _TIE)
    with np.errstate(divide="ignore"):
        log_probability = np.log(outcomes[rows, taken])
    return Losses(log=-log_probability, zero_one=1.0 - best[rows, taken] / best.sum(axis=1))


def all_alike(
    learnt: Demonstration, held_out: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(N, A) where all that can be done in a state is equally probable; nothing is learnt."""
    return _by_counts(np.ones((world.state_count, len(world.actions))), held_out, world)


def always_stay(
    learnt: Demonstration, held_out: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(N, A) where staying is certain; nothing is learnt, and any move a loss without bound."""
    counts = np.zeros((world.state_count, len(world.actions)))
    counts[:, 0] = 1.0  # of every set of actions, the first
    return _by_counts(counts, held_out, world)


def frequency(
    learnt: Demonstration, held_out: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(N, A) how often each was done in that state, `SMOOTHING` added to every count."""
    counts = np.full((world.state_count, len(world.actions)), SMOOTHING)
    _, taken = what_was_done(learnt, world)
    np.add.at(counts, (world.states_of(learnt.cells), taken), 1.0)
    return _by_counts(counts, held_out, world)


WITHOUT_MODEL: dict[
    str, Callable[[Demonstration, Demonstration, GridWorld], npt.NDArray[np.float64]]
] = {
    "frequency in the cell": frequency,
    "always stay": always_stay,
    "all alike": all_alike,
}
"""Predictions to hold a model against, from what was learnt to (N, A) of what was held out."""


def what_was_done(
    demonstration: Demonstration, world: GridWorld
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """(N, A) column of the first action that does the same as each, and (N,) that of the taken."""
    same = world.same_action(world.states_of(demonstration.cells))
    columns = np.searchsorted(world.actions, demonstration.action)
    return same, same[np.arange(len(columns)), columns]


def _by_counts(
    counts: npt.NDArray[np.float64], held_out: Demonstration, world: GridWorld
) -> npt.NDArray[np.float64]:
    """(N, A) from counts (S, A), each that of the first action which does the same."""
    states = world.states_of(held_out.cells)
    same = world.same_action(states)
    distinct = same == np.arange(same.shape[1])
    weights = np.where(distinct, counts[states], 0.0)
    return shared_evenly(weights / weights.sum(axis=1, keepdims=True), same)
