"""The algorithms that section 4.2 compares with: one reward, linear in features, for everything.

Rivals of the method live here, each as its own paper has it; they know nothing of subgoals.
"""

import numpy as np
import numpy.typing as npt

from bnirl_ros.baselines.abbeel_ng import AbbeelNg
from bnirl_ros.baselines.max_margin import MaximumMarginPlanning
from bnirl_ros.baselines.policy_walk import PolicyWalk
from bnirl_ros.baselines.rival import Estimate, Observed, Rival
from bnirl_ros.mdp.process import MarkovDecisionProcess

__all__ = [
    "RIVALS",
    "AbbeelNg",
    "Estimate",
    "MaximumMarginPlanning",
    "Observed",
    "PolicyWalk",
    "Rival",
    "initialised",
]

RIVALS: dict[str, type[AbbeelNg] | type[MaximumMarginPlanning] | type[PolicyWalk]] = {
    "abbeel_ng": AbbeelNg,
    "max_margin": MaximumMarginPlanning,
    "policy_walk": PolicyWalk,
}
"""The three by the name of their module. `PolicyWalk` draws, and so takes a generator as well."""


def initialised(
    name: str,
    mdp: MarkovDecisionProcess,
    observed: Observed,
    features: npt.NDArray[np.float64],
    generator: np.random.Generator,
) -> Rival:
    """One of `RIVALS` with its defaults, before its first iteration.

    Args:
        name: which one.
        mdp: the process, without reward.
        observed: what the demonstrator did.
        features: (S, k) float64 phi.
        generator: of the draws of the one that draws.

    Raises:
        InputError: the solver that Abbeel & Ng's algorithm needs is not installed.
        ValueError: `features` or `observed` does not fit the process.
    """
    rival = RIVALS[name]
    if issubclass(rival, PolicyWalk):
        return rival(mdp, observed, features, generator)
    return rival(mdp, observed, features)
