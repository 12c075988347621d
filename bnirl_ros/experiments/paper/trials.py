"""One run of an experiment: the demonstration, and by what it may be explained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.scenarios import (
    TIE,
    Cell,
    RewardScenario,
    Scenario,
    demonstrate,
    distance_features,
    draw_reward,
    follow_reward,
)
from bnirl_ros.maps.grid_map import FeatureMap
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.mdp.reward_values import action_values, optimal_values
from bnirl_ros.model.candidates import Candidates, candidates_of

VALUE_TOLERANCE = 1e-10
"""Bound on the error of values from which losses are counted: well below `TIE`."""

VARIANTS = ("State", "Feature")
"""What subgoals are: cells (Definition 1), or sets of cells with equal features (3)."""


@dataclass(frozen=True, eq=False)
class Trial:
    """What one run gives to every algorithm.

    Attributes:
        world: the grid world; numbers its cells as states.
        process: the MDP that everybody plans in: the world itself, unless noise is split in
            another way than a grid world's.
        demonstration: the N observations.
        features: of the map's cells, distances (21).
        truth: the true subgoals; none where the demonstrator follows a reward instead.
    """

    world: GridWorld
    process: GridWorld | FiniteMDP
    demonstration: Demonstration
    features: FeatureMap
    truth: tuple[Cell, ...]

    @property
    def feature_matrix(self) -> npt.NDArray[np.float64]:
        """(S, k) features of every state."""
        rows = self.features.coordinates.reshape(self.world.state_count, -1)
        return rows.astype(np.float64)

    @property
    def states(self) -> npt.NDArray[np.int64]:
        """(N,) state of each observation."""
        return self.world.states_of(self.demonstration.cells)

    @property
    def positions(self) -> npt.NDArray[np.int64]:
        """(N,) position of each observation's action among those of the world."""
        return np.searchsorted(self.world.actions, self.demonstration.action)


def trial_of(scenario: Scenario | RewardScenario, run: int) -> Trial:
    """A run of a scenario, from 0; the number is the seed of all that is by chance in it.

    Where subgoals are pursued, features are placed at each of them (section 4.3).
    """
    generator = np.random.default_rng(run)
    truth: tuple[Cell, ...] = ()
    if isinstance(scenario, RewardScenario):
        reward = draw_reward(scenario, generator)
        demonstration = follow_reward(scenario, reward, generator)
        sites = reward.sites
    else:
        demonstration = demonstrate(scenario, generator)
        truth = scenario.subgoals
        sites = np.array(truth, dtype=np.int64)
    features = distance_features(scenario.grid_map, sites)
    return Trial(scenario.world, scenario.process, demonstration, features, truth)


def candidate_subgoals(trial: Trial, variant: str) -> Candidates:
    """The support of P(g) under Proposition 1, for one of `VARIANTS`."""
    features = trial.features if variant == "Feature" else None
    return candidates_of("visited", trial.demonstration, trial.world, features)


def true_subgoals(trial: Trial, variant: str) -> set[tuple[int, ...]]:
    """Cells, or feature coordinates, of the true subgoals."""
    if variant == "State":
        return set(trial.truth)
    return {tuple(trial.features.coordinates[y, x].tolist()) for x, y in trial.truth}


def unmatched(
    values: npt.NDArray[np.float64], positions: npt.NDArray[np.int64]
) -> npt.NDArray[np.bool_]:
    """Whether the demonstrated action is none of the greedy ones: the 0-1 loss of an observation.

    An action is greedy when its value is within `TIE` of the best, so that exact ties, which
    rounding would break in one way or another, do not decide the loss.

    Args:
        values: (N, A) or (N, A, G) values of all actions, of G reward functions, in the states of
            the observations.
        positions: (N,) position of the demonstrated action among the A.

    Returns:
        (N,) or (N, G) bool.
    """
    demonstrated = values[np.arange(len(positions)), positions]
    return np.asarray(demonstrated < values.max(axis=1) - TIE)


def goal_values_of(trial: Trial, goals: Goals) -> npt.NDArray[np.float64]:
    """(N, A, G) values of all actions in the state of each observation, for each goal."""
    visited, index = np.unique(trial.states, return_inverse=True)
    return goal_values(trial.process, goals, visited, VALUE_TOLERANCE)[index]


def reward_range(trial: Trial, reward: npt.NDArray[np.float64]) -> float:
    """Largest less smallest reward (S,) of the free cells."""
    return float(np.ptp(reward[trial.world.free.reshape(-1)]))


def reward_losses(
    trial: Trial, reward: npt.NDArray[np.float64], nearly: npt.NDArray[np.float64]
) -> npt.NDArray[np.bool_]:
    """(N,) 0-1 loss of each observation under one reward for all.

    The reward is scaled so that its range is 1, as that of a subgoal is: `TIE` then means the same
    for every algorithm, whose rewards come in units of their own.

    Args:
        trial: the run.
        reward: (S,) R(s).
        nearly: (S, A) action values under it, to a tolerance that may be larger than `TIE`.
    """
    scale = reward_range(trial, reward) or 1.0  # to a constant one every action is as good
    rewards, start = reward[:, None] / scale, nearly.max(axis=1, keepdims=True) / scale
    values = optimal_values(trial.process, rewards, VALUE_TOLERANCE, start)
    visited, index = np.unique(trial.states, return_inverse=True)
    found = action_values(trial.process, rewards, values, visited)[:, :, 0]
    return unmatched(found[index], trial.positions)
