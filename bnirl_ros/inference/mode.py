"""The posterior mode: coordinate ascent on the joint (10) from the best draws of the chains.

The best of many draws is not the mode: on the paper's loop task it lies tens of nats below it and
carries stray subgoals with an observation or two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.partition_gibbs import (
    PartitionState,
    log_joint,
    put_in,
    subgoal_scores,
    take_out,
)
from bnirl_ros.model.mixture import SubgoalMixture

_GAIN = 1e-9  # nats; a smaller gain is rounding, and following it could go round in a circle


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
    modes = [
        ascend(mixture, chain.partition_of[best], chain.subgoal_of[best])
        for chain in (chains[index] for index in range(len(chains)))
        for best in [int(chain.log_joint.argmax())]
    ]
    return max(modes, key=lambda mode: mode.log_joint)


def ascend(
    mixture: SubgoalMixture, partition_of: npt.ArrayLike, subgoal_of: npt.ArrayLike
) -> Mode:
    """Coordinate ascent on (10) from one partition (N,) and its subgoals by observation (N,).

    In turn, until nothing gains: single observations to the best partition, old or new; each
    partition's subgoal; a whole subgoal given up, its observations to the next best; a whole
    subgoal taken up, with the observations that it explains better.
    """
    alone = mixture.log_prior + mixture.log_likelihood
    labels, first = np.unique(np.asarray(partition_of), return_index=True)
    state = PartitionState.from_subgoals(
        np.searchsorted(labels, np.asarray(partition_of)), np.asarray(subgoal_of)[first]
    )
    best = _ascend(
        mixture.log_likelihood,
        mixture.log_prior,
        mixture.eta,
        mixture.pair_of,
        np.argsort(mixture.pair_of, kind="stable"),
        alone.argmax(axis=1),
        alone.max(axis=1) + math.log(mixture.eta),
        *state.arrays(),
    )
    _, first, index = np.unique(state.partition_of, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    return Mode(
        subgoal_of=state.subgoal_of_slot[state.partition_of],
        partition_of=order[index].astype(np.int32),
        log_joint=float(best),
    )


@njit(nogil=True, cache=True)
def _ascend(  # type: ignore[no-untyped-def]
    log_likelihood,
    log_prior,
    eta,
    pair_of,
    by_pair,
    best_alone,
    value_alone,
    partition_of,
    subgoal_of_slot,
    size_of_slot,
    slots,
    position_of_slot,
    occupied,
):
    """See `ascend`. `best_alone`, `value_alone` (K,): what a partition of one's own is worth."""
    model = (log_likelihood, log_prior, eta, pair_of, by_pair, best_alone, value_alone)
    state = (partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied)
    best = _climb(model, state)
    gained = True
    while gained:
        gained = False
        position = 0
        while position < occupied[0]:
            trial = _copy(state)
            _give_up(model, trial, position)
            value = _climb(model, trial)
            if value > best + _GAIN:
                best = value
                _assign(state, trial)
                gained = True
            else:
                position += 1
        for candidate in range(log_prior.shape[0]):
            trial = _copy(state)
            if _take_up(model, trial, candidate):
                value = _climb(model, trial)
                if value > best + _GAIN:
                    best = value
                    _assign(state, trial)
                    gained = True
    return best


@njit(nogil=True, cache=True)
def _copy(state):  # type: ignore[no-untyped-def]
    partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied = state
    return (
        partition_of.copy(),
        subgoal_of_slot.copy(),
        size_of_slot.copy(),
        slots.copy(),
        position_of_slot.copy(),
        occupied.copy(),
    )


@njit(nogil=True, cache=True)
def _assign(state, other):  # type: ignore[no-untyped-def]
    partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied = state
    partition_of[:] = other[0]
    subgoal_of_slot[:] = other[1]
    size_of_slot[:] = other[2]
    slots[:] = other[3]
    position_of_slot[:] = other[4]
    occupied[:] = other[5]


@njit(nogil=True, cache=True)
def _climb(model, state):  # type: ignore[no-untyped-def]
    """Single observations and partitions' subgoals until nothing gains; returns log of (10)."""
    log_likelihood, log_prior, eta, pair_of, by_pair, _, _ = model
    partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied = state
    moved = True
    while moved:
        moved = False
        scores = subgoal_scores(
            log_likelihood, log_prior, pair_of, by_pair, partition_of, position_of_slot, occupied
        )
        for position in range(occupied[0]):
            slot = slots[position]
            candidate = scores[position].argmax()
            if scores[position, candidate] > scores[position, subgoal_of_slot[slot]] + _GAIN:
                subgoal_of_slot[slot] = candidate
                moved = True
        for i in range(partition_of.shape[0]):
            moved = _move_one(model, state, i) or moved
    return log_joint(
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


@njit(nogil=True, cache=True)
def _move_one(model, state, i):  # type: ignore[no-untyped-def]
    """Move observation i to the partition where (10) is largest; whether that gained."""
    log_likelihood, log_prior, eta, pair_of, _, best_alone, value_alone = model
    partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied = state
    row = log_likelihood[pair_of[i]]
    old = partition_of[i]
    take_out(i, partition_of, size_of_slot, slots, position_of_slot, occupied)
    if size_of_slot[old] > 0:
        stays = math.log(size_of_slot[old]) + row[subgoal_of_slot[old]]
    else:
        stays = math.log(eta) + log_prior[subgoal_of_slot[old]] + row[subgoal_of_slot[old]]
    best = stays + _GAIN
    target = position_of_slot[old]
    for position in range(occupied[0]):
        slot = slots[position]
        value = math.log(size_of_slot[slot]) + row[subgoal_of_slot[slot]]
        if value > best:
            best = value
            target = position
    if value_alone[pair_of[i]] > best:
        best = value_alone[pair_of[i]]
        target = occupied[0]
        subgoal_of_slot[slots[target]] = best_alone[pair_of[i]]
    put_in(i, target, partition_of, size_of_slot, slots, occupied)
    return best > stays + _GAIN


@njit(nogil=True, cache=True)
def _give_up(model, state, position):  # type: ignore[no-untyped-def]
    """Move every observation of the partition at `position` to the best of the others."""
    log_likelihood, _, _, pair_of, _, _, _ = model
    partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied = state
    if occupied[0] < 2:
        return
    given_up = slots[position]
    for i in range(partition_of.shape[0]):
        if partition_of[i] != given_up:
            continue
        take_out(i, partition_of, size_of_slot, slots, position_of_slot, occupied)
        best = -np.inf
        target = 0
        for other in range(occupied[0]):
            slot = slots[other]
            if slot != given_up:
                value = math.log(size_of_slot[slot])
                value += log_likelihood[pair_of[i], subgoal_of_slot[slot]]
                if value > best:
                    best = value
                    target = other
        put_in(i, target, partition_of, size_of_slot, slots, occupied)


@njit(nogil=True, cache=True)
def _take_up(model, state, candidate):  # type: ignore[no-untyped-def]
    """Gather in a new partition what `candidate` explains better; whether there is any."""
    log_likelihood, _, _, pair_of, _, _, _ = model
    partition_of, subgoal_of_slot, size_of_slot, slots, position_of_slot, occupied = state
    taken_up = -1
    for i in range(partition_of.shape[0]):
        row = log_likelihood[pair_of[i]]
        if row[candidate] > row[subgoal_of_slot[partition_of[i]]] + _GAIN:
            take_out(i, partition_of, size_of_slot, slots, position_of_slot, occupied)
            if taken_up < 0:
                taken_up = slots[occupied[0]]
                subgoal_of_slot[taken_up] = candidate
                put_in(i, occupied[0], partition_of, size_of_slot, slots, occupied)
            else:
                put_in(i, position_of_slot[taken_up], partition_of, size_of_slot, slots, occupied)
    return taken_up >= 0
