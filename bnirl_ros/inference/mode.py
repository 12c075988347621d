"""The posterior mode: coordinate ascent on the joint (10) from the best draws of the chains.

The best of many draws is not the mode: on the paper's loop task it lies tens of nats below it and
carries stray subgoals with an observation or two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.model.mixture import SubgoalMixture
from bnirl_ros.threads import workers

_GAIN = 1e-9  # nats; a smaller gain is rounding, and following it could go round in a circle
_REPLACEMENTS = 8  # candidates tried in a partition's subgoal's place, the most likely ones


@dataclass(frozen=True, eq=False)
class Mode:
    """The most probable partition with its subgoals.

    Attributes:
        subgoal_of: (N,) int32 candidate index of each observation's subgoal.
        partition_of: (N,) int32, numbered in the order of first observations.
        log_joint: log of (10).
    """

    subgoal_of: npt.NDArray[np.int32]
    partition_of: npt.NDArray[np.int32]
    log_joint: float


def posterior_mode(mixture: SubgoalMixture, chains: Draws) -> Mode:
    """The best point that ascent reaches from the best draw of each chain.

    Args:
        mixture: the model that was sampled.
        chains: draws with leading axes (chain, draw).
    """
    best = chains.log_joint.argmax(axis=1)
    with workers(len(best)) as threads:
        modes = threads.map(
            lambda chain, draw: ascend(
                mixture, chains.partition_of[chain, draw], chains.subgoal_of[chain, draw]
            ),
            range(len(best)),
            best,
        )
        return max(modes, key=lambda mode: mode.log_joint)


def ascend(
    mixture: SubgoalMixture, partition_of: npt.ArrayLike, subgoal_of: npt.ArrayLike
) -> Mode:
    """Coordinate ascent on (10) from a draw: partition and subgoal of each observation (N,).

    Equal observations move together, in turn until nothing gains: all equal ones to the best
    partition, old or new; each partition's subgoal; a whole partition given up, or its subgoal
    replaced; a candidate taken up, with what it explains better.

    Apart, equal observations would gain only where eta P(g) > 1 for some g: as (10) is convex in
    how many of them are in one partition rather than in another, either all are or none, and only
    a new partition for a single one could be better than for all. There single ones move too,
    from that point and from the draw itself.
    """
    subgoal_of = np.asarray(subgoal_of, dtype=np.int64)
    pairs, index, counts = np.unique(mixture.pair_of, return_inverse=True, return_counts=True)
    votes = np.zeros((len(pairs), len(mixture.log_prior)), dtype=np.int64)
    np.add.at(votes, (index, subgoal_of), 1)
    # One partition for each subgoal, and room for as many as there are pairs.
    subgoals, partition_of_pair = np.unique(votes.argmax(axis=1), return_inverse=True)
    partition_of_pair, subgoals = _ascend(
        _items(mixture, pairs, counts), partition_of_pair, np.resize(subgoals, len(pairs)), True
    )
    mode = _mode(mixture, partition_of_pair[index], subgoals)
    if mixture.eta * math.exp(mixture.log_prior.max()) <= 1.0:
        return mode
    single = _items(mixture, mixture.pair_of, np.ones(len(index), dtype=np.int64))
    modes = [mode]
    for partitions, goals in ((mode.partition_of, mode.subgoal_of), (partition_of, subgoal_of)):
        _, first, number = np.unique(partitions, return_index=True, return_inverse=True)
        room = np.resize(np.asarray(goals, dtype=np.int64)[first], len(index))
        modes.append(_mode(mixture, *_ascend(single, number, room, False)))
    return max(modes, key=lambda mode: mode.log_joint)


def extended(mixture: SubgoalMixture, subgoal_of: npt.NDArray[np.int32]) -> Mode:
    """The mode of a demonstration that has grown, from that of before.

    Of the mode that `ascend` finds, where one subgoal has one partition. Each new observation goes
    where (10) gains most, one after the other; the others stay.

    Args:
        mixture: the model now.
        subgoal_of: (N before,) candidate index, among those now, of what the mode was.
    """
    seated = np.bincount(subgoal_of, minlength=len(mixture.log_prior))
    chosen = list(subgoal_of.tolist())
    for pair in mixture.pair_of[len(subgoal_of) :]:
        by_size = np.log(np.maximum(seated, 1))
        place = np.where(seated > 0, by_size, math.log(mixture.eta) + mixture.log_prior)
        best = int((place + mixture.log_likelihood[pair]).argmax())
        seated[best] += 1
        chosen.append(best)
    subgoals = np.array(chosen, dtype=np.int64)
    return _mode(mixture, subgoals, np.arange(len(mixture.log_prior)))


def _mode(
    mixture: SubgoalMixture,
    partition_of: npt.NDArray[np.int64],
    subgoals: npt.NDArray[np.int64],
) -> Mode:
    """From partitions (N,) in any numbers, and the subgoal of each number."""
    labels, first, number = np.unique(partition_of, return_index=True, return_inverse=True)
    return Mode(
        subgoal_of=subgoals[partition_of].astype(np.int32),
        partition_of=np.argsort(np.argsort(first))[number].astype(np.int32),
        log_joint=mixture.log_joint(number, subgoals[labels]),
    )


class _Items(NamedTuple):
    """What moves as one: I items, each of some equal observations.

    Attributes:
        log_likelihood: (I, G) of one of an item's observations.
        counts: (I,) int64 observations of each item.
        log_prior: (G,).
        log_eta: log of the concentration.
        log_factorial: (N + 1,) log (n - 1)! by n, and 0 for n = 0.
        best_alone: (I,) int64 best candidate for a partition of an item alone.
        value_alone: (I,) what (10) gains by that partition.
    """

    log_likelihood: npt.NDArray[np.float64]
    counts: npt.NDArray[np.int64]
    log_prior: npt.NDArray[np.float64]
    log_eta: float
    log_factorial: npt.NDArray[np.float64]
    best_alone: npt.NDArray[np.int64]
    value_alone: npt.NDArray[np.float64]


def _items(
    mixture: SubgoalMixture, pairs: npt.NDArray[np.int64], counts: npt.NDArray[np.int64]
) -> _Items:
    """Items of so many observations of each of these rows of the mixture's likelihood."""
    log_likelihood = mixture.log_likelihood[pairs]
    log_factorial = np.array([0.0, *map(math.lgamma, range(1, counts.sum() + 1))])
    alone = mixture.log_prior + counts[:, None] * log_likelihood
    log_eta = math.log(mixture.eta)
    return _Items(
        log_likelihood=log_likelihood,
        counts=counts,
        log_prior=mixture.log_prior,
        log_eta=log_eta,
        log_factorial=log_factorial,
        best_alone=alone.argmax(axis=1),
        value_alone=alone.max(axis=1) + log_factorial[counts] + log_eta,
    )


@njit(nogil=True, cache=True)
def _ascend(items, partition_of, subgoals, whole):  # type: ignore[no-untyped-def]
    """Ascent from partitions numbered without gaps; returns others.

    `subgoals` (I,) holds the partitions' subgoals, then room for more. With `whole`, whole
    partitions are given up, replaced and taken up too.
    """
    partition_of, subgoals = partition_of.copy(), subgoals.copy()
    best = _climb(items, partition_of, subgoals)
    gained = whole
    while gained:
        gained = False
        partition = 0
        while partition <= partition_of.max():
            likely = _scores(items, partition_of, partition).argsort()[-_REPLACEMENTS:]
            for candidate in range(-1, likely.shape[0]):
                trial, trial_subgoals = partition_of.copy(), subgoals.copy()
                if candidate >= 0:
                    trial_subgoals[partition] = likely[candidate]
                elif not _give_up(items, trial, trial_subgoals, partition):
                    continue
                value = _climb(items, trial, trial_subgoals)
                if value > best + _GAIN:
                    best, partition_of, subgoals = value, trial, trial_subgoals
                    gained = True
                    break
            partition += 1
        for candidate in range(items.log_prior.shape[0]):
            trial, trial_subgoals = partition_of.copy(), subgoals.copy()
            if _take_up(items, trial, trial_subgoals, candidate):
                value = _climb(items, trial, trial_subgoals)
                if value > best + _GAIN:
                    best, partition_of, subgoals = value, trial, trial_subgoals
                    gained = True
    return partition_of, subgoals


@njit(nogil=True, cache=True)
def _sizes(items, partition_of):  # type: ignore[no-untyped-def]
    """Observations in each partition, with room for as many partitions as items and one more."""
    sizes = np.zeros(partition_of.shape[0] + 1, dtype=np.int64)
    for item in range(partition_of.shape[0]):
        sizes[partition_of[item]] += items.counts[item]
    return sizes


@njit(nogil=True, cache=True)
def _scores(items, partition_of, partition):  # type: ignore[no-untyped-def]
    """(G,) log P(g) + sum over a partition of log P(O_i | g): log of (17) with its product."""
    scores = items.log_prior.copy()
    for item in range(partition_of.shape[0]):
        if partition_of[item] == partition:
            scores += items.counts[item] * items.log_likelihood[item]
    return scores


@njit(nogil=True, cache=True)
def _climb(items, partition_of, subgoals):  # type: ignore[no-untyped-def]
    """Items and partitions' subgoals in turn until nothing gains; (10) but for a constant."""
    sizes = _sizes(items, partition_of)
    moved = True
    while moved:
        moved = False
        bound = partition_of.max() + 1
        for item in range(partition_of.shape[0]):
            old = partition_of[item]
            _move(items, partition_of, subgoals, sizes, item, bound)
            if partition_of[item] != old:
                moved = True
                bound = max(bound, partition_of[item] + 1)
        _close_gaps(partition_of, subgoals, sizes)
        for partition in range(partition_of.max() + 1):
            scores = _scores(items, partition_of, partition)
            likeliest = scores.argmax()
            if scores[likeliest] > scores[subgoals[partition]] + _GAIN:
                subgoals[partition] = likeliest
                moved = True
    total = 0.0
    for partition in range(partition_of.max() + 1):
        total += items.log_eta + items.log_prior[subgoals[partition]]
        total += items.log_factorial[sizes[partition]]
    for item in range(partition_of.shape[0]):
        total += items.counts[item] * items.log_likelihood[item, subgoals[partition_of[item]]]
    return total


@njit(nogil=True, cache=True)
def _close_gaps(partition_of, subgoals, sizes):  # type: ignore[no-untyped-def]
    """Number the partitions without gaps."""
    number = np.empty(sizes.shape[0], dtype=np.int64)
    count = 0
    for partition in range(sizes.shape[0]):
        if sizes[partition] > 0:
            number[partition] = count
            subgoals[count] = subgoals[partition]
            sizes[count] = sizes[partition]
            count += 1
    sizes[count:] = 0
    for item in range(partition_of.shape[0]):
        partition_of[item] = number[partition_of[item]]


@njit(nogil=True, cache=True)
def _joining(items, subgoals, sizes, item, partition):  # type: ignore[no-untyped-def]
    """What (10) gains when an item that is in no partition joins one, which may be empty."""
    count, size = items.counts[item], sizes[partition]
    value = count * items.log_likelihood[item, subgoals[partition]]
    value += items.log_factorial[size + count] - items.log_factorial[size]
    return value if size > 0 else value + items.log_eta + items.log_prior[subgoals[partition]]


@njit(nogil=True, cache=True)
def _move(items, partition_of, subgoals, sizes, item, bound):  # type: ignore[no-untyped-def]
    """Move an item where (10) is largest; partitions from `bound` on are empty."""
    old = partition_of[item]
    sizes[old] -= items.counts[item]
    best, target = _joining(items, subgoals, sizes, item, old) + _GAIN, old
    empty = -1
    for partition in range(bound + 1):
        if sizes[partition] == 0:
            empty = partition if empty < 0 else empty
        else:
            value = _joining(items, subgoals, sizes, item, partition)
            if value > best:
                best, target = value, partition
    if items.value_alone[item] > best:
        target = empty
        subgoals[target] = items.best_alone[item]
    sizes[target] += items.counts[item]
    partition_of[item] = target


@njit(nogil=True, cache=True)
def _give_up(items, partition_of, subgoals, given_up):  # type: ignore[no-untyped-def]
    """Move every item of a partition to the best of the others; whether there are others."""
    sizes = _sizes(items, partition_of)
    count = partition_of.max() + 1
    if count < 2:
        return False
    for item in range(partition_of.shape[0]):
        if partition_of[item] == given_up:
            best, target = -np.inf, -1
            for partition in range(count):
                if partition != given_up:
                    value = _joining(items, subgoals, sizes, item, partition)
                    if value > best:
                        best, target = value, partition
            sizes[target] += items.counts[item]
            partition_of[item] = target
    sizes[given_up] = 0
    _close_gaps(partition_of, subgoals, sizes)
    return True


@njit(nogil=True, cache=True)
def _take_up(items, partition_of, subgoals, candidate):  # type: ignore[no-untyped-def]
    """Gather in a new partition what `candidate` explains better; whether there is any."""
    new = partition_of.max() + 1
    if new == partition_of.shape[0]:
        return False
    taken = False
    for item in range(partition_of.shape[0]):
        row = items.log_likelihood[item]
        if row[candidate] > row[subgoals[partition_of[item]]] + _GAIN:
            partition_of[item] = new
            taken = True
    subgoals[new] = candidate
    _close_gaps(partition_of, subgoals, _sizes(items, partition_of))
    return taken
