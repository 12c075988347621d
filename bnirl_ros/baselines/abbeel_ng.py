"""Apprenticeship learning by a maximum margin: Abbeel & Ng (2004), the quadratic program.

P. Abbeel and A. Y. Ng, "Apprenticeship learning via inverse reinforcement learning", Proceedings
of the 21st International Conference on Machine Learning, 2004; section 3, with the program (10)
to (12).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix

from bnirl_ros.baselines.linear_rewards import LinearRewards
from bnirl_ros.baselines.rival import Estimate, Observed
from bnirl_ros.errors import InputError
from bnirl_ros.mdp.process import MarkovDecisionProcess

SMALLEST_MARGIN = 1e-8
"""A margin below which the demonstrator is as good as a mixture of the policies found.

In the features' largest absolute value.
"""

_TOLERANCE = 1e-10  # of the program; the solver reaches it, or says that it almost did


class AbbeelNg:
    """Weights under which the demonstrator does better than every policy found so far.

    An iteration chooses w within the unit ball so that the smallest margin by which the
    demonstrator's feature expectations mu_E beat those of the policies found is the largest, and
    adds the policy that is optimal under w. The reward is always the current w. When the margin
    t is 0, mu_E is a mixture of the policies' and the algorithm has ended: it stays with the
    reward that it has.

    The first policy, which theirs draws at random, takes every action equally often.

    mu_E - mu(pi) is what the program needs, and is estimated from episodes that end and that noise
    has carried about:

    - After its last observation, an episode goes on as pi would. What nobody has seen tells the
      demonstrator from no policy. A sum that just ends there would compare 15 actions with
      infinitely many; ended at the same time, the policies would be compared on what they were
      not made for.
    - What the moves of the demonstrator came to by luck is taken out. The difference is the mean
      of sum_t gamma^t (mu(s_t, a_t) - mu(s_t)), with mu of pi (the performance difference lemma,
      Kakade & Langford 2002): it needs what was done, and T, but not what happened. With the luck
      in it, mu_E lies outside of what any policy attains. w then separates the luck, and the final
      loss is not 0 even where the reward is linear in the features.

    Both are the sums that Abbeel & Ng write, in expectation and as episodes become long.

    Attributes:
        weights: (k,) float64 w, of features divided by their largest absolute value.
        margin: t, by how much the demonstrator was better under w than every policy found before
            w; as a mean over time, in the features' largest absolute value. Infinite at first.
    """

    def __init__(
        self,
        mdp: MarkovDecisionProcess,
        observed: Observed,
        features: npt.NDArray[np.float64],
    ) -> None:
        """Find the feature expectations of the first policy.

        Args:
            mdp: the process, without reward.
            observed: what the demonstrator did.
            features: (S, k) float64 phi.

        Raises:
            InputError: the solver of quadratic programs is not installed.
            ValueError: `features` or `observed` does not fit the process.
        """
        solver()
        self._linear = LinearRewards.of(mdp, observed, features)
        self._observed = observed
        self._expectations = self._linear.expectations(self._linear.any_move())
        self._differences = [expected_difference(self._linear, observed, self._expectations)]
        self.weights = np.zeros(self._linear.feature_count)
        self.margin = np.inf
        self._estimate = self._linear.estimate(self.weights, self._expectations)

    def iterate(self) -> Estimate:
        """Choose w by the quadratic program, and find its optimal policy."""
        weights, self.margin = maximum_margin(np.stack(self._differences))
        if self.margin <= SMALLEST_MARGIN:
            return self._estimate
        self.weights = weights
        self._estimate = self._linear.estimate(weights, self._expectations)
        policy = self._estimate.action_values.argmax(axis=1)
        self._expectations = self._linear.expectations(self._linear.moves_of(policy))
        self._differences.append(
            expected_difference(self._linear, self._observed, self._expectations)
        )
        return self._estimate


def expected_difference(
    linear: LinearRewards, observed: Observed, expectations: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """mu_E - mu(pi) (k,), a mean over time, as `AbbeelNg` estimates it.

    Args:
        linear: the process and its features.
        observed: what the demonstrator did.
        expectations: (S, k) feature expectations mu of pi.
    """
    states, actions = observed.states, observed.actions
    advantages = linear.expectations_after(expectations, states, actions) - expectations[states]
    return np.asarray(observed.weights(linear.mdp.discount) @ advantages)


def maximum_margin(differences: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """The program (10) to (12): maximise t with w . difference >= t for all, and |w| <= 1.

    Solved as it is written, with a cone for the ball. The forms without one, the support vector
    machine's and the nearest point of a convex hull, square the margin, and lose half the digits
    of a small one.

    Args:
        differences: (J, k) mu_E - mu of each policy.

    Returns:
        w (k,) and t, which is never below 0 but for rounding: w = 0 attains that.

    Raises:
        InputError: the solver is not installed.
        RuntimeError: the solver did not find the solution.
    """
    clarabel = solver()
    count, feature_count = differences.shape
    # Of x = (w, t): t - w . difference + slack = 0, and (1, w) in the second-order cone.
    rows = np.zeros((count + 1 + feature_count, feature_count + 1))
    rows[:count, :-1] = -differences
    rows[:count, -1] = 1.0
    rows[count + 1 :, :-1] = -np.eye(feature_count)
    bounds = np.zeros(len(rows))
    bounds[count] = 1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
    solution = clarabel.DefaultSolver(
        csc_matrix((feature_count + 1, feature_count + 1)),
        np.append(np.zeros(feature_count), -1.0),
        csc_matrix(rows),
        bounds,
        [clarabel.NonnegativeConeT(count), clarabel.SecondOrderConeT(feature_count + 1)],
        settings,
    ).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise RuntimeError(f"the maximum margin was not found: {solution.status}")
    found = np.array(solution.x)
    return found[:-1], float(found[-1])


def solver() -> Any:
    """The module that solves the quadratic programs.

    Raises:
        InputError: it is not installed.
    """
    try:
        import clarabel
    except ImportError as error:
        raise InputError(
            "Abbeel & Ng's algorithm needs the solver clarabel, which is not installed: "
            "pip install 'bnirl_ros[paper]'"
        ) from error
    return clarabel
