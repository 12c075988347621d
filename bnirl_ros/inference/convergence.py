"""When do draws suffice? What is watched of every chain, and what is asked of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.inference.diagnostics import FEWEST_DRAWS, effective_sample_size, rhat
from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.runs import run_counts

HIGHEST_RHAT = 1.01
"""Up to which chains agree, by Vehtari et al. (2021)."""

LEAST_ESS = 400.0
"""Effective sample size from which it, and R-hat, can be relied on, by the same. A probability is
then known to a standard error of 0.025."""

_HARDLY = 0.05
"""Subgoals less probable than that, or more than one less that, are not watched: R-hat and
effective sample size tell little of what hardly ever differs, and the error is small."""


@dataclass(frozen=True)
class Convergence:
    """How far chains agree on the quantity that is worst known.

    Attributes:
        rhat: the largest R-hat of all that is watched; None where undefined.
        ess: the smallest effective sample size of all that is watched; None where undefined.
        rhat_of, ess_of: of which quantity; empty where undefined.
        chains, draws: number of chains, and of draws of each.
    """

    rhat: float | None
    ess: float | None
    rhat_of: str
    ess_of: str
    chains: int
    draws: int

    @property
    def reached(self) -> bool:
        """Whether chains have converged: on all that is watched they agree, with enough draws."""
        return not self.doubt

    @property
    def doubt(self) -> str:
        """What speaks against it, in a clause; empty if nothing does."""
        if self.chains < 2:
            return "one chain cannot tell whether others would agree"
        if self.draws < FEWEST_DRAWS or self.chains * self.draws < LEAST_ESS:
            return f"{self.chains * self.draws} draws are too few to tell"
        doubts = []
        if self.rhat is not None and self.rhat > HIGHEST_RHAT:
            doubts.append(f"R-hat of {self.rhat_of} is {self.rhat:.3f} (limit {HIGHEST_RHAT:g})")
        if self.ess is not None and self.ess < LEAST_ESS:
            doubts.append(
                f"the effective sample size of {self.ess_of} is {self.ess:.0f} (at least "
                f"{LEAST_ESS:g})"
            )
        return " and ".join(doubts)


NOTHING_DRAWN = Convergence(None, None, "", "", chains=0, draws=0)
"""Where there is no chain."""


def traces_of(
    draws: Draws,
    starts: npt.NDArray[np.bool_],
    subgoals: Sequence[Sequence[int]],
    parameters: Sequence[str],
) -> dict[str, npt.NDArray[Any]]:
    """The quantities (chain, draw) that are watched, by name; none depends on labels.

    They are the log joint, the number of partitions, the parameters, and for each candidate with a
    probability that is neither nearly 0 nor nearly 1 whether it is a subgoal. Chains that stay in
    modes of their own may differ in nothing but these.

    Args:
        draws: (chain, draw, N).
        starts: (N,) whether each observation begins an episode.
        subgoals: coordinates of each of the G candidates.
        parameters: name of each parameter of the draws.
    """
    traces: dict[str, npt.NDArray[Any]] = {
        "the log joint": draws.log_joint,
        "the number of partitions": draws.partition_count,
    }
    for column, name in enumerate(parameters):
        traces[name] = draws.parameters[..., column]
    shape = draws.log_joint.shape
    subgoal_of = draws.subgoal_of.reshape(-1, len(starts))
    is_subgoal = run_counts(subgoal_of, starts, len(subgoals)) > 0
    share = is_subgoal.mean(axis=0)
    for candidate in np.flatnonzero((share >= _HARDLY) & (share <= 1.0 - _HARDLY)):
        name = "the subgoal ({})".format(", ".join(map(str, subgoals[candidate])))
        traces[name] = is_subgoal[:, candidate].reshape(shape)
    return traces


def convergence_of(traces: Mapping[str, npt.NDArray[Any]]) -> Convergence:
    """How far chains agree on quantities (chain, draw), at least one, by name."""
    rhats = {name: rhat(values) for name, values in traces.items()}
    sizes = {name: effective_sample_size(values) for name, values in traces.items()}
    worst_rhat, rhat_of = max(
        ((value, name) for name, value in rhats.items() if value is not None),
        default=(None, ""),
    )
    worst_size, ess_of = min(
        ((value, name) for name, value in sizes.items() if value is not None),
        default=(None, ""),
    )
    chains, draws = next(iter(traces.values())).shape
    return Convergence(worst_rhat, worst_size, rhat_of, ess_of, chains, draws)
