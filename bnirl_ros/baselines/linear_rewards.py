"""An MDP whose reward is linear in features of the states: what all three algorithms search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, identity, vstack
from scipy.sparse.linalg import splu

from bnirl_ros.baselines.rival import Estimate, Observed
from bnirl_ros.mdp.process import MarkovDecisionProcess
from bnirl_ros.mdp.reward_values import action_values, optimal_values


@dataclass(frozen=True, eq=False)
class LinearRewards:
    """Rewards R(s) = w phi(s), and what a policy may expect of each feature.

    Each feature is divided by its largest absolute value. Rewards and policies are the same, but
    the norm of w, by which two of the algorithms choose, and the grid of the third then do not
    depend on the features' units; and the quadratic programs are well scaled.

    Build one with `LinearRewards.of`.

    Attributes:
        mdp: the process.
        features: (S, k) float64 phi, each within -1 and 1.
        transitions: (A S, S) sparse; row a S + s holds T(s, a, .).
    """

    mdp: MarkovDecisionProcess
    features: npt.NDArray[np.float64]
    transitions: Any

    @classmethod
    def of(
        cls, mdp: MarkovDecisionProcess, observed: Observed, features: npt.NDArray[np.float64]
    ) -> LinearRewards:
        """From features (S, k) in any units.

        Raises:
            ValueError: features have another shape or are not finite, or what was observed is
                none of the MDP's states or actions.
        """
        given = np.asarray(features, dtype=np.float64)
        if given.ndim != 2 or len(given) != mdp.state_count or not given.shape[1]:
            raise ValueError(f"features must be ({mdp.state_count}, k) with k at least 1")
        if not np.isfinite(given).all():
            raise ValueError("features must be finite")
        states = np.concatenate([observed.states, observed.last_states])
        if states.min() < 0 or states.max() >= mdp.state_count:
            raise ValueError(f"a state lies outside the {mdp.state_count} of the MDP")
        if observed.actions.min() < 0 or observed.actions.max() >= len(mdp.actions):
            raise ValueError(f"an action is none of the {len(mdp.actions)} of the MDP")
        largest = np.abs(given).max(axis=0)
        return cls(
            mdp=mdp,
            features=given / np.where(largest > 0.0, largest, 1.0),
            transitions=csr_array(vstack(mdp.transitions(), format="csr")),
        )

    @property
    def feature_count(self) -> int:
        """Number of features k."""
        return self.features.shape[1]

    def estimate(
        self, weights: npt.NDArray[np.float64], expectations: npt.NDArray[np.float64]
    ) -> Estimate:
        """The reward with these weights (k,), and Q* under it.

        Args:
            weights: w.
            expectations: (S, k) those of some policy, the nearer to optimal the better. Its
                values under w, a product, are where value iteration begins. They have the level
                of V* already, which value iteration finds last: by a factor of gamma a sweep.
        """
        reward = self.features @ weights
        values = optimal_values(
            self.mdp, reward[:, None], start=(expectations @ weights)[:, None]
        )[:, 0]
        return Estimate(reward, self.backup(reward, values))

    def backup(
        self, reward: npt.NDArray[np.float64], values: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Q(s, a) (S, A) of a reward (S,) now and values (S,) from the next state on."""
        states = np.arange(self.mdp.state_count)
        return action_values(self.mdp, reward[:, None], values[:, None], states)[:, :, 0]

    def moves_of(self, policy: npt.NDArray[np.int64]) -> Any:
        """(S, S) sparse T(s, pi(s), .) of a policy (S,), given as positions of actions."""
        state_count = self.mdp.state_count
        return self.transitions[policy * state_count + np.arange(state_count)]

    def any_move(self) -> Any:
        """(S, S) sparse transitions of the policy that takes every action equally often."""
        action_count = len(self.mdp.actions)
        return sum(self.mdp.transitions()) / action_count

    def expectations(self, moves: Any) -> npt.NDArray[np.float64]:
        """Feature expectations mu(s) = E[sum_t gamma^t phi(s_t) | s_0 = s] (S, k), exactly.

        They are the values of a policy with the transitions `moves` (S, S), one feature at a time
        (Abbeel & Ng 2004, section 3): (I - gamma T) mu = phi.
        """
        system = identity(self.mdp.state_count, format="csc") - self.mdp.discount * moves
        return np.asarray(splu(system.tocsc()).solve(self.features))

    def expectations_after(
        self,
        expectations: npt.NDArray[np.float64],
        states: npt.NDArray[np.int64],
        actions: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.float64]:
        """(N, k) feature expectations of taking each action in its state, then as expected."""
        rows = self.transitions[actions * self.mdp.state_count + states]
        return np.asarray(self.features[states] + self.mdp.discount * (rows @ expectations))
