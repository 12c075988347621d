"""A thousand candidates: how soon the sampler finds the truth, from two kinds of start.

Found means that every true subgoal has more than twice as many pursuits as any other candidate. It
counts from the first sweep from which that holds in nine of ten sweeps up to the eightieth.
Measured with the seeds here, 0 to 6: from the sampler's own start 7, 4, 3, 6, 10, 12 and 6 sweeps;
from all in one random subgoal 18, 3, 8, 11, 6, none within 60, and 4. Of 23 more demonstrations
with one seed each, all took at most 16 and 24.

Demonstration 5 is another matter, whatever the start: with 30 other seeds of the sampler 10 fail
from its own start and 6 from the worst. There, all pursuits of one subgoal agree on a cell beside
the true one, a local optimum some 5 nats below the truth (by the mode's ascent from either). To
leave it, pursuits would have to go one by one, the first to a subgoal that the urn has never
given, or all at once with their switches where they are, most of which are no arrivals at the true
one.
So it is marked as one that may fail: a known weakness, and work to do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.distance import pdist

from bnirl_ros.inference import pursuit_gibbs
from bnirl_ros.inference.runs import run_counts
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.pursuits import PursuitModel, pursuit_model

WORLD = GridWorld(np.ones((25, 40), dtype=bool))
EPISODES, SUBGOALS = 6, 5
APART = 6.0  # cells between any two subgoals: from neighbours one cell may do for both
CONFIDENCE, SLIP = 3.0, 0.05
SWEEPS, STANDS = 60, 20  # sweeps allowed, and for how many more what was found must stand


@pytest.fixture(scope="module")
def world_model() -> PursuitModel:
    """The model with an observation in every cell, whose values serve all demonstrations."""
    states = np.arange(WORLD.state_count)
    return pursuit_model(WORLD, states, np.zeros(len(states)), states == 0, states)


def demonstrated(
    model: PursuitModel, generator: np.random.Generator
) -> tuple[PursuitModel, npt.NDArray[np.int64]]:
    """Episodes through all true subgoals, each time in another order; and the subgoals.

    Each action is drawn from the model, each step from the world, which goes wrong three times in
    ten.
    """
    goals = np.zeros(SUBGOALS, dtype=np.int64)
    while pdist(WORLD.cells_of(goals)).min() < APART:
        goals = generator.choice(WORLD.state_count, size=SUBGOALS, replace=False)
    outcomes = WORLD.outcomes()
    actions = len(WORLD.actions)
    states, chosen, starts = [], [], []
    for _ in range(EPISODES):
        state = int(generator.integers(WORLD.state_count))
        starts.append(len(states))
        for goal in generator.permutation(goals):
            while state != goal:
                weights = np.exp(-CONFIDENCE * model.cost[state, :, goal])
                weights = (1.0 - SLIP) * weights / weights.sum() + SLIP / actions
                action = generator.choice(actions, p=weights / weights.sum())
                states.append(state)
                chosen.append(action)
                if generator.random() >= WORLD.success:
                    action = generator.choice(np.delete(np.arange(actions), action))
                state = int(outcomes[state, action])
    return replace(
        model,
        state_of=np.array(states),
        action_of=WORLD.same_action(np.array(states))[np.arange(len(states)), chosen],
        starts=np.isin(np.arange(len(states)), starts),
    ), goals


def sweeps_needed(
    model: PursuitModel, goals: npt.NDArray[np.int64], seed: int, worst_start: bool
) -> int:
    """The first sweep from which the truth stands; one more than allowed if there is none."""
    generator = np.random.default_rng(seed)
    state = pursuit_gibbs.initial_state(model, generator)
    if worst_start:
        state.subgoal_of[:] = generator.integers(WORLD.state_count)
        state.counts[:] = 0
        state.counts[state.subgoal_of[0]] = EPISODES
    draws = pursuit_gibbs.room_for(model, (SWEEPS + STANDS,))
    pursuit_gibbs.advance(model, state, generator, draws)
    pursuits = run_counts(draws.subgoal_of, model.starts, len(model.prior))
    least_true = pursuits[:, goals].min(axis=1)
    pursuits[:, goals] = 0
    found = least_true > 2 * pursuits.max(axis=1)
    for sweep in range(SWEEPS):
        if found[sweep] and found[sweep:].mean() >= 0.9:
            return sweep + 1
    return SWEEPS + 1


BESIDE = pytest.mark.xfail(strict=False, reason="may stay in a cell beside a true subgoal")
SEEDS = [0, 1, 2, 3, 4, pytest.param(5, marks=BESIDE), 6]


@pytest.mark.parametrize("worst_start", [False, True], ids=["own start", "worst start"])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_truth_is_found_within_sixty_sweeps(
    world_model: PursuitModel, seed: int, worst_start: bool
) -> None:
    model, goals = demonstrated(world_model, np.random.default_rng(seed))
    assert sweeps_needed(model, goals, seed, worst_start) <= SWEEPS
