"""The algorithms that section 4.2 compares with: one reward, linear in features, for everything.

Rivals of the method live here, each as its own paper has it; they know nothing of subgoals.
"""

from bnirl_ros.baselines.abbeel_ng import AbbeelNg
from bnirl_ros.baselines.max_margin import MaximumMarginPlanning
from bnirl_ros.baselines.policy_walk import PolicyWalk
from bnirl_ros.baselines.rival import Estimate, Observed, Rival

__all__ = [
    "RIVALS",
    "AbbeelNg",
    "Estimate",
    "MaximumMarginPlanning",
    "Observed",
    "PolicyWalk",
    "Rival",
]

RIVALS: dict[str, type[AbbeelNg] | type[MaximumMarginPlanning] | type[PolicyWalk]] = {
    "abbeel_ng": AbbeelNg,
    "max_margin": MaximumMarginPlanning,
    "policy_walk": PolicyWalk,
}
"""The three by the name of their module. `PolicyWalk` draws, and so takes a generator as well."""
