"""Algorithm 2: Gibbs sampling of partitions and subgoals, with the corrections it needs.

Against the page: the subgoal of a partition is drawn from the product of its observations'
likelihoods, where (16) and (17) print a sum (the joint (10) is a product); an observation is taken
out of its partition before its own draw (14); and the weight of a new partition is the exact sum
over all candidates, since P(g) is discrete.

Beyond the page: at the end of a sweep the partitions are drawn anew given the subgoals, which
leaves the posterior as it is and lets partitions that share a subgoal become one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.kernels import categorical, number_in_order
from bnirl_ros.mdp.distinct import ascending
from bnirl_ros.model.mixture import SubgoalMixture

_VANISHING = -50.0  # [nats] what is so much less probable than another changes no sum of doubles


class PartitionState(NamedTuple):
    """State of one chain, in arrays that sampling changes: who sits where, and goes for what.

    Partitions sit in N slots. `slots` is a permutation of them, the occupied ones first: so a
    partition comes and goes without a label of another one moving.

    Attributes:
        partition_of: (N,) int32 slot of each observation; -1 for none.
        subgoal_of_slot: (N,) int32 candidate index.
        size_of_slot: (N,) int32 observations in each slot; 0 where it is empty.
        slots: (N,) int32.
        position_of_slot: (N,) int32 inverse of `slots`.
        occupied: (1,) int32 number J of partitions.
    """

    partition_of: npt.NDArray[np.int32]
    subgoal_of_slot: npt.NDArray[np.int32]
    size_of_slot: npt.NDArray[np.int32]
    slots: npt.NDArray[np.int32]
    position_of_slot: npt.NDArray[np.int32]
    occupied: npt.NDArray[np.int32]


class _Model(NamedTuple):
    """A `SubgoalMixture` as the kernels take it.

    `by_pair` (N,) has the observations pair by pair; the rest is as it is called there.
    """

    log_likelihood: npt.NDArray[np.float64]
    scaled_likelihood: npt.NDArray[np.float64]
    new_partition_weight: npt.NDArray[np.float64]
    log_prior: npt.NDArray[np.float64]
    prior: npt.NDArray[np.float64]
    eta: float
    pair_of: npt.NDArray[np.int64]
    by_pair: npt.NDArray[np.int64]


def kernel_model(mixture: SubgoalMixture) -> _Model:
    """A mixture as the kernels take it."""
    # Pairs as they first occur: one after the other, they often have the same subgoal.
    count = len(mixture.pair_of)
    first = np.zeros(len(mixture.log_likelihood), dtype=np.int64)
    first[mixture.pair_of[::-1]] = np.arange(count)[::-1]
    return _Model(
        log_likelihood=mixture.log_likelihood,
        scaled_likelihood=mixture.scaled_likelihood,
        new_partition_weight=mixture.new_partition_weight,
        log_prior=mixture.log_prior,
        prior=np.exp(mixture.log_prior),
        eta=float(mixture.eta),
        pair_of=mixture.pair_of,
        by_pair=ascending(first[mixture.pair_of], count),
    )


def _state(partition_of: npt.NDArray[np.int64], subgoals: npt.NDArray[np.int64]) -> PartitionState:
    """From partitions (N,) numbered 0 to J - 1 without gaps, -1 for none, and subgoals (J,)."""
    count = len(partition_of)
    subgoal_of_slot = np.zeros(count, dtype=np.int32)
    subgoal_of_slot[: len(subgoals)] = subgoals
    sizes = np.bincount(partition_of[partition_of >= 0], minlength=count)
    return PartitionState(
        partition_of=partition_of.astype(np.int32),
        subgoal_of_slot=subgoal_of_slot,
        size_of_slot=sizes.astype(np.int32),
        slots=np.arange(count, dtype=np.int32),
        position_of_slot=np.arange(count, dtype=np.int32),
        occupied=np.array([len(subgoals)], dtype=np.int32),
    )


def room_for(mixture: SubgoalMixture, shape: tuple[int, ...]) -> Draws:
    """Draws still to be filled: `shape` is (draws,) or (chains, draws)."""
    return Draws.empty(shape, len(mixture.pair_of))


def initial_state(mixture: SubgoalMixture, generator: np.random.Generator) -> PartitionState:
    """Step 1(b) of Algorithm 2: one partition, its subgoal drawn from the prior."""
    subgoal = generator.choice(len(mixture.log_prior), p=np.exp(mixture.log_prior))
    return _state(np.zeros(len(mixture.pair_of), dtype=np.int64), np.array([subgoal]))


def going_on(
    mixture: SubgoalMixture,
    state: PartitionState,
    row_before: npt.NDArray[np.int64],
    candidate_now: npt.NDArray[np.int64],
    generator: np.random.Generator,
) -> PartitionState:
    """A state that goes on from an older one, see `Sampler.going_on`.

    What was observed then keeps its partition and subgoal, as far as the subgoal is still a
    candidate; other observations are seated one by one by (14) given those before.
    """
    partitions = np.full(len(row_before), -1, dtype=np.int64)
    known = np.flatnonzero(row_before >= 0)
    slots = state.partition_of[row_before[known]]
    subgoals = candidate_now[state.subgoal_of_slot[slots]]
    known, slots, subgoals = (values[subgoals >= 0] for values in (known, slots, subgoals))
    if not len(known):
        return initial_state(mixture, generator)
    _, first, number = np.unique(slots, return_index=True, return_inverse=True)
    partitions[known] = number
    now = _state(partitions, subgoals[first])
    _draw_partitions(kernel_model(mixture), now, np.flatnonzero(partitions < 0), generator)
    return now


def advance(
    mixture: SubgoalMixture,
    state: PartitionState,
    generator: np.random.Generator,
    draws: Draws,
    thin: int = 1,
) -> None:
    """Sweep on from `state`, changing it, until all of `draws` is filled.

    A sweep draws each partition's subgoal from (17), each observation's partition from (14), and
    all partitions given the subgoals. Every `thin`-th sweep is recorded. Releases the GIL; equal
    generators give equal draws.
    """
    arrays = (draws.subgoal_of, draws.partition_of, draws.log_joint)
    _advance(kernel_model(mixture), state, generator, thin, *arrays)


@njit(nogil=True, cache=True)
def _advance(model, state, generator, thin, subgoal_of, partition_of, log_joint):  # type: ignore[no-untyped-def]
    everyone = np.arange(state.partition_of.shape[0])
    nothing_known = np.zeros(model.prior.shape[0], dtype=np.int64)
    scratch = np.empty(state.partition_of.shape[0], dtype=np.int32)
    for draw in range(log_joint.shape[0]):
        for _ in range(thin):
            draw_subgoals(model, state, generator)
            _draw_partitions(model, state, everyone, generator)
            subgoals = state.subgoal_of_slot[state.partition_of]
            redraw_partitions(model, state, subgoals, nothing_known, generator)
        log_joint[draw] = log_joint_of(model, state)
        partition_of[draw] = state.partition_of
        number_in_order(partition_of[draw], scratch)
        subgoal_of[draw] = state.subgoal_of_slot[state.partition_of]


@njit(nogil=True, cache=True)
def draw_subgoals(model, state, generator):  # type: ignore[no-untyped-def]
    """Step 2(a): every partition's subgoal from (17)."""
    scores = _subgoal_scores(model, state)
    for position in range(state.occupied[0]):
        weights = scores[position]
        most, total = weights.max(), 0.0
        for candidate in range(weights.shape[0]):
            # Most candidates explain that much worse, and exponentials are slow.
            below = weights[candidate] - most
            weights[candidate] = math.exp(below) if below > _VANISHING else 0.0
            total += weights[candidate]
        subgoal = categorical(weights, total, generator)
        state.subgoal_of_slot[state.slots[position]] = subgoal


@njit(nogil=True, cache=True)
def _subgoal_scores(model, state):  # type: ignore[no-untyped-def]
    """(J, G) log P(g) + sum over a partition of log P(O_i | g), by position in `slots`.

    That is log of (17) with its product. Observations come pair by pair, so that equal ones are
    added up as one row times their number.
    """
    pair_of, by_pair = model.pair_of, model.by_pair
    partition_of, position_of_slot = state.partition_of, state.position_of_slot
    scores = np.empty((state.occupied[0], model.log_prior.shape[0]))
    scores[:] = model.log_prior
    tally = np.zeros(state.occupied[0], dtype=np.int64)
    start = 0
    while start < by_pair.shape[0]:
        pair = pair_of[by_pair[start]]
        end = start
        while end < by_pair.shape[0] and pair_of[by_pair[end]] == pair:
            tally[position_of_slot[partition_of[by_pair[end]]]] += 1
            end += 1
        for index in range(start, end):
            position = position_of_slot[partition_of[by_pair[index]]]
            times = tally[position]
            if times > 0:
                for candidate in range(scores.shape[1]):
                    scores[position, candidate] += times * model.log_likelihood[pair, candidate]
                tally[position] = 0
        start = end
    return scores


@njit(nogil=True, cache=True)
def _draw_partitions(model, state, chosen, generator):  # type: ignore[no-untyped-def]
    """Step 2(b): the chosen observations' partitions from (14), each as if it had come last."""
    weights = np.empty(state.partition_of.shape[0] + 1)
    for i in chosen:
        likelihood = model.scaled_likelihood[model.pair_of[i]]
        if state.partition_of[i] >= 0:
            _take_out(state, i)
        count = state.occupied[0]
        total = 0.0
        for position in range(count):
            slot = state.slots[position]
            weight = state.size_of_slot[slot] * likelihood[state.subgoal_of_slot[slot]]
            weights[position] = weight
            total += weight
        weights[count] = model.new_partition_weight[model.pair_of[i]]
        total += weights[count]
        position = categorical(weights[: count + 1], total, generator)
        if position == count:
            likely = model.prior * likelihood
            subgoal = categorical(likely, likely.sum(), generator)
            state.subgoal_of_slot[state.slots[count]] = subgoal
        _put_in(state, i, position)


@njit(nogil=True, cache=True)
def redraw_partitions(model, state, subgoal_of, together, generator):  # type: ignore[no-untyped-def]
    """All partitions anew, given every observation's subgoal (N,).

    P(z | subgoals) is proportional to prod_j eta P(g_j) (n_j - 1)!: among the observations with
    subgoal g, a Chinese restaurant process with concentration eta P(g). Without this step two
    partitions that found the same subgoal take very long to become one, observation by
    observation.

    `together` (G,) tells how many of the first with each subgoal are in one partition and the next
    one is not, where that is drawn already; 0 where it is not.
    """
    seated = np.zeros(model.prior.shape[0], dtype=np.int64)
    first_slot = np.full(model.prior.shape[0], -1, dtype=np.int64)
    next_slot = np.full(subgoal_of.shape[0], -1, dtype=np.int64)
    state.size_of_slot[:] = 0
    state.occupied[0] = 0
    for i in range(subgoal_of.shape[0]):
        subgoal = subgoal_of[i]
        slot = first_slot[subgoal]
        if seated[subgoal] >= together[subgoal]:
            if seated[subgoal] == together[subgoal] and seated[subgoal] > 0:
                slot = -1
            else:
                remaining = seated[subgoal] + model.eta * model.prior[subgoal]
                remaining *= generator.random()
                while slot >= 0:
                    remaining -= state.size_of_slot[slot]
                    if remaining < 0.0:
                        break
                    slot = next_slot[slot]
        if slot < 0:
            slot = state.slots[state.occupied[0]]
            next_slot[slot] = first_slot[subgoal]
            first_slot[subgoal] = slot
            state.subgoal_of_slot[slot] = subgoal
        seated[subgoal] += 1
        _put_in(state, i, state.position_of_slot[slot])


@njit(nogil=True, cache=True)
def _take_out(state, i):  # type: ignore[no-untyped-def]
    """Take observation i out of its partition, which goes if it was the only one in it."""
    slot = state.partition_of[i]
    state.size_of_slot[slot] -= 1
    if state.size_of_slot[slot] == 0:
        state.occupied[0] -= 1
        position = state.position_of_slot[slot]
        last = state.slots[state.occupied[0]]
        state.slots[position] = last
        state.slots[state.occupied[0]] = slot
        state.position_of_slot[last] = position
        state.position_of_slot[slot] = state.occupied[0]


@njit(nogil=True, cache=True)
def _put_in(state, i, position):  # type: ignore[no-untyped-def]
    """Put observation i into the partition at `position`; at J, that opens a new one."""
    if position == state.occupied[0]:
        state.occupied[0] += 1
    slot = state.slots[position]
    state.size_of_slot[slot] += 1
    state.partition_of[i] = slot


@njit(nogil=True, cache=True)
def log_joint_of(model, state):  # type: ignore[no-untyped-def]
    """Log of (10), as `SubgoalMixture.log_joint`."""
    count = state.partition_of.shape[0]
    total = state.occupied[0] * math.log(model.eta)
    for position in range(state.occupied[0]):
        slot = state.slots[position]
        total += model.log_prior[state.subgoal_of_slot[slot]]
        total += math.lgamma(state.size_of_slot[slot])
    total -= math.lgamma(count + model.eta) - math.lgamma(model.eta)
    for i in range(count):
        subgoal = state.subgoal_of_slot[state.partition_of[i]]
        total += model.log_likelihood[model.pair_of[i], subgoal]
    return total
