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
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.model.mixture import SubgoalMixture


@dataclass(frozen=True, eq=False)
class PartitionState:
    """State of one chain: who sits where, and what each partition is after.

    Partitions sit in N slots. `slots` is a permutation of them, the occupied ones first: so a
    partition comes and goes without a label of another one moving.

    Attributes:
        partition_of: (N,) int32 slot of each observation.
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

    @classmethod
    def from_subgoals(
        cls, partition_of: npt.ArrayLike, subgoal_of_partition: npt.ArrayLike
    ) -> PartitionState:
        """From partitions numbered 0 to J - 1 without gaps (-1: in none), and subgoals (J,)."""
        partitions = np.asarray(partition_of, dtype=np.int32).copy()
        subgoals = np.asarray(subgoal_of_partition, dtype=np.int32)
        count = len(partitions)
        subgoal_of_slot = np.zeros(count, dtype=np.int32)
        subgoal_of_slot[: len(subgoals)] = subgoals
        return cls(
            partition_of=partitions,
            subgoal_of_slot=subgoal_of_slot,
            size_of_slot=np.bincount(partitions[partitions >= 0], minlength=count).astype(
                np.int32
            ),
            slots=np.arange(count, dtype=np.int32),
            position_of_slot=np.arange(count, dtype=np.int32),
            occupied=np.array([len(subgoals)], dtype=np.int32),
        )

    def arrays(self) -> tuple[npt.NDArray[np.int32], ...]:
        """The fields in the order in which the kernels take them."""
        return (
            self.partition_of,
            self.subgoal_of_slot,
            self.size_of_slot,
            self.slots,
            self.position_of_slot,
            self.occupied,
        )


def initial_state(mixture: SubgoalMixture, generator: np.random.Generator) -> PartitionState:
    """Step 1(b) of Algorithm 2: one partition, its subgoal drawn from the prior."""
    subgoal = generator.choice(len(mixture.log_prior), p=np.exp(mixture.log_prior))
    return PartitionState.from_subgoals(np.zeros(len(mixture.pair_of)), [subgoal])


def seat(
    mixture: SubgoalMixture,
    partition_of: npt.ArrayLike,
    subgoal_of: npt.ArrayLike,
    generator: np.random.Generator,
) -> PartitionState:
    """A state that goes on from an older one, with observations that are new to it.

    Args:
        mixture: the model of all N observations.
        partition_of: (N,) partition of each observation, any numbers; -1 for the new ones, which
            are seated one by one by (14) given those before.
        subgoal_of: (N,) candidate index of each observation's subgoal; -1 for the new ones.
        generator: source of randomness.
    """
    old = np.asarray(partition_of, dtype=np.int64)
    is_new = old < 0
    labels, first, index = np.unique(old[~is_new], return_index=True, return_inverse=True)
    if len(labels) == 0:
        return initial_state(mixture, generator)
    state = PartitionState.from_subgoals(
        _filled(old.shape, ~is_new, index), np.asarray(subgoal_of)[~is_new][first]
    )
    _draw_partitions(
        mixture.scaled_likelihood,
        mixture.new_partition_weight,
        np.exp(mixture.log_prior),
        mixture.pair_of,
        np.flatnonzero(is_new),
        generator,
        *state.arrays(),
    )
    return state


def _filled(
    shape: tuple[int, ...], where: npt.NDArray[np.bool_], values: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """`values` at `where`, -1 elsewhere."""
    filled = np.full(shape, -1, dtype=np.int64)
    filled[where] = values.reshape(-1)
    return filled


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
    _advance(
        mixture.log_likelihood,
        mixture.scaled_likelihood,
        mixture.new_partition_weight,
        mixture.log_prior,
        mixture.eta,
        mixture.pair_of,
        np.argsort(mixture.pair_of, kind="stable"),
        generator,
        thin,
        *state.arrays(),
        draws.subgoal_of,
        draws.partition_of,
        draws.log_joint,
    )


@njit(nogil=True, cache=True)
def _advance(  # type: ignore[no-untyped-def]
    log_likelihood,
    scaled_likelihood,
    new_partition_weight,
    log_prior,
    eta,
    pair_of,
    by_pair,
    generator,
    thin,
    partition_of,
    subgoal_of_slot,
    size_of_slot,
    slots,
    position_of_slot,
    occupied,
    drawn_subgoal_of,
    drawn_partition_of,
    drawn_log_joint,
):
    prior = np.exp(log_prior)
    everyone = np.arange(partition_of.shape[0])
    label_of_slot = np.empty(partition_of.shape[0], dtype=np.int32)
    for draw in range(drawn_log_joint.shape[0]):
        for _ in range(thin):
            _draw_subgoals(
                log_likelihood,
                log_prior,
                pair_of,
                by_pair,
                generator,
                partition_of,
                subgoal_of_slot,
                slots,
                position_of_slot,
                occupied,
            )
            _draw_partitions(
                scaled_likelihood,
                new_partition_weight,
                prior,
                pair_of,
                everyone,
                generator,
                partition_of,
                subgoal_of_slot,
                size_of_slot,
                slots,
                position_of_slot,
                occupied,
            )
            _redraw_partitions(
                prior,
                eta,
                generator,
                partition_of,
                subgoal_of_slot,
                size_of_slot,
                slots,
                position_of_slot,
                occupied,
            )
        drawn_log_joint[draw] = log_joint(
            log_likelihood,
            log_prior,
            eta,
            pair_of,
            partition_of,
            subgoal_of_slot,
            size_of_slot,
            slots,
            occupied,
        )
        label_of_slot[:] = -1
        labels = 0
        for i in range(partition_of.shape[0]):
            slot = partition_of[i]
            if label_of_slot[slot] < 0:
                label_of_slot[slot] = labels
                labels += 1
            drawn_partition_of[draw, i] = label_of_slot[slot]
            drawn_subgoal_of[draw, i] = subgoal_of_slot[slot]


@njit(nogil=True, cache=True)
def subgoal_scores(  # type: ignore[no-untyped-def]
    log_likelihood, log_prior, pair_of, by_pair, partition_of, position_of_slot, occupied
):
    """(J, G) log P(g) + sum over a partition of log P(O_i | g), by position in `slots`.

    That is log of (17) with its product. Observations come pair by pair (`by_pair`), so that
    equal ones are added up as one row times their number.
    """
    scores = np.empty((occupied[0], log_prior.shape[0]))
    scores[:] = log_prior
    tally = np.zeros(occupied[0], dtype=np.int64)
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
                for candidate in range(log_prior.shape[0]):
                    scores[position, candidate] += times * log_likelihood[pair, candidate]
                tally[position] = 0
        start = end
    return scores


@njit(nogil=True, cache=True)
def _draw_subgoals(  # type: ignore[no-untyped-def]
    log_likelihood,
    log_prior,
    pair_of,
    by_pair,
    generator,
    partition_of,
    subgoal_of_slot,
    slots,
    position_of_slot,
    occupied,
):
    """Step 2(a): every partition's subgoal from (17)."""
    scores = subgoal_scores(
        log_likelihood, log_prior, pair_of, by_pair, partition_of, position_of_slot, occupied
    )
    for position in range(occupied[0]):
        weights = np.exp(scores[position] - scores[position].max())
        subgoal_of_slot[slots[position]] = _categorical(weights, weights.sum(), generator)


@njit(nogil=True, cache=True)
def _draw_partitions(  # type: ignore[no-untyped-def]
    scaled_likelihood,
    new_partition_weight,
    prior,
    pair_of,
    chosen,
    generator,
    partition_of,
    subgoal_of_slot,
    size_of_slot,
    slots,
    position_of_slot,
    occupied,
):
    """Step 2(b): the chosen observations' partitions from (14), each as if it had come last."""
    weights = np.empty(partition_of.shape[0] + 1)
    for i in chosen:
        pair = pair_of[i]
        if partition_of[i] >= 0:
            take_out(i, partition_of, size_of_slot, slots, position_of_slot, occupied)
        count = occupied[0]
        total = 0.0
        for position in range(count):
            slot = slots[position]
            weight = size_of_slot[slot] * scaled_likelihood[pair, subgoal_of_slot[slot]]
            weights[position] = weight
            total += weight
        weights[count] = new_partition_weight[pair]
        total += weights[count]
        position = _categorical(weights[: count + 1], total, generator)
        if position == count:
            likely = prior * scaled_likelihood[pair]
            subgoal_of_slot[slots[count]] = _categorical(likely, likely.sum(), generator)
        put_in(i, position, partition_of, size_of_slot, slots, occupied)


@njit(nogil=True, cache=True)
def _redraw_partitions(  # type: ignore[no-untyped-def]
    prior,
    eta,
    generator,
    partition_of,
    subgoal_of_slot,
    size_of_slot,
    slots,
    position_of_slot,
    occupied,
):
    """All partitions anew, given every observation's subgoal.

    P(z | subgoals) is proportional to prod_j eta P(g_j) (n_j - 1)!: among the observations with
    subgoal g, a Chinese restaurant process with concentration eta P(g). Without this step two
    partitions that found the same subgoal take very long to become one, observation by
    observation.
    """
    subgoal_of = subgoal_of_slot[partition_of]
    seated = np.zeros(prior.shape[0], dtype=np.int64)
    first_slot = np.full(prior.shape[0], -1, dtype=np.int64)
    next_slot = np.full(partition_of.shape[0], -1, dtype=np.int64)
    size_of_slot[:] = 0
    occupied[0] = 0
    for i in range(partition_of.shape[0]):
        subgoal = subgoal_of[i]
        remaining = generator.random() * (seated[subgoal] + eta * prior[subgoal])
        slot = first_slot[subgoal]
        while slot >= 0:
            remaining -= size_of_slot[slot]
            if remaining < 0.0:
                break
            slot = next_slot[slot]
        if slot < 0:
            slot = slots[occupied[0]]
            next_slot[slot] = first_slot[subgoal]
            first_slot[subgoal] = slot
            subgoal_of_slot[slot] = subgoal
        seated[subgoal] += 1
        put_in(i, position_of_slot[slot], partition_of, size_of_slot, slots, occupied)


@njit(nogil=True, cache=True)
def _categorical(weights, total, generator):  # type: ignore[no-untyped-def]
    """Index drawn with probability weights / total; never one of weight zero."""
    remaining = generator.random() * total
    last = 0
    for index in range(weights.shape[0]):
        if weights[index] > 0.0:
            last = index
            remaining -= weights[index]
            if remaining < 0.0:
                break
    return last


@njit(nogil=True, cache=True)
def take_out(i, partition_of, size_of_slot, slots, position_of_slot, occupied):  # type: ignore[no-untyped-def]
    """Take observation i out of its partition, which goes if it was the only one in it."""
    slot = partition_of[i]
    size_of_slot[slot] -= 1
    if size_of_slot[slot] == 0:
        occupied[0] -= 1
        position = position_of_slot[slot]
        last = slots[occupied[0]]
        slots[position] = last
        slots[occupied[0]] = slot
        position_of_slot[last] = position
        position_of_slot[slot] = occupied[0]


@njit(nogil=True, cache=True)
def put_in(i, position, partition_of, size_of_slot, slots, occupied):  # type: ignore[no-untyped-def]
    """Put observation i into the partition at `position`; at J, that opens a new one."""
    if position == occupied[0]:
        occupied[0] += 1
    slot = slots[position]
    size_of_slot[slot] += 1
    partition_of[i] = slot


@njit(nogil=True, cache=True)
def log_joint(  # type: ignore[no-untyped-def]
    log_likelihood,
    log_prior,
    eta,
    pair_of,
    partition_of,
    subgoal_of_slot,
    size_of_slot,
    slots,
    occupied,
):
    """Log of (10), as `SubgoalMixture.log_joint`."""
    total = occupied[0] * math.log(eta)
    for position in range(occupied[0]):
        slot = slots[position]
        total += log_prior[subgoal_of_slot[slot]] + math.lgamma(size_of_slot[slot])
    total -= math.lgamma(partition_of.shape[0] + eta) - math.lgamma(eta)
    for i in range(partition_of.shape[0]):
        total += log_likelihood[pair_of[i], subgoal_of_slot[partition_of[i]]]
    return total
