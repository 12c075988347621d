"""What the algorithms have in common: what they are given, and what each iteration gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.mdp.grid_world import GridWorld


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations (s_i, a_i) of equation (4), as state numbers and positions of actions.

    Attributes:
        states: (N,) int64 state in which each action was chosen.
        actions: (N,) int64 position of the action in the MDP's `actions`.
        episode: (N,) int64 episode of each observation. The observations of an episode stand
            together, in the order in which they were made.
        last_states: (L,) int64 states in which episodes ended, where they are known: visited,
            though no action was taken there.

    Raises:
        ValueError: there is no observation, the arrays differ in length, or an episode's
            observations do not stand together.
    """

    states: npt.NDArray[np.int64]
    actions: npt.NDArray[np.int64]
    episode: npt.NDArray[np.int64]
    last_states: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if not self.states.shape == self.actions.shape == self.episode.shape == (len(self),):
            raise ValueError("states, actions and episode must all have the shape (N,)")
        if not len(self):
            raise ValueError("there must be at least one observation")
        if len(self.first) != len(np.unique(self.episode)):
            raise ValueError("the observations of an episode must stand together")

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def of(cls, demonstration: Demonstration, world: GridWorld) -> Observed:
        """What a demonstration in a grid world shows.

        Raises:
            ValueError: there is no observation, or an action is none of the world's.
        """
        if not np.isin(demonstration.action, world.actions).all():
            raise ValueError("an action of the demonstration is none of the world's")
        return cls(
            states=world.states_of(demonstration.cells),
            actions=np.searchsorted(world.actions, demonstration.action),
            episode=demonstration.episode,
            last_states=world.states_of(demonstration.last_cells),
        )

    @property
    def first(self) -> npt.NDArray[np.int64]:
        """(E,) index of the first observation of each episode."""
        return np.flatnonzero(np.diff(self.episode, prepend=self.episode[:1] - 1))

    @property
    def lengths(self) -> npt.NDArray[np.int64]:
        """(E,) number of observations of each episode."""
        return np.diff(self.first, append=len(self))

    def weights(self, discount: float) -> npt.NDArray[np.float64]:
        """(N,) gamma^t of each observation, t counted from the start of its episode; sum 1.

        So a sum with them is a mean over episodes and a mean over time. The usual discounted sum
        is the same but for a factor, which would give margins and losses another unit in each
        demonstration.
        """
        steps = np.arange(len(self)) - np.repeat(self.first, self.lengths)
        weights = discount ** steps.astype(np.float64)
        return np.asarray(weights / weights.sum())


@dataclass(frozen=True, eq=False)
class Estimate:
    """What an iteration gives back: a reward, and what it says of every action.

    Attributes:
        reward: (S,) float64 R(s), linear in the features that were given.
        action_values: (S, A) float64 Q*(s, a, R) under it.
    """

    reward: npt.NDArray[np.float64]
    action_values: npt.NDArray[np.float64]


class Rival(Protocol):
    """An algorithm of the form of Algorithm 1 (Michini & How 2012).

    Its constructor is what Table 1 there calls initialisation.
    """

    def iterate(self) -> Estimate:
        """Do one iteration of step 2."""
        ...
