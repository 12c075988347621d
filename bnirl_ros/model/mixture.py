"""The paper's model: a Chinese restaurant process mixture of subgoals over the observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from bnirl_ros.mdp.distinct import distinct
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.process import MarkovDecisionProcess, checked_states
from bnirl_ros.model.likelihood import action_columns, action_log_likelihood


@dataclass(frozen=True, eq=False)
class SubgoalMixture:
    """A CRP mixture over N observations whose partitions each have one of G candidate subgoals.

    Observations with the same state and action are equally likely under every subgoal, so the
    likelihood is kept once for each of the K distinct pairs.

    Attributes:
        log_likelihood: (K, G) float64 log P(O | g), equation (7).
        pair_of: (N,) int64 row of `log_likelihood` for each observation.
        log_prior: (G,) float64 log P(g).
        eta: concentration of the process (5), above 0.
    """

    log_likelihood: npt.NDArray[np.float64]
    pair_of: npt.NDArray[np.int64]
    log_prior: npt.NDArray[np.float64]
    eta: float

    @cached_property
    def scaled_likelihood(self) -> npt.NDArray[np.float64]:
        """(K, G) likelihood over its largest value in the row: in [0, 1], 1 occurs in each row.

        All comparisons between subgoals for one observation are the same on this scale, and the
        weight of a new partition cannot underflow on it.
        """
        return np.exp(self.log_likelihood - self.log_likelihood.max(axis=1, keepdims=True))

    @cached_property
    def new_partition_weight(self) -> npt.NDArray[np.float64]:
        """(K,) eta sum_g P(g) P(O | g), scaled as above: exact, as P(g) is discrete."""
        return self.eta * (self.scaled_likelihood @ np.exp(self.log_prior))

    def log_joint(self, partition_of: npt.ArrayLike, subgoal_of_partition: npt.ArrayLike) -> float:
        """Log of the joint (10) of a partition, its subgoals and the observations.

        Args:
            partition_of: (N,) partition of each observation, numbered from 0 without gaps.
            subgoal_of_partition: (J,) candidate index of each partition's subgoal.
        """
        partition_of = np.asarray(partition_of, dtype=np.int64)
        subgoals = np.asarray(subgoal_of_partition, dtype=np.int64)
        sizes = np.bincount(partition_of, minlength=len(subgoals))
        likelihood = self.log_likelihood[self.pair_of, subgoals[partition_of]].sum()
        return float(likelihood + log_crp(sizes, self.eta) + self.log_prior[subgoals].sum())


def log_crp(sizes: npt.ArrayLike, eta: float) -> float:
    """Log probability of a set partition with these block sizes: the product of (5) in any order.

    eta^J prod_j (n_j - 1)! / prod_{i=1..N} (i - 1 + eta).
    """
    sizes = np.asarray(sizes, dtype=np.int64)
    factorials = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, max(sizes.sum(), 1) + 1)))])
    seats = np.log(np.arange(sizes.sum()) + eta).sum()
    return float(len(sizes) * np.log(eta) + factorials[sizes - 1].sum() - seats)


def subgoal_mixture(
    mdp: MarkovDecisionProcess,
    states: npt.ArrayLike,
    actions: npt.ArrayLike,
    candidates: npt.ArrayLike | Goals,
    alpha: float,
    eta: float,
    policies_in: Callable[[npt.NDArray[np.int64], Goals], npt.NDArray[np.float64]] | None = None,
) -> SubgoalMixture:
    """The paper's model of a demonstration: likelihood (7), P(g) uniform over the candidates.

    Args:
        mdp: the grid world or finite MDP in which the observations were made.
        states: (N,) state number of each observation.
        actions: (N,) its action, one of `mdp.actions`.
        candidates: the goals in the support of P(g), or (G,) state numbers of single ones.
        alpha: confidence; above 0.
        eta: concentration; above 0.
        policies_in: what tells the `log_policies` of goals in states, ascending, where they are
            known; by default they are found, which takes most of the time.

    Raises:
        InputError: there is no such action.
    """
    goals = candidates if isinstance(candidates, Goals) else Goals.of_states(candidates)
    visited, state_of = distinct(checked_states(mdp, states, "state"), mdp.state_count)
    action_count = len(mdp.actions)
    keys = state_of * action_count + action_columns(mdp, actions)
    pairs, pair_of = distinct(keys, len(visited) * action_count)
    policies = (
        policies_in(visited, goals) if policies_in else log_policies(mdp, visited, goals, alpha)
    )
    by_pair = policies.reshape(-1, len(goals))
    return SubgoalMixture(
        log_likelihood=np.ascontiguousarray(by_pair[pairs]),
        pair_of=pair_of,
        log_prior=np.full(len(goals), -np.log(len(goals))),
        eta=eta,
    )


def log_policies(
    mdp: MarkovDecisionProcess, states: npt.NDArray[np.int64], goals: Goals, alpha: float
) -> npt.NDArray[np.float64]:
    """(U, A, G) log P(a | s, g), equation (7), in each of the states (U,)."""
    return action_log_likelihood(goal_values(mdp, goals, states), alpha)
