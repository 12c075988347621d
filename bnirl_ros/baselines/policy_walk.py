"""Bayesian inverse reinforcement learning: Ramachandran & Amir (2007), the PolicyWalk sampler.

D. Ramachandran and E. Amir, "Bayesian inverse reinforcement learning", Proceedings of the 20th
International Joint Conference on Artificial Intelligence, 2007; figure 3 is the sampler.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.baselines.linear_rewards import LinearRewards
from bnirl_ros.baselines.rival import Estimate, Observed
from bnirl_ros.mdp.process import MarkovDecisionProcess

_SLACK = 1e-10
"""Share of the largest possible value by which an action must be better: less is rounding."""


@dataclass(frozen=True, eq=False)
class _Place:
    """Where the walk is: weights on the grid, and a policy that is optimal under them.

    Attributes:
        levels: (k,) int64 weights in steps of the grid.
        policy: (S,) int64 positions of actions.
        expectations: (S, k) feature expectations of the policy.
        expectations_after: (S, A, k) those after each action, with which the values Q of the
            policy under any other weights are a product.
        log_likelihood: of all observations; the prior is uniform, so log posterior as well.
    """

    levels: npt.NDArray[np.int64]
    policy: npt.NDArray[np.int64]
    expectations: npt.NDArray[np.float64]
    expectations_after: npt.NDArray[np.float64]
    log_likelihood: float


class PolicyWalk:
    """A random walk over the weights whose stationary distribution is their posterior.

    The prior is uniform over the grid of step delta in [-1, 1]^k; theirs is over rewards, of which
    ours are those that the features allow. The likelihood is the softmax (7) of alpha Q*(s, a, R),
    a product over the observations. An iteration is one step of the walk: one of the 2 k
    neighbours is proposed, each as likely, and taken with the probability of Metropolis; the walk
    stays where the neighbour lies outside the prior's support.

    The policy is kept until its own values Q under the proposed weights show an action that is
    better. Until then they are Q*, and cost one product instead of a solution of the MDP.

    The estimate is the most probable of the weights that the walk has visited. Its values Q* are
    at hand. Their Theorem 3 has the posterior mean in its place, under which the expected loss is
    smallest; but the paper looks at the first 50 to 100 steps, of a walk that begins anywhere, and
    a mean of those is a mean of the way to where the posterior is. On twelve simulated cases of
    section 4.2, the mean's policy loss was 43 after 100 steps, and that of the best weights 5, of
    75 observations; after 200 steps 20 and 0.

    Attributes:
        weights: (k,) float64 w where the walk is, of features divided by their largest absolute
            value. Collected over the iterations, they are draws from the posterior.
        log_likelihood: of all observations under the values Q* of these weights; but for a
            constant, their log posterior.
    """

    def __init__(
        self,
        mdp: MarkovDecisionProcess,
        observed: Observed,
        features: npt.NDArray[np.float64],
        generator: np.random.Generator,
        confidence: float = 50.0,
        steps_to_one: int = 5,
    ) -> None:
        """Draw the weights with which the walk begins from the prior, and solve their MDP.

        Args:
            mdp: the process, without reward.
            observed: what the demonstrator did.
            features: (S, k) float64 phi.
            generator: from which all draws are made.
            confidence: alpha in (7), for features divided by their largest absolute value.
            steps_to_one: 1 / delta; the weights are whole multiples of delta between -1 and 1.
                The default needs about 100 steps on section 4.2, as the paper says; half of delta
                needs twice as many.

        Raises:
            ValueError: `features` or `observed` does not fit the process, or a parameter is not
                above 0.
        """
        if not confidence > 0.0 or steps_to_one < 1:
            raise ValueError("confidence and steps_to_one must be above 0")
        self._linear = LinearRewards.of(mdp, observed, features)
        self._generator = generator
        self._confidence = confidence
        self._steps_to_one = steps_to_one
        self._pairs, self._counts = np.unique(
            np.stack([observed.states, observed.actions]), axis=1, return_counts=True
        )
        draws = generator.random(self._linear.feature_count)
        levels = (draws * (2 * steps_to_one + 1)).astype(np.int64) - steps_to_one
        start = self._linear.expectations(self._linear.any_move())
        self._place = self._solved(levels, start)
        self._best = self._place

    @property
    def weights(self) -> npt.NDArray[np.float64]:
        return self._place.levels / self._steps_to_one

    @property
    def log_likelihood(self) -> float:
        return self._place.log_likelihood

    def iterate(self) -> Estimate:
        """Go or stay, and give the best place so far."""
        proposed = self._neighbour()
        # Drawn whether or not it is needed, so that each iteration takes as many.
        threshold = np.log(1.0 - self._generator.random())
        if np.abs(proposed).max() <= self._steps_to_one:
            place = self._moved(proposed)
            if threshold < place.log_likelihood - self._place.log_likelihood:
                self._place = place
        if self._place.log_likelihood > self._best.log_likelihood:
            self._best = self._place
        weights = self._best.levels / self._steps_to_one
        return Estimate(
            reward=self._linear.features @ weights,
            action_values=self._best.expectations_after @ weights,
        )

    def _neighbour(self) -> npt.NDArray[np.int64]:
        """(k,) levels one step from the walk's in one feature, up or down."""
        feature, up = divmod(int(self._generator.random() * 2 * self._linear.feature_count), 2)
        levels = self._place.levels.copy()
        levels[feature] += 1 if up else -1
        return levels

    def _moved(self, levels: npt.NDArray[np.int64]) -> _Place:
        """The place with these levels, with the policy of the walk's as long as it is optimal."""
        place = self._place
        values = place.expectations_after @ (levels / self._steps_to_one)
        if self._improvable(values, place.policy, levels).any():
            return self._solved(levels, place.expectations)
        return _Place(
            levels,
            place.policy,
            place.expectations,
            place.expectations_after,
            self._log_likelihood(values),
        )

    def _solved(
        self, levels: npt.NDArray[np.int64], expectations: npt.NDArray[np.float64]
    ) -> _Place:
        """The place with these levels; `expectations` (S, k) are those of a policy near by."""
        linear = self._linear
        weights = levels / self._steps_to_one
        policy = linear.estimate(weights, expectations).action_values.argmax(axis=1)
        while True:
            expectations = linear.expectations(linear.moves_of(policy))
            after = self._after(expectations)
            values = after @ weights
            improvable = self._improvable(values, policy, levels)
            if not improvable.any():
                return _Place(levels, policy, expectations, after, self._log_likelihood(values))
            # Value iteration ends within its tolerance; policy iteration goes the rest of the way.
            policy = np.where(improvable, values.argmax(axis=1), policy)

    def _after(self, expectations: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(S, A, k) feature expectations after each action in each state."""
        linear = self._linear
        state_count, action_count = linear.mdp.state_count, len(linear.mdp.actions)
        states = np.repeat(np.arange(state_count), action_count)
        actions = np.tile(np.arange(action_count), state_count)
        after = linear.expectations_after(expectations, states, actions)
        return after.reshape(state_count, action_count, -1)

    def _improvable(
        self,
        values: npt.NDArray[np.float64],
        policy: npt.NDArray[np.int64],
        levels: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.bool_]:
        """(S,) where an action has a larger value Q (S, A) of the policy than the policy's own."""
        largest = np.abs(levels).sum() / self._steps_to_one / (1.0 - self._linear.mdp.discount)
        own = np.take_along_axis(values, policy[:, None], axis=1)[:, 0]
        return np.asarray(values.max(axis=1) > own + _SLACK * largest)

    def _log_likelihood(self, values: npt.NDArray[np.float64]) -> float:
        """Log likelihood (7) of all observations under the values Q* (S, A)."""
        states, actions = self._pairs
        logits = self._confidence * (values[states] - values[states].max(axis=1, keepdims=True))
        log_sums = np.log(np.exp(logits).sum(axis=1))
        return float(self._counts @ (logits[np.arange(len(states)), actions] - log_sums))
