"""What each algorithm makes of a trial, iteration by iteration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.baselines import Observed, Rival, initialised
from bnirl_ros.experiments.paper.trials import (
    Trial,
    candidate_subgoals,
    goal_values_of,
    reward_losses,
    reward_range,
    true_subgoals,
    unmatched,
)
from bnirl_ros.inference import partition_gibbs
from bnirl_ros.inference.mode import Mode, ascend
from bnirl_ros.inference.settings import PAPER_PARAMETERS
from bnirl_ros.model.candidates import Candidates
from bnirl_ros.model.likelihood import value_losses
from bnirl_ros.model.mixture import SubgoalMixture, subgoal_mixture

BNIRL = {"BN-IRL State": "State", "BN-IRL Feature": "Feature"}
"""The variants of the paper's method, by their names in its figures."""

RIVAL_NAMES = {
    "Abbeel IRL": "abbeel_ng",
    "MaxMargin IRL": "max_margin",
    "Bayesian IRL": "policy_walk",
}
"""The algorithms that it is compared with, by their names there."""


@dataclass(frozen=True)
class Parameters:
    """Of the paper's model.

    Attributes:
        alpha: confidence of (7).
        eta: concentration of (5).
    """

    alpha: float = PAPER_PARAMETERS["alpha"]
    eta: float = PAPER_PARAMETERS["eta"]


@dataclass(frozen=True, eq=False)
class Found:
    """What the sampler found of the subgoals, after all its iterations.

    The best sample is the one with the largest joint (10), the paper's empirical mode of Theorem
    1. The mode is what coordinate ascent on (10) reaches from there, as `bnirl infer` reports it.

    Attributes:
        sample_loss: (T + 1,) 0-1 loss of the sample at each iteration.
        best_joint, mode_joint: log of (10).
        mode_loss: 0-1 loss.
        best_subgoals, mode_subgoals: cells, or feature coordinates, in ascending order.
        best_exact, mode_exact: whether those are exactly the true ones.
        least_loss: 0-1 loss were each observation assigned to the candidate that suits it best.
        unmatched_cost: how much less likely (7) makes the actions that count as lost in the best
            sample than the greedy ones, on average [nats]; NaN where there are none.
    """

    sample_loss: npt.NDArray[np.int64]
    best_joint: float
    mode_joint: float
    mode_loss: int
    best_subgoals: tuple[tuple[int, ...], ...]
    mode_subgoals: tuple[tuple[int, ...], ...]
    best_exact: bool
    mode_exact: bool
    least_loss: int
    unmatched_cost: float


@dataclass(frozen=True, eq=False)
class Course:
    """The course of one algorithm over one trial.

    Attributes:
        observations: N.
        loss: (T + 1,) float64 0-1 loss of what the algorithm would answer after each iteration, 0
            being where it starts; NaN where it has no answer yet. For the Gibbs sampler that is
            the best sample so far.
        found: the subgoals, for the paper's method.
        constant: whether the last answer is a reward that is the same everywhere. To it every
            action is as good, so that its loss is 0 though it says nothing.
    """

    observations: int
    loss: npt.NDArray[np.float64]
    found: Found | None = None
    constant: bool = False


@dataclass(frozen=True, eq=False)
class Samples:
    """T sweeps of Algorithm 2 and where they began.

    Attributes:
        subgoal_of: (T + 1, N) int32 candidate index of each observation's subgoal.
        partition_of: (T + 1, N) int32 partition of each observation.
        log_joint: (T + 1,) log of (10).
    """

    subgoal_of: npt.NDArray[np.int32]
    partition_of: npt.NDArray[np.int32]
    log_joint: npt.NDArray[np.float64]


def mixture_of(trial: Trial, candidates: Candidates, parameters: Parameters) -> SubgoalMixture:
    """The paper's model of a trial: what step 1 of Algorithm 2 computes."""
    return subgoal_mixture(
        trial.process,
        trial.states,
        trial.demonstration.action,
        candidates.goals,
        parameters.alpha,
        parameters.eta,
    )


def sample(mixture: SubgoalMixture, sweeps: int, generator: np.random.Generator) -> Samples:
    """Algorithm 2, one chain, every sweep kept."""
    state = partition_gibbs.initial_state(mixture, generator)
    first = state.partition_of.copy()
    subgoal = state.subgoal_of_slot[first]
    joint = mixture.log_joint(first, subgoal[:1])  # one partition holds all
    draws = partition_gibbs.room_for(mixture, (sweeps,))
    partition_gibbs.advance(mixture, state, generator, draws)
    return Samples(
        subgoal_of=np.concatenate([subgoal[None], draws.subgoal_of]),
        partition_of=np.concatenate([first[None], draws.partition_of]),
        log_joint=np.append(joint, draws.log_joint),
    )


def best_so_far(log_joint: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """(T + 1,) which sample up to each iteration has the largest joint, the first among equals."""
    before = np.append(-np.inf, np.maximum.accumulate(log_joint)[:-1])
    records = np.where(log_joint > before, np.arange(len(log_joint)), 0)
    return np.maximum.accumulate(records)


def empirical_mode(mixture: SubgoalMixture, samples: Samples) -> tuple[int, Mode]:
    """Number of the best sample, and the mode that ascent reaches from there."""
    best = int(samples.log_joint.argmax())
    return best, ascend(mixture, samples.partition_of[best], samples.subgoal_of[best])


def bnirl_course(
    trial: Trial,
    variant: str,
    iterations: int,
    generator: np.random.Generator,
    parameters: Parameters,
) -> Course:
    """The paper's method; an iteration is a sweep of Algorithm 2."""
    candidates = candidate_subgoals(trial, variant)
    mixture = mixture_of(trial, candidates, parameters)
    samples = sample(mixture, iterations, generator)
    best, mode = empirical_mode(mixture, samples)
    values = goal_values_of(trial, candidates.goals)
    lost = unmatched(values, trial.positions)
    everyone = np.arange(len(lost))
    best_lost = np.flatnonzero(lost[everyone, samples.subgoal_of[best]])
    shortfall = value_losses(values)[everyone, trial.positions]  # (N, G)
    costs = parameters.alpha * shortfall[best_lost, samples.subgoal_of[best][best_lost]]
    sample_loss = lost[everyone, samples.subgoal_of].sum(axis=1)
    truth = true_subgoals(trial, variant)
    best_subgoals = _subgoals(candidates, samples.subgoal_of[best])
    mode_subgoals = _subgoals(candidates, mode.subgoal_of)
    return Course(
        observations=len(lost),
        loss=sample_loss[best_so_far(samples.log_joint)].astype(np.float64),
        found=Found(
            sample_loss=sample_loss,
            best_joint=float(samples.log_joint[best]),
            mode_joint=mode.log_joint,
            mode_loss=int(lost[everyone, mode.subgoal_of].sum()),
            best_subgoals=best_subgoals,
            mode_subgoals=mode_subgoals,
            best_exact=set(best_subgoals) == truth,
            mode_exact=set(mode_subgoals) == truth,
            least_loss=int(lost.min(axis=1).sum()),
            unmatched_cost=float(costs.mean()) if len(costs) else math.nan,
        ),
    )


def _subgoals(
    candidates: Candidates, subgoal_of: npt.NDArray[np.int32]
) -> tuple[tuple[int, ...], ...]:
    chosen: Sequence[Sequence[int]] = candidates.coordinates[np.unique(subgoal_of)].tolist()
    return tuple(tuple(coordinates) for coordinates in chosen)


def rival_of(trial: Trial, name: str, generator: np.random.Generator) -> Rival:
    """One of the `RIVAL_NAMES`, initialised on a trial."""
    observed = Observed.of(trial.demonstration, trial.world)
    features = trial.feature_matrix
    return initialised(RIVAL_NAMES[name], trial.process, observed, features, generator)


def rival_course(
    trial: Trial, name: str, iterations: int, generator: np.random.Generator
) -> Course:
    """An algorithm that explains everything by one reward; its loss is that of its last answer."""
    rival = rival_of(trial, name, generator)
    losses, known = [np.nan], None
    for _ in range(iterations):
        estimate = rival.iterate()
        if estimate is not known:  # one that has ended gives the same answer again and again
            known = estimate
            lost = reward_losses(trial, estimate.reward, estimate.action_values)
        losses.append(float(lost.sum()))
    constant = reward_range(trial, estimate.reward) == 0.0
    return Course(len(trial.demonstration), np.array(losses), constant=constant)


ALGORITHMS = (*BNIRL, *RIVAL_NAMES)
"""All algorithms, by their names in the paper's figures."""


def course_of(
    algorithm: str,
    trial: Trial,
    iterations: int,
    generator: np.random.Generator,
    parameters: Parameters,
) -> Course:
    """The course of one of `ALGORITHMS` over a trial; the parameters are of the paper's model."""
    if algorithm in BNIRL:
        return bnirl_course(trial, BNIRL[algorithm], iterations, generator, parameters)
    return rival_course(trial, algorithm, iterations, generator)
