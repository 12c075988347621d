"""Draws that take in new observations without a sweep, so that a result need not wait for one.

Sequential importance sampling: each draw is extended by the new observations one by one, each
drawn from its exact conditional given the draw and the action that was seen; then the draws of
each chain, which stand for the posterior by themselves, are chosen in proportion to how probable
they found the actions. Sweeps replace the draws one by one later.

Where a candidate is new, P(g) of all others is another one, which the proportions take into
account. That it may explain older observations too is left to the sweeps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.kernels import categorical
from bnirl_ros.inference.pursuit_gibbs import (
    LEAST_PROBABILITY,
    kernel_model,
    switch_probability,
    urn_weights,
)
from bnirl_ros.inference.samplers import Model, sampler_of
from bnirl_ros.model.mixture import SubgoalMixture
from bnirl_ros.model.pursuits import ALPHA, ETA, SLIP

EACH = 8
"""Draws kept of each chain."""


@dataclass(frozen=True, eq=False)
class Particles:
    """The last draws of each chain, M in all, with what is needed to go on from each.

    Attributes:
        draws: (M, N) as recorded.
        switched: (M, N) bool which observations are draws of their own. For the paper's model it
            has no columns, nor has `counts`: its draws are all that it takes.
        subgoal: (M,) int32 subgoal of the last observation, be it a slip.
        counts: (M, G) int64 draws of each candidate.
        turn: (M,) int64 the order in which each chain's were recorded; 0 for one still to come.
    """

    draws: Draws
    switched: npt.NDArray[np.bool_]
    subgoal: npt.NDArray[np.int32]
    counts: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]

    @classmethod
    def empty(cls, model: Model, chains: int) -> Particles:
        """Room for the draws of so many chains."""
        size = chains * EACH
        draws = sampler_of(model).room_for(model, (size,))
        observations = draws.subgoal_of.shape[1]
        candidates = 0 if isinstance(model, SubgoalMixture) else len(model.prior)
        return cls(
            draws=draws,
            switched=np.empty((size, observations if candidates else 0), dtype=np.bool_),
            subgoal=np.empty(size, dtype=np.int32),
            counts=np.empty((size, candidates), dtype=np.int64),
            turn=np.zeros(size, dtype=np.int64),
        )

    @property
    def full(self) -> bool:
        """Whether there are as many as there should be."""
        return bool((self.turn > 0).all())

    def record(self, chain: int, state: Any, draw: Draws) -> None:
        """Put a draw (N,) with the state that it is of in the place of its chain's oldest one."""
        of_chain = slice(chain * EACH, (chain + 1) * EACH)
        row = of_chain.start + int(self.turn[of_chain].argmin())
        self.turn[row] = self.turn[of_chain].max() + 1
        for name, values in vars(self.draws).items():
            values[row] = getattr(draw, name)
        if self.switched.shape[1]:
            self.switched[row] = state.switched
            self.subgoal[row] = state.subgoal_of[-1]
            self.counts[row] = state.counts


def taken_in(
    particles: Particles,
    before: Model,
    model: Model,
    candidate_now: npt.NDArray[np.int64],
    generator: np.random.Generator,
) -> tuple[Particles, float]:
    """The particles with all observations of a model that has some more at the end.

    Args:
        particles: of the observations before.
        before: the model of those.
        model: the model now.
        candidate_now: (G before,) index of each candidate before among those now.
        generator: source of randomness.

    Returns:
        the particles, and the share of them that is left in effect, at most 1: the effective
        sample size of the weights.
    """
    old = particles.draws
    first, new = old.subgoal_of.shape[1], _observations(model) - old.subgoal_of.shape[1]
    size = len(old)
    renamed = np.append(candidate_now, -1).astype(np.int32)  # a slip remains one
    subgoal_of, partition_of = (np.empty((size, new), dtype=np.int32) for _ in range(2))
    switched = np.empty((size, new if particles.switched.shape[1] else 0), dtype=np.bool_)
    log_joint, gains = old.log_joint.copy(), np.zeros(size)
    subgoal, counts = particles.subgoal, particles.counts
    if isinstance(model, SubgoalMixture):
        assert isinstance(before, SubgoalMixture)
        likely = model.log_likelihood[model.pair_of[first:]]
        _extend_partitions(
            likely,
            np.exp(likely - likely.max(axis=1, keepdims=True)),
            model.log_prior,
            np.exp(model.log_prior),
            model.log_prior[0] - before.log_prior[0],
            float(model.eta),
            (old.subgoal_of, old.partition_of, renamed),
            (subgoal_of, partition_of, log_joint, gains),
            generator,
        )
    else:
        assert not isinstance(before, SubgoalMixture)
        prior_before = np.zeros(len(model.prior))
        prior_before[candidate_now] = before.prior
        subgoal = renamed[subgoal]
        counts = np.zeros((size, len(model.prior)), dtype=np.int64)
        counts[:, candidate_now] = particles.counts
        _extend_pursuits(
            kernel_model(model),
            prior_before,
            old.parameters,
            (old.subgoal_of, old.partition_of, particles.switched, renamed),
            (subgoal_of, partition_of, switched, log_joint, subgoal, counts, gains),
            generator,
        )
    gains = gains.reshape(-1, EACH)
    weights = np.exp(gains - gains.max(axis=1, keepdims=True))
    firsts = np.arange(0, size, EACH)
    parents = np.concatenate(
        [
            first + chosen_again(of_chain, generator)
            for first, of_chain in zip(firsts, weights, strict=True)
        ]
    )
    left = (weights.sum(axis=1) ** 2 / (weights**2).sum(axis=1)).sum() / size
    nothing = np.empty(0, dtype=np.int32)
    draws = Draws(
        subgoal_of=_grown(old.subgoal_of, subgoal_of, parents, renamed),
        partition_of=_grown(old.partition_of, partition_of, parents, nothing),
        log_joint=log_joint[parents],
        parameters=old.parameters[parents],
    )
    found = Particles(
        draws=draws,
        switched=_grown(
            particles.switched.view(np.int8), switched.view(np.int8), parents, nothing
        ).view(np.bool_)
        if switched.shape[1]
        else np.empty((size, 0), dtype=np.bool_),
        subgoal=subgoal[parents],
        counts=counts[parents],
        turn=particles.turn.copy(),
    )
    return found, float(left)


def _observations(model: Model) -> int:
    return len(model.pair_of if isinstance(model, SubgoalMixture) else model.state_of)


def chosen_again(
    weights: npt.NDArray[np.float64], generator: np.random.Generator
) -> npt.NDArray[np.int64]:
    """(M,) which of M particles is in the place of each, by systematic resampling.

    Each stays where it is, if it is chosen at all.
    """
    size = len(weights)
    points = (np.arange(size) + generator.random()) / size
    bounds = np.cumsum(weights) / weights.sum()
    bounds[-1] = 1.0
    times = np.bincount(np.searchsorted(bounds, points, side="right"), minlength=size)
    parents = np.arange(size)
    parents[times == 0] = np.repeat(parents, np.maximum(times - 1, 0))
    return parents


@njit(nogil=True, cache=True)
def _grown(old, new, parents, renamed):  # type: ignore[no-untyped-def]
    """(M, N + K) the rows `parents` of `old` (M, N), renamed if there are names, and of `new`."""
    first = old.shape[1]
    result = np.empty((old.shape[0], first + new.shape[1]), dtype=old.dtype)
    for row in range(old.shape[0]):
        source = old[parents[row]]
        if renamed.shape[0] > 0:
            for t in range(first):
                result[row, t] = renamed[source[t]]
        else:
            for t in range(first):
                result[row, t] = source[t]
        result[row, first:] = new[parents[row]]
    return result


@njit(nogil=True, cache=True)
def _extend_pursuits(model, prior_before, parameters, old, new, generator):  # type: ignore[no-untyped-def]
    """Observations beyond the old ones, one by one, of each draw of the sequential model.

    `old` is subgoal_of, partition_of, switched and the present numbers of the candidates; `new`
    has subgoal_of, partition_of and switched (M, K) to be filled, and the log joint, last
    subgoals, counts and gains (M,) to be brought up to date.
    """
    known, seated, switched_before, _ = old
    subgoal_of, partition_of, switched, log_joint, last, counts, gains = new
    first, candidates = known.shape[1], model.prior.shape[0]
    total, likely = np.empty(candidates), np.empty(candidates)
    for draw in range(known.shape[0]):
        values = parameters[draw]
        alpha, eta, slip = values[ALPHA], values[ETA], values[SLIP]
        for candidate in range(candidates):
            if counts[draw, candidate] > 0:
                weight = eta * model.prior[candidate]
                weight_before = eta * prior_before[candidate]
                if weight != weight_before:
                    drawn = counts[draw, candidate]
                    gains[draw] += math.lgamma(weight + drawn) - math.lgamma(weight)
                    gains[draw] -= math.lgamma(weight_before + drawn) - math.lgamma(weight_before)
        log_joint[draw] += gains[draw]
        partitions = seated[draw].max() + 1
        partition = np.int32(-1)  # of the pursuit under way, as far as it is recorded
        t = first - 1
        while t >= 0:
            partition = seated[draw, t]
            if partition >= 0 or switched_before[draw, t]:
                break
            t -= 1
        for t in range(first, model.state_of.shape[0]):
            state = model.state_of[t]
            by_slip = slip * model.uniform[state]
            total[:] = 0.0
            for action in range(model.cost.shape[1]):
                for candidate in range(candidates):
                    total[candidate] += math.exp(-alpha * model.cost[state, action, candidate])
            action = model.pair_action[model.pair_of[t]]
            for candidate in range(candidates):
                chosen = math.exp(-alpha * model.cost[state, action, candidate])
                chosen = max(chosen / total[candidate], LEAST_PROBABILITY)
                likely[candidate] = (1.0 - slip) * chosen + by_slip
            weights = urn_weights(model, eta, counts[draw], model.state_part[state])
            rho = 1.0
            if not model.starts[t]:
                rho = switch_probability(model.arrived, model.state_of, values, t, last[draw])
            kept = (1.0 - rho) * likely[last[draw]]
            drawn_anew = rho * weights * likely
            anew = drawn_anew.sum()
            gains[draw] += math.log(kept + anew)
            subgoal = last[draw]
            switches = generator.random() * (kept + anew) >= kept
            if switches:
                subgoal = np.int32(categorical(drawn_anew, anew, generator))
                partition = _partition_of_draw(
                    model, eta, counts[draw], subgoal, generator, draw, t, old, new
                )
                counts[draw, subgoal] += 1
                log_joint[draw] += math.log(weights[subgoal] * rho)
            else:
                log_joint[draw] += math.log(1.0 - rho)
            log_joint[draw] += math.log(likely[subgoal])
            last[draw] = subgoal
            switched[draw, t - first] = switches
            subgoal_of[draw, t - first] = -1
            partition_of[draw, t - first] = -1
            if generator.random() * likely[subgoal] >= by_slip:
                if partition < 0:
                    partition = np.int32(partitions)
                    partitions += 1
                subgoal_of[draw, t - first] = subgoal
                partition_of[draw, t - first] = partition


@njit(nogil=True, cache=True)
def _partition_of_draw(model, eta, counts, subgoal, generator, draw, end, old, new):  # type: ignore[no-untyped-def]
    """Partition of one more draw of a subgoal: that of any draw of it before; -1 for a new one."""
    known, seated, switched_before, renamed = old
    subgoal_of, partition_of, switched, _, _, _, _ = new
    first = known.shape[1]
    remaining = generator.random() * (counts[subgoal] + eta * model.prior[subgoal])
    begins = False
    for t in range(end):
        if t < first:
            begins = begins or switched_before[draw, t]
            found, partition = renamed[known[draw, t]], seated[draw, t]
        else:
            begins = begins or switched[draw, t - first]
            found, partition = subgoal_of[draw, t - first], partition_of[draw, t - first]
        if begins and partition >= 0:
            begins = False
            if found == subgoal:
                remaining -= 1.0
                if remaining < 0.0:
                    return partition
    return np.int32(-1)


@njit(nogil=True, cache=True)
def _extend_partitions(  # type: ignore[no-untyped-def]
    log_likelihood,
    scaled_likelihood,
    log_prior,
    prior,
    log_prior_gain,
    eta,
    old,
    new,
    generator,
):
    """Observations beyond the old ones, one by one, of each draw of the paper's model.

    The likelihoods are (K, G), of the new observations alone, and as in `SubgoalMixture`.
    `old` is subgoal_of, partition_of and the present numbers of the candidates; `new` has
    subgoal_of and partition_of (M, K) to be filled, and the log joint and gains (M,) to be brought
    up to date.
    """
    known, seated, renamed = old
    subgoal_of, partition_of, log_joint, gains = new
    first = known.shape[1]
    size = np.zeros(first + log_likelihood.shape[0] + 1, dtype=np.int64)
    subgoal = np.zeros(size.shape[0], dtype=np.int32)
    weights = np.zeros(size.shape[0])
    for draw in range(known.shape[0]):
        size[:] = 0
        count = 0
        for t in range(first):
            partition = seated[draw, t]
            if size[partition] == 0:
                subgoal[partition] = renamed[known[draw, t]]
                count += 1
            size[partition] += 1
        gains[draw] += count * log_prior_gain
        log_joint[draw] += gains[draw]
        for index in range(log_likelihood.shape[0]):
            new_weight = eta * (prior * scaled_likelihood[index]).sum()
            total = new_weight
            for partition in range(count):
                weight = size[partition] * scaled_likelihood[index, subgoal[partition]]
                weights[partition] = weight
                total += weight
            weights[count] = new_weight
            gains[draw] += math.log(total)
            partition = categorical(weights[: count + 1], total, generator)
            if partition == count:
                count += 1
                likely = prior * scaled_likelihood[index]
                subgoal[partition] = categorical(likely, likely.sum(), generator)
                log_joint[draw] += math.log(eta) + log_prior[subgoal[partition]]
            else:
                log_joint[draw] += math.log(size[partition])
            size[partition] += 1
            log_joint[draw] += log_likelihood[index, subgoal[partition]]
            log_joint[draw] -= math.log(first + index + eta)
            subgoal_of[draw, index] = subgoal[partition]
            partition_of[draw, index] = partition
