"""Maximum margin planning: Ratliff, Bagnell & Zinkevich (2006), by their subgradient method.

N. D. Ratliff, J. A. Bagnell and M. A. Zinkevich, "Maximum margin planning", Proceedings of the
23rd International Conference on Machine Learning, 2006.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bnirl_ros.baselines.linear_rewards import LinearRewards
from bnirl_ros.baselines.rival import Estimate, Observed
from bnirl_ros.mdp.process import MarkovDecisionProcess


class MaximumMarginPlanning:
    """Weights under which the demonstrator beats every other plan by as much as they differ.

    The objective, to be minimised, is

        c(w) = max over plans mu of (w phi + l) . mu - w phi . mu_E + (lambda / 2) |w|^2,

    with frequencies mu of the states, the loss l(s) of 1 in states that the demonstrator never
    visited and 0 in the others (section 4.2 of Michini & How 2012), and means over the episodes.
    It is convex, and not smooth. Their paper minimises it by the subgradient method, rather than
    by the quadratic program with all plans' constraints, and so do we: an iteration plans under
    the reward with the loss added, which gives mu*, and goes a step of 1 / (lambda t) against the
    subgradient phi (mu* - mu_E) + lambda w. That is the step for objectives that are as strongly
    convex as lambda |w|^2 / 2. The points it comes to jump about the minimum, so the reward is
    that of their mean, each weighted by its number (Lacoste-Julien, Schmidt & Bach, "A simpler
    approach to obtaining an O(1/t) convergence rate for the projected stochastic subgradient
    method", 2012).

    Episodes end, so mu_E are discounted counts of a few states, gamma^t each. Only plans of the
    same length have frequencies of the same polytope, whose sums are equal. So each episode is
    compared with plans from its first state over as many steps as it has observations, by
    backward induction. Compared with plans for ever, w would have to explain why the
    demonstrator is nowhere when its episode is over.

    Attributes:
        weights: (k,) float64 w, the mean of the points, of features divided by their largest
            absolute value.
        objective: c of the point from which the last iteration went; infinite at first.
    """

    def __init__(
        self,
        mdp: MarkovDecisionProcess,
        observed: Observed,
        features: npt.NDArray[np.float64],
        regularisation: float = 0.003,
    ) -> None:
        """Count how often the demonstrator met each feature.

        Args:
            mdp: the process, without reward.
            observed: what the demonstrator did.
            features: (S, k) float64 phi.
            regularisation: lambda, above 0. The objective's first two terms are means over time,
                so it needs not be chosen anew for episodes of another length. Of 0.03, 0.01, 0.003
                and 0.001, the default and the last had the smallest policy loss on simulated
                demonstrators of section 4.2.

        Raises:
            ValueError: `features` or `observed` does not fit the process, or `regularisation` is
                not above 0.
        """
        if not regularisation > 0.0:
            raise ValueError(f"regularisation must be above 0, not {regularisation}")
        self._linear = LinearRewards.of(mdp, observed, features)
        self._regularisation = regularisation
        self._starts = observed.states[observed.first]
        self._lengths = observed.lengths
        time_weights = observed.weights(mdp.discount)
        self._demonstrated = time_weights @ self._linear.features[observed.states]
        # Sums over plans become means over time by the factor that made the demonstrator's so.
        self._share = time_weights[0]
        self._loss = np.ones(mdp.state_count)
        self._loss[observed.states] = 0.0
        self._loss[observed.last_states] = 0.0
        self._iterations = 0
        self._expectations = self._linear.expectations(self._linear.any_move())
        self._point = np.zeros(self._linear.feature_count)
        self.weights = self._point
        self.objective = np.inf

    def iterate(self) -> Estimate:
        """Plan under the reward with the loss added, and step against the subgradient."""
        self.objective, subgradient = self.objective_at(self._point)
        self._iterations += 1
        count = self._iterations
        self._point = self._point - subgradient / (self._regularisation * count)
        self.weights = self.weights + (self._point - self.weights) * 2.0 / (count + 1)
        estimate = self._linear.estimate(self.weights, self._expectations)
        policy = estimate.action_values.argmax(axis=1)
        self._expectations = self._linear.expectations(self._linear.moves_of(policy))
        return estimate

    def objective_at(
        self, weights: npt.NDArray[np.float64]
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """c(w) at the weights (k,), and a subgradient (k,) there."""
        reward = self._linear.features @ weights + self._loss
        value, planned = plan(self._linear, reward, self._starts, self._lengths)
        objective = (
            self._share * value
            - weights @ self._demonstrated
            + 0.5 * self._regularisation * weights @ weights
        )
        subgradient = self._share * planned - self._demonstrated + self._regularisation * weights
        return float(objective), subgradient


def plan(
    linear: LinearRewards,
    reward: npt.NDArray[np.float64],
    starts: npt.NDArray[np.int64],
    lengths: npt.NDArray[np.int64],
) -> tuple[float, npt.NDArray[np.float64]]:
    """The best plans from each start, of as many steps as its length, by backward induction.

    Args:
        linear: the process and its features.
        reward: (S,) R(s), discounted from the start of the plan.
        starts: (E,) states.
        lengths: (E,) numbers of steps, above 0.

    Returns:
        Summed over the starts, the value of the plans and their feature expectations (k,).
    """
    values = np.zeros(len(reward))
    expectations = np.zeros_like(linear.features)
    value, expected = 0.0, np.zeros(linear.feature_count)
    for steps in range(1, int(lengths.max()) + 1):
        choices = linear.backup(reward, values)
        moves = linear.moves_of(choices.argmax(axis=1))
        values = choices.max(axis=1)
        expectations = linear.features + linear.mdp.discount * (moves @ expectations)
        begun = starts[lengths == steps]
        value += float(values[begun].sum())
        expected += expectations[begun].sum(axis=0)
    return value, expected
