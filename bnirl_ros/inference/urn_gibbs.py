"""The paper's model by its Polya urn: the subgoal of each observation is drawn, not its partition.

P(g) is discrete, so partitions with the same subgoal need not be told apart: given all others,
n_g of them with subgoal g, that of observation i is g with probability proportional to (eta P(g)
+ n_g) P(O_i | g). Partitions are drawn afterwards, given the subgoals; each of them then gets a
subgoal from (17), all its observations together. So draws and log joint are those of (10), and
`partition_gibbs` has the same posterior.

Equal observations are drawn in turn, as their weights differ in one number; and where it is as
good as certain that all observations with a subgoal are one partition, one random number tells.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.kernels import categorical, number_in_order
from bnirl_ros.inference.partition_gibbs import (
    PartitionState,
    draw_subgoals,
    going_on,
    initial_state,
    kernel_model,
    log_joint_of,
    redraw_partitions,
    room_for,
)
from bnirl_ros.model.mixture import SubgoalMixture

__all__ = ["advance", "going_on", "initial_state", "room_for"]


def advance(
    mixture: SubgoalMixture,
    state: PartitionState,
    generator: np.random.Generator,
    draws: Draws,
    thin: int = 1,
) -> None:
    """Sweep on from `state`, changing it, until all of `draws` is filled.

    A sweep draws each partition's subgoal from (17), each observation's subgoal from the urn, and
    all partitions given the subgoals. Every `thin`-th sweep is recorded. Releases the GIL; equal
    generators give equal draws.
    """
    arrays = (draws.subgoal_of, draws.partition_of, draws.log_joint)
    _advance(kernel_model(mixture), state, generator, thin, *arrays)


@njit(nogil=True, cache=True)
def _advance(model, state, generator, thin, subgoal_of, partition_of, log_joint):  # type: ignore[no-untyped-def]
    scratch = np.empty(state.partition_of.shape[0], dtype=np.int32)
    for draw in range(log_joint.shape[0]):
        for _ in range(thin):
            draw_subgoals(model, state, generator)
            subgoals = state.subgoal_of_slot[state.partition_of]
            _draw_from_urn(model, subgoals, generator)
            _draw_partitions(model, state, subgoals, generator)
        log_joint[draw] = log_joint_of(model, state)
        partition_of[draw] = state.partition_of
        number_in_order(partition_of[draw], scratch)
        subgoal_of[draw] = state.subgoal_of_slot[state.partition_of]


@njit(nogil=True, cache=True)
def _draw_from_urn(model, subgoal_of, generator):  # type: ignore[no-untyped-def]
    """Every observation's subgoal (N,), given those of all others, in place."""
    candidates = model.prior.shape[0]
    count_of = np.bincount(subgoal_of, minlength=candidates)
    # Who has observations, in any order; each sits at a place, and places of none are closed when
    # equal observations are done with.
    pursued = np.empty(candidates, dtype=np.int64)
    place_of = np.full(candidates, -1, dtype=np.int64)
    places = 0
    for candidate in range(candidates):
        if count_of[candidate] > 0:
            pursued[places] = candidate
            place_of[candidate] = places
            places += 1
    weights = np.empty(candidates)
    before, emptied = np.int64(-1), False
    for i in model.by_pair:
        pair = model.pair_of[i]
        likelihood = model.scaled_likelihood[pair]
        old = subgoal_of[i]
        count_of[old] -= 1
        total = model.new_partition_weight[pair]
        if pair != before:
            if emptied:
                places = _close_places(count_of, pursued, place_of, places, old)
            before, emptied = pair, False
            for place in range(places):
                weights[place] = count_of[pursued[place]] * likelihood[pursued[place]]
                total += weights[place]
        else:
            weights[place_of[old]] = count_of[old] * likelihood[old]
            for place in range(places):
                total += weights[place]
        emptied |= count_of[old] == 0
        place = _place(weights, places, place_of[old], total, generator)
        if place < places:
            new = pursued[place]
        else:
            likely = model.prior * likelihood
            new = categorical(likely, likely.sum(), generator)
            if place_of[new] < 0:
                pursued[places] = new
                place_of[new] = places
                places += 1
        count_of[new] += 1
        weights[place_of[new]] = count_of[new] * likelihood[new]
        subgoal_of[i] = new


@njit(nogil=True, cache=True)
def _place(weights, places, likely, total, generator):  # type: ignore[no-untyped-def]
    """A place by its weight, `places` by what `total` has beyond them; `likely` is tried first."""
    remaining = generator.random() * total - weights[likely]
    if remaining < 0.0:
        return likely
    for place in range(places):
        if place != likely:
            remaining -= weights[place]
            if remaining < 0.0:
                return place
    return places


@njit(nogil=True, cache=True)
def _close_places(count_of, pursued, place_of, places, kept):  # type: ignore[no-untyped-def]
    """Give up the places of candidates without observations but one; returns how many are left."""
    place = 0
    while place < places:
        candidate = pursued[place]
        if count_of[candidate] > 0 or candidate == kept:
            place += 1
            continue
        places -= 1
        pursued[place] = pursued[places]
        place_of[pursued[place]] = place
        place_of[candidate] = -1
    return places


@njit(nogil=True, cache=True)
def _draw_partitions(model, state, subgoal_of, generator):  # type: ignore[no-untyped-def]
    """All partitions, given every observation's subgoal (N,).

    Among the observations with subgoal g they are those of a Chinese restaurant process with
    concentration c = eta P(g), which is small as a rule: the first n are all in one with
    probability Gamma(n) Gamma(1 + c) / Gamma(n + c). One random number tells how many of them
    are, and only those that come later are drawn one by one.
    """
    count_of = np.bincount(subgoal_of, minlength=model.prior.shape[0])
    together = np.zeros(model.prior.shape[0], dtype=np.int64)
    for candidate in range(together.shape[0]):
        if count_of[candidate] > 0:
            concentration = model.eta * model.prior[candidate]
            bound = math.log(1.0 - generator.random())
            together[candidate] = _in_one(concentration, count_of[candidate], bound)
    redraw_partitions(model, state, subgoal_of, together, generator)


@njit(nogil=True, cache=True)
def _in_one(concentration, count, bound):  # type: ignore[no-untyped-def]
    """The largest n up to `count` whose log probability of being in one is above `bound`."""
    least, most = 1, count
    if _log_in_one(concentration, count) > bound:
        return count
    while most - least > 1:
        middle = (least + most) // 2
        if _log_in_one(concentration, middle) > bound:
            least = middle
        else:
            most = middle
    return least


@njit(nogil=True, cache=True)
def _log_in_one(concentration, count):  # type: ignore[no-untyped-def]
    """Log probability that a restaurant's first `count` sit at one table."""
    return (
        math.lgamma(count) + math.lgamma(1.0 + concentration) - math.lgamma(count + concentration)
    )
