"""Sampling the sequential model: pursuits in blocks, their subgoals, slips and parameters.

A sweep draws, each given all else:

1. the subgoals and switches of a block of observations at once: proposed by forward filtering,
   backward sampling under the urn's predictive weights given all other pursuits, accepted by
   Metropolis-Hastings on the urn's probability of the sequence. The weights themselves are
   integrated out: held as a variable they would keep a candidate that is in no pursuit from ever
   being tried. A switch depends on the old subgoal through rho alone, so that an observation costs
   O(G), not O(G^2). Blocks differ in length from sweep to sweep;
2. the place of a subgoal among its neighbours, with all paths open;
3. the switch probabilities, together with the switches to the same subgoal again, and eta, all
   parameters by slice sampling;
4. partitions, given the subgoals, by the Chinese restaurant process that the urn collapses, and
   the subgoal of each partition anew: whole groups of pursuits move at once;
5. alpha and the probability of a slip, while it is open which actions are slips.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.kernels import (
    categorical,
    count_draws,
    exponentials,
    number_in_order,
    row_sum,
)
from bnirl_ros.mdp.distinct import ascending, distinct
from bnirl_ros.model.pursuits import (
    ALPHA,
    AT_SUBGOAL,
    ELSEWHERE,
    ETA,
    ON_ARRIVAL,
    PRIORS,
    SLIP,
    PursuitModel,
)

_SHORTEST_BLOCK, _LONGEST_BLOCK = 8, 1024  # observations; their logarithm is uniform
_BLOCK_ENTRIES = 4_000_000  # of the forward messages: shorter blocks where candidates are many
_SLICE = 0.7  # first width of a slice, of a logarithm
_OVERHEAD = 2000  # candidates for which an observation takes as long as for all else in a sweep
_RELOCATED = 4000  # observations, beyond which a subgoal is relocated less than once in a sweep
_RELOCATIONS = 2  # in a sweep over few observations, when the subgoals have been found
_SEARCH = 50  # sweeps that are to find the subgoals, with four times as many relocations
_LANES = 40  # candidates open to a relocation, beyond which there are fewer relocations
_HEAVY = 0.1  # a weight times the observations, above which a place matters to a relocation
_SMALL = 1e-40  # probability of actions at which messages are scaled
_SUMS = 4  # side by side
_LN_2 = math.log(2.0)
_FRACTION, _ONE = np.int64((1 << 52) - 1), np.int64(1023 << 52)  # bits of a float64
_FARTHEST = 27.0  # logarithms and logits are not sought beyond

LEAST_PROBABILITY = 1e-200
"""Of an action that cannot be: it is only very improbable, so that a filter has something left."""


class PursuitState(NamedTuple):
    """State of one chain, in arrays that sampling changes.

    Attributes:
        subgoal_of: (N,) int32 candidate index theta of each observation's subgoal.
        switched: (N,) bool whether it is a draw of its own.
        slipped: (N,) bool whether the action is a slip.
        partition_of: (N,) int32 partition of each observation's pursuit, numbered from 0.
        counts: (G,) int64 draws of each candidate.
        parameters: (6,) float64 in the order of `PRIORS`.
        sweeps: (1,) int64 sweeps so far.
    """

    subgoal_of: npt.NDArray[np.int32]
    switched: npt.NDArray[np.bool_]
    slipped: npt.NDArray[np.bool_]
    partition_of: npt.NDArray[np.int32]
    counts: npt.NDArray[np.int64]
    parameters: npt.NDArray[np.float64]
    sweeps: npt.NDArray[np.int64]


class KernelModel(NamedTuple):
    """A `PursuitModel` as the kernels take it.

    Attributes:
        cost, state_of, starts, arrived, state_part, candidate_part, place, prior, uniform: as
            there.
        pair_of: (N,) number k of each observation's distinct (state, action) pair.
        pair_state, pair_action: (K,) the pairs.
        by_pair: (N,) the observations in the order of their pairs.
        near_first: (U + 1,) `near[near_first[u] : near_first[u + 1]]` are the candidates at which
            state u counts as having arrived.
        near: (M,).
        is_fixed: (6,) bool which parameters are not inferred.
        hyper: (6, 2) the two numbers of each parameter's prior.
        parts: number of parts.
    """

    cost: npt.NDArray[np.float64]
    state_of: npt.NDArray[np.int64]
    starts: npt.NDArray[np.bool_]
    arrived: npt.NDArray[np.bool_]
    state_part: npt.NDArray[np.int64]
    candidate_part: npt.NDArray[np.int64]
    place: npt.NDArray[np.int64]
    prior: npt.NDArray[np.float64]
    uniform: npt.NDArray[np.float64]
    pair_of: npt.NDArray[np.int64]
    pair_state: npt.NDArray[np.int64]
    pair_action: npt.NDArray[np.int64]
    by_pair: npt.NDArray[np.int64]
    near_first: npt.NDArray[np.int64]
    near: npt.NDArray[np.int64]
    is_fixed: npt.NDArray[np.bool_]
    hyper: npt.NDArray[np.float64]
    parts: int


def kernel_model(model: PursuitModel) -> KernelModel:
    """A model in the form that the kernels of sampler, mode and filter take."""
    actions = model.cost.shape[1]
    keys = model.state_of * actions + model.action_of
    pairs, pair_of = distinct(keys, len(model.cost) * actions)
    return KernelModel(
        cost=model.cost,
        state_of=model.state_of,
        starts=model.starts,
        arrived=model.arrived,
        state_part=model.state_part,
        candidate_part=model.candidate_part,
        place=model.place,
        prior=model.prior,
        uniform=model.uniform,
        pair_of=pair_of,
        pair_state=pairs // actions,
        pair_action=pairs % actions,
        by_pair=ascending(pair_of, len(pairs)),
        near_first=np.concatenate([[0], np.cumsum(model.arrived.sum(axis=1))]).astype(np.int64),
        near=np.nonzero(model.arrived)[1].astype(np.int64),
        is_fixed=np.array([name in model.fixed for name in PRIORS]),
        hyper=np.array([model.priors[name][1:] for name in PRIORS], dtype=np.float64),
        parts=int(model.candidate_part.max()) + 1,
    )


def room_for(model: PursuitModel, shape: tuple[int, ...]) -> Draws:
    """Draws still to be filled: `shape` is (draws,) or (chains, draws)."""
    return Draws.empty(shape, len(model.state_of), len(PRIORS))


def initial_state(model: PursuitModel, generator: np.random.Generator) -> PursuitState:
    """Parameters from their priors; every episode one pursuit, of a subgoal from P(g)."""
    parameters = np.array(
        [
            model.fixed[name] if name in model.fixed else prior.draw(generator)
            for name, prior in model.priors.items()
        ]
    )
    return _extended(
        model,
        np.full(len(model.state_of), -1, dtype=np.int32),
        model.starts.copy(),
        parameters,
        generator,
    )


def going_on(
    model: PursuitModel,
    state: PursuitState,
    row_before: npt.NDArray[np.int64],
    candidate_now: npt.NDArray[np.int64],
    generator: np.random.Generator,
) -> PursuitState:
    """A state that goes on from an older one, see `Sampler.going_on`.

    What was observed then keeps its subgoal; a new observation keeps that of the one before it.
    """
    known = row_before >= 0
    subgoal_of = np.full(len(row_before), -1, dtype=np.int32)
    subgoal_of[known] = candidate_now[state.subgoal_of[row_before[known]]]
    switched = model.starts.copy()
    switched[known] |= state.switched[row_before[known]]
    parameters = np.array(
        [
            model.fixed.get(name, value)
            for name, value in zip(PRIORS, state.parameters, strict=True)
        ]
    )
    return _extended(model, subgoal_of, switched, parameters, generator)


def _extended(
    model: PursuitModel,
    subgoal_of: npt.NDArray[np.int32],
    switched: npt.NDArray[np.bool_],
    parameters: npt.NDArray[np.float64],
    generator: np.random.Generator,
) -> PursuitState:
    """A state with a subgoal wherever there was none (-1): that before it, or one by chance."""
    part = model.state_part[model.state_of]
    subgoals = np.where(model.candidate_part[subgoal_of] == part, subgoal_of, np.int32(-1))
    for t in np.flatnonzero(model.starts & (subgoals < 0)):
        subgoals[t] = generator.choice(np.flatnonzero(model.candidate_part == part[t]))
    return state_of(model, filled_forward(subgoals), switched, parameters)


def filled_forward(subgoal_of: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """(N,) each subgoal that is missing (negative) like the last one before it, if there is."""
    rows = np.where(subgoal_of >= 0, np.arange(len(subgoal_of)), 0)
    return subgoal_of[np.maximum.accumulate(rows)]


def state_of(
    model: PursuitModel,
    subgoal_of: npt.NDArray[np.int32],
    switched: npt.NDArray[np.bool_],
    parameters: npt.NDArray[np.float64],
) -> PursuitState:
    """A state from subgoals (N,), with the switches (N,) that are known and those they take."""
    switched = switched | model.starts | (np.diff(subgoal_of, prepend=subgoal_of[:1]) != 0)
    # Where a switch is certain, it has happened.
    switched |= model.switch_probability(subgoal_of, parameters) == 1.0
    return PursuitState(
        subgoal_of=subgoal_of,
        switched=switched,
        slipped=np.zeros(len(subgoal_of), dtype=np.bool_),
        partition_of=np.zeros(len(subgoal_of), dtype=np.int32),
        counts=np.bincount(subgoal_of[switched], minlength=len(model.prior)).astype(np.int64),
        parameters=np.array(parameters, dtype=np.float64),
        sweeps=np.zeros(1, dtype=np.int64),
    )


def advance(
    model: PursuitModel,
    state: PursuitState,
    generator: np.random.Generator,
    draws: Draws,
    thin: int = 1,
) -> None:
    """Sweep on from `state`, changing it, until all of `draws` is filled.

    Every `thin`-th sweep is recorded; a slip has subgoal and partition -1. Releases the GIL; equal
    generators give equal draws.
    """
    arrays = (draws.subgoal_of, draws.partition_of, draws.log_joint, draws.parameters)
    kernel = kernel_model(model)
    candidates = len(kernel.prior)
    longest = max(_SHORTEST_BLOCK, min(_LONGEST_BLOCK, _BLOCK_ENTRIES // candidates))
    # Numpy asks for large pages, which numba does not.
    table = np.empty((len(kernel.pair_state), candidates))
    _advance(kernel, state, generator, thin, table, np.empty((longest, candidates)), *arrays)


@njit(nogil=True, cache=True)
def _advance(  # type: ignore[no-untyped-def]
    model,
    state,
    generator,
    thin,
    chosen,
    forward,
    subgoal_of,
    partition_of,
    log_joint,
    parameters,
):
    """`chosen` (K, G) and `forward` (block, G) are room for the softmax table and a block."""
    _fill_softmax_table(model, state.parameters[ALPHA], chosen)
    scratch = np.empty(state.subgoal_of.shape[0], dtype=np.int32)
    relocation_period = 1 + scratch.shape[0] // _RELOCATED
    relocations = min(1 + _RELOCATED // (1 + scratch.shape[0]), _RELOCATIONS)
    # A draw of alpha takes a new table, an exponential for each cost: it comes round so rarely
    # that this is less than a third of all work. What an observation takes besides its candidates
    # counts as so many of them.
    overhead = _OVERHEAD // relocation_period
    period = 1 + 4 * model.cost.size // (scratch.shape[0] * (model.prior.shape[0] + overhead))
    for draw in range(log_joint.shape[0]):
        for _ in range(thin):
            _draw_blocks(model, state, chosen, forward, generator)
            if state.sweeps[0] % relocation_period == 0:
                searching = state.sweeps[0] < _SEARCH
                for _again in range(4 * relocations if searching else relocations):
                    _relocate(model, state, chosen, generator)
            # Partitions depend on eta and on the switches, whose draws have them integrated out:
            # they come after these.
            _draw_switches(model, state, generator)
            _draw_concentration(model, state, generator)
            _draw_groups(model, state, chosen, generator)
            confidence_too = state.sweeps[0] % period == 0
            _draw_action_parameters(model, state, chosen, confidence_too, generator)
            if confidence_too and not model.is_fixed[ALPHA]:
                _fill_softmax_table(model, state.parameters[ALPHA], chosen)
            # For the record only, but in every sweep: thinning chooses sweeps of the same chain.
            _draw_slips(model, state, chosen, generator)
            state.sweeps[0] += 1
        log_joint[draw] = log_joint_of(model, state, chosen)
        parameters[draw] = state.parameters
        partition_of[draw] = np.where(state.slipped, np.int32(-1), state.partition_of)
        number_in_order(partition_of[draw], scratch)
        subgoal_of[draw] = np.where(state.slipped, np.int32(-1), state.subgoal_of)


@njit(nogil=True, cache=True)
def softmax_table(model, alpha):  # type: ignore[no-untyped-def]
    """(K, G) probability of each pair's action by the softmax, slips left out."""
    table = np.empty((model.pair_state.shape[0], model.prior.shape[0]))
    _fill_softmax_table(model, alpha, table)
    return table


@njit(nogil=True, cache=True)
def _fill_softmax_table(model, alpha, table):  # type: ignore[no-untyped-def]
    states, actions, candidates = model.cost.shape
    unobserved, total = np.empty(candidates), np.empty(candidates)
    first = end = 0  # of the pairs of a state, which are in the order of their actions
    for state in range(states):
        first = end
        total[:] = 0.0
        for action in range(actions):
            row = unobserved
            if (
                end < table.shape[0]
                and model.pair_state[end] == state
                and model.pair_action[end] == action
            ):
                row = table[end]
                end += 1
            exponentials(model.cost[state, action], -alpha, row)
            for candidate in range(candidates):
                total[candidate] += row[candidate]
        for candidate in range(candidates):
            total[candidate] = 1.0 / total[candidate]
        for pair in range(first, end):
            row = table[pair]
            for candidate in range(candidates):
                share = row[candidate] * total[candidate]
                row[candidate] = share if share > LEAST_PROBABILITY else LEAST_PROBABILITY


@njit(nogil=True, cache=True, inline="always")
def likelihood(model, parameters, chosen, t, candidate):  # type: ignore[no-untyped-def]
    """P(a_t | s_t, g), slips included."""
    explained = (1.0 - parameters[SLIP]) * chosen[model.pair_of[t], candidate]
    return explained + unexplained(model, parameters, t)


@njit(nogil=True, cache=True, inline="always")
def unexplained(model, parameters, t):  # type: ignore[no-untyped-def]
    """The part of a slip in P(a_t | s_t, g)."""
    return parameters[SLIP] * model.uniform[model.state_of[t]]


@njit(nogil=True, cache=True, inline="always")
def _place(arrived, state_of, t, candidate):  # type: ignore[no-untyped-def]
    """0 on arrival at the candidate, 1 where there already, 2 elsewhere."""
    if not arrived[state_of[t], candidate]:
        return 2
    return 1 if arrived[state_of[t - 1], candidate] else 0


@njit(nogil=True, cache=True, inline="always")
def switch_probability(arrived, state_of, parameters, t, candidate):  # type: ignore[no-untyped-def]
    """Rho before observation t, which begins no episode, where `candidate` was pursued.

    Takes the two arrays of the model: for a model, numba would count references to all of its
    arrays, which takes much longer than this.
    """
    return parameters[ON_ARRIVAL + _place(arrived, state_of, t, candidate)]


@njit(nogil=True, cache=True)
def urn_weights(model, eta, counts, part):  # type: ignore[no-untyped-def]
    """(G,) probability that the next draw in a part of the map is each candidate."""
    candidate_part, prior = model.candidate_part, model.prior
    scale = 1.0 / (eta + _drawn(candidate_part, counts, part))
    weights = np.empty(counts.shape[0])
    for candidate in range(weights.shape[0]):
        weight = (eta * prior[candidate] + counts[candidate]) * scale
        weights[candidate] = weight if candidate_part[candidate] == part else 0.0
    return weights


@njit(nogil=True, cache=True)
def _drawn(candidate_part, counts, part):  # type: ignore[no-untyped-def]
    """Number of draws in a part of the map."""
    drawn = 0
    for candidate in range(counts.shape[0]):
        drawn += counts[candidate] if candidate_part[candidate] == part else 0
    return drawn


@njit(nogil=True, cache=True)
def forward_pass(model, parameters, chosen, weights, first, end, before, forward, evidence):  # type: ignore[no-untyped-def]
    """Filter observations `first` to `end` of one episode.

    Fills evidence[i] with the probability of action t = first + i given those before it, and
    forward[i] (G,) with P(theta_t, action t | actions before t): the filter times the evidence.
    `before` (G,) is the filter at first - 1; where `first` begins the episode it is of no effect.
    """
    starts, state_of, pair_of, uniform = model.starts, model.state_of, model.pair_of, model.uniform
    arrived, near_first, near = model.arrived, model.near_first, model.near
    candidates = weights.shape[0]
    on_arrival, at_subgoal = parameters[ON_ARRIVAL], parameters[AT_SUBGOAL]
    elsewhere = parameters[ELSEWHERE]
    explained = 1.0 - parameters[SLIP]
    before = before.copy()
    of_near = np.empty(candidates)
    scale = 1.0
    for t in range(first, end):
        state = state_of[t]
        likely, after = chosen[pair_of[t]], forward[t - first]
        unexplained = parameters[SLIP] * uniform[state]
        keep, switch = 0.0, 1.0
        here = there = near_first[state]
        if not starts[t]:
            keep, switch = (1.0 - elsewhere) * scale, elsewhere
            there = near_first[state + 1]
            # Candidates at which the demonstrator has arrived are kept by a probability of their
            # own: they are taken out of the many, and added when these are done.
            for index in range(here, there):
                candidate = near[index]
                rho = at_subgoal if arrived[state_of[t - 1], candidate] else on_arrival
                of_near[index - here] = before[candidate]
                switch += before[candidate] * scale * (rho - elsewhere)
                before[candidate] = 0.0
        for candidate in range(candidates):
            moved = before[candidate] * keep + switch * weights[candidate]
            after[candidate] = moved * (explained * likely[candidate] + unexplained)
        for index in range(here, there):
            candidate = near[index]
            rho = at_subgoal if arrived[state_of[t - 1], candidate] else on_arrival
            before[candidate] = of_near[index - here]
            kept = before[candidate] * scale * (1.0 - rho)
            after[candidate] += kept * (explained * likely[candidate] + unexplained)
        total = row_sum(after)
        evidence[t - first] = total
        scale = 1.0 / total
        before = after


@njit(nogil=True, cache=True, inline="always")
def near(model, t):  # type: ignore[no-untyped-def]
    """Candidates at which the demonstrator counts as having arrived when it chose action t."""
    state = model.state_of[t]
    return model.near[model.near_first[state] : model.near_first[state + 1]]


@njit(nogil=True, cache=True)
def _draw_blocks(model, state, chosen, forward, generator):  # type: ignore[no-untyped-def]
    """Step 1, block by block; the first block's end is random, so that the bounds move."""
    span = math.log(forward.shape[0] / _SHORTEST_BLOCK)
    length = int(_SHORTEST_BLOCK * math.exp(generator.random() * span))
    limit = 1 + int(generator.random() * length)
    count = model.starts.shape[0]
    first = np.int64(0)
    while first < count:
        end = first + 1
        while end < count and end - first < limit and not model.starts[end]:
            end += 1
        _draw_block(model, state, chosen, forward, first, end, generator)
        first, limit = end, length


@njit(nogil=True, cache=True)
def _draw_block(model, state, chosen, forward, first, end, generator):  # type: ignore[no-untyped-def]
    """Observations `first` to `end` of one episode, and whether there is a switch at `end`."""
    theta, parameters, counts = state.subgoal_of, state.parameters, state.counts
    goes_on = end < model.starts.shape[0] and not model.starts[end]
    last = end + 1 if goes_on else end
    count_draws(counts, theta[first:last], state.switched[first:last], -1)
    part = model.state_part[model.state_of[first]]
    weights = urn_weights(model, parameters[ETA], counts, part)

    new_theta, new_switched = _draw_path(
        model, parameters, chosen, weights, theta, forward, first, end, generator
    )
    ratio = urn_ratio(model, parameters[ETA], counts, weights, new_theta, new_switched)
    ratio -= urn_ratio(
        model, parameters[ETA], counts, weights, theta[first:last], state.switched[first:last]
    )
    if ratio >= 0.0 or generator.random() < math.exp(ratio):
        theta[first:last] = new_theta
        state.switched[first:last] = new_switched
    count_draws(counts, theta[first:last], state.switched[first:last], 1)


@njit(nogil=True, cache=True)
def _draw_path(model, parameters, chosen, weights, theta, forward, first, end, generator):  # type: ignore[no-untyped-def]
    """Subgoals of observations `first` to `end` of one episode, and where they were switched to.

    By forward filtering, backward sampling: given the `weights`, the parameters, and the subgoals
    before `first` and, where the episode goes on, at `end`; the switch at `end` is drawn, too.
    """
    arrived, state_of, near_first, near = (
        model.arrived,
        model.state_of,
        model.near_first,
        model.near,
    )
    elsewhere = parameters[ELSEWHERE]
    candidates = weights.shape[0]
    goes_on = end < model.starts.shape[0] and not model.starts[end]
    last = end + 1 if goes_on else end
    before = np.zeros(candidates)
    if not model.starts[first]:
        before[theta[first - 1]] = 1.0
    evidence = np.empty(end - first)
    forward_pass(model, parameters, chosen, weights, first, end, before, forward, evidence)

    new_theta = np.empty(last - first, dtype=np.int32)
    new_switched = np.empty(last - first, dtype=np.bool_)
    weight = np.empty(candidates)
    if goes_on:
        new_theta[end - first] = theta[end]
    else:
        i = end - 1 - first
        new_theta[i] = categorical(forward[i], evidence[i], generator)
    for t in range(last - 1, first, -1):
        i = t - first
        target = new_theta[i]
        rho = switch_probability(arrived, state_of, parameters, t, target)
        kept = forward[i - 1, target] * (1.0 - rho)
        mass = elsewhere * evidence[i - 1]  # of a switch
        here, there = near_first[state_of[t]], near_first[state_of[t] + 1]
        for index in range(here, there):
            candidate = near[index]
            rho = switch_probability(arrived, state_of, parameters, t, candidate)
            mass += forward[i - 1, candidate] * (rho - elsewhere)
        switches = mass * weights[target]
        new_switched[i] = generator.random() * (kept + switches) >= kept
        if new_switched[i]:
            for candidate in range(candidates):
                weight[candidate] = forward[i - 1, candidate] * elsewhere
            for index in range(here, there):
                candidate = near[index]
                rho = switch_probability(arrived, state_of, parameters, t, candidate)
                weight[candidate] = forward[i - 1, candidate] * rho
            new_theta[i - 1] = categorical(weight, row_sum(weight), generator)
        else:
            new_theta[i - 1] = target
    new_switched[0] = True
    if not model.starts[first] and new_theta[0] == theta[first - 1]:
        rho = switch_probability(arrived, state_of, parameters, first, new_theta[0])
        switches = rho * weights[new_theta[0]]
        new_switched[0] = generator.random() * (1.0 - rho + switches) >= 1.0 - rho
    return new_theta, new_switched


@njit(nogil=True, cache=True)
def urn_ratio(model, eta, counts, weights, theta, switched):  # type: ignore[no-untyped-def]
    """Log of the urn's probability of a sequence over that of independent draws from `weights`.

    `counts` are those without the sequence; they are changed meanwhile.
    """
    part = drawn = np.int64(-1)
    ratio = 0.0
    for i in range(theta.shape[0]):
        if not switched[i]:
            continue
        candidate = theta[i]
        if part < 0:
            part = model.candidate_part[candidate]
            drawn = _drawn(model.candidate_part, counts, part)
        probability = (eta * model.prior[candidate] + counts[candidate]) / (eta + drawn)
        ratio += math.log(probability / weights[candidate])
        counts[candidate] += 1
        drawn += 1
    count_draws(counts, theta, switched, -1)
    return ratio


@njit(nogil=True, cache=True)
def _relocate(model, state, chosen, generator):  # type: ignore[no-untyped-def]
    """One subgoal to a cell beside it, or not, all paths and switches being open meanwhile.

    Where all pursuits of a subgoal agree on a cell beside the true one, they would have to leave
    it one by one, or together with their switches where they are, most of which are arrivals: a
    chain would stay there for long.

    The weights are drawn and held. Those in a window of 3 x 3 cells, but for other subgoals, are
    permuted so that the subgoal's comes to lie at any of its cells. The prior of the weights is
    the same for all permutations, P(g) being uniform, so each has the probability of all actions
    given the weights, which forward filtering gives. Only paths over the candidates of weight and
    the window are open, a set that is the same for all permutations and has the present path in
    it.
    """
    weights = _draw_weights(model, state, generator)
    heavy = _HEAVY / state.subgoal_of.shape[0]  # few candidates that are pursued weigh less
    # Half of the time by their weights, which go with them: those pursued most come to it soonest.
    by_weight = generator.random() < 0.5
    odds = np.zeros(weights.shape[0])
    for candidate in range(weights.shape[0]):
        if weights[candidate] > heavy:
            odds[candidate] = weights[candidate] if by_weight else 1.0
    subgoal = categorical(odds, row_sum(odds), generator)
    left = model.place[subgoal, 0] - int(3.0 * generator.random())
    bottom = model.place[subgoal, 1] - int(3.0 * generator.random())
    part = model.candidate_part[subgoal]
    lanes, window = [], []
    for candidate in range(weights.shape[0]):
        if model.candidate_part[candidate] != part:
            continue
        light = weights[candidate] <= heavy
        x, y = model.place[candidate]
        inside = left <= x < left + 3 and bottom <= y < bottom + 3
        if candidate == subgoal or (light and inside):
            window.append(len(lanes))
        if not light or inside:
            lanes.append(candidate)
        elif state.counts[candidate] > 0:
            return
    candidates = np.array(lanes)
    bounds = _episode_bounds(model, part)
    if len(window) < 2 or bounds.shape[0] == 0:
        return
    longest = (bounds[:, 1] - bounds[:, 0]).max()
    if longest * candidates.shape[0] > _BLOCK_ENTRIES:
        return
    if generator.random() * candidates.shape[0] > _LANES:  # as rare as it is expensive
        return
    small = _restricted(model, candidates)
    likely = np.ascontiguousarray(chosen[:, candidates])
    forward = np.empty((longest, candidates.shape[0]))
    light_weights = [weights[candidates[lane]] for lane in window if candidates[lane] != subgoal]
    trials = np.empty((len(window), candidates.shape[0]))
    for option in range(len(window)):
        trials[option] = weights[candidates]
        place = 0
        for other in range(len(window)):
            if other == option:
                trials[option, window[other]] = weights[subgoal]
            else:
                trials[option, window[other]] = light_weights[place]
                place += 1
    scores = _log_evidence(small, state.parameters, likely, trials, bounds)
    likely_options = np.exp(scores - scores.max())
    option = categorical(likely_options, likely_options.sum(), generator)
    for episode in range(bounds.shape[0]):
        first, end = bounds[episode]
        path, switched = _draw_path(
            small,
            state.parameters,
            likely,
            trials[option],
            state.subgoal_of,
            forward,
            first,
            end,
            generator,
        )
        state.subgoal_of[first:end] = candidates[path]
        state.switched[first:end] = switched
    state.counts[:] = 0
    count_draws(state.counts, state.subgoal_of, state.switched, 1)


@njit(nogil=True, cache=True)
def _log_evidence(model, parameters, chosen, weights, bounds):  # type: ignore[no-untyped-def]
    """(W,) log-probability of all actions in these episodes, given each of `weights` (W, G).

    What `forward_pass` tells, without keeping the messages: those of one observation do for all
    weights in turn, and none waits for the one before, as messages of the next observation do.
    """
    trials, candidates = weights.shape
    lanes = (candidates + _SUMS - 1) // _SUMS * _SUMS  # those at the end remain zero
    explained = 1.0 - parameters[SLIP]
    likely, stays, drawn = np.zeros(lanes), np.zeros(lanes), np.zeros((trials, lanes))
    drawn[:, :candidates] = weights
    message, total, scores = np.empty((trials, lanes)), np.empty(trials), np.zeros(trials)
    for episode in range(bounds.shape[0]):
        first, end = bounds[episode]
        message[:] = 0.0
        total[:] = 1.0
        for t in range(first, end):
            state, pair = model.state_of[t], model.pair_of[t]
            unexplained = parameters[SLIP] * model.uniform[state]
            rho = parameters[ELSEWHERE]
            here, there = model.near_first[state], model.near_first[state + 1]
            if t == first:
                rho, there = 1.0, here
            for candidate in range(candidates):
                likely[candidate] = explained * chosen[pair, candidate] + unexplained
                stays[candidate] = 1.0 - rho
            for candidate in model.near[here:there]:
                at = model.arrived[model.state_of[t - 1], candidate]
                stays[candidate] = 1.0 - (parameters[AT_SUBGOAL] if at else parameters[ON_ARRIVAL])
            for trial in range(trials):
                switch = rho * total[trial]
                for index in range(here, there):
                    candidate = model.near[index]
                    switch += message[trial, candidate] * (1.0 - stays[candidate] - rho)
                for lane in range(lanes):
                    moved = message[trial, lane] * stays[lane] + switch * drawn[trial, lane]
                    message[trial, lane] = moved * likely[lane]
                a = b = c = d = 0.0
                for lane in range(0, lanes, _SUMS):
                    a += message[trial, lane]
                    b += message[trial, lane + 1]
                    c += message[trial, lane + 2]
                    d += message[trial, lane + 3]
                total[trial] = (a + c) + (b + d)
                if total[trial] < _SMALL:
                    scores[trial] += math.log(total[trial])
                    for lane in range(lanes):
                        message[trial, lane] /= total[trial]
                    total[trial] = 1.0
        scores += np.log(total)
    return scores


@njit(nogil=True, cache=True)
def _episode_bounds(model, part):  # type: ignore[no-untyped-def]
    """(E, 2) first observation and end of each episode in a part of the map."""
    firsts = np.flatnonzero(model.starts)
    ends = np.append(firsts[1:], model.starts.shape[0])
    here = model.state_part[model.state_of[firsts]] == part
    return np.column_stack((firsts[here], ends[here]))


@njit(nogil=True, cache=True)
def _restricted(model, candidates):  # type: ignore[no-untyped-def]
    """A model that knows some of the candidates only, as far as paths are concerned."""
    arrived = np.ascontiguousarray(model.arrived[:, candidates])
    first = np.zeros(arrived.shape[0] + 1, dtype=np.int64)
    near_candidates = np.empty(arrived.sum(), dtype=np.int64)
    count = 0
    for state in range(arrived.shape[0]):
        for lane in range(arrived.shape[1]):
            if arrived[state, lane]:
                near_candidates[count] = lane
                count += 1
        first[state + 1] = count
    return KernelModel(
        model.cost,
        model.state_of,
        model.starts,
        arrived,
        model.state_part,
        model.candidate_part[candidates],
        model.place[candidates],
        model.prior[candidates],
        model.uniform,
        model.pair_of,
        model.pair_state,
        model.pair_action,
        model.by_pair,
        first,
        near_candidates,
        model.is_fixed,
        model.hyper,
        model.parts,
    )


@njit(nogil=True, cache=True)
def _draw_groups(model, state, chosen, generator):  # type: ignore[no-untyped-def]
    """Step 4: partitions of the draws given their subgoals, then each partition's subgoal.

    P(partitions | subgoals): among the draws of g, a Chinese restaurant process with concentration
    eta P(g). P(subgoal | partition): P(g) times the product of all that its observations say.
    """
    groups = _draw_partitions(model, state, generator)
    scores = group_scores(model, state, chosen, groups)
    subgoal = np.empty(groups, dtype=np.int32)
    for group in range(groups):
        weights = np.exp(scores[group] - scores[group].max())
        subgoal[group] = categorical(weights, weights.sum(), generator)
    state.subgoal_of[:] = subgoal[state.partition_of]
    state.counts[:] = 0
    count_draws(state.counts, state.subgoal_of, state.switched, 1)


@njit(nogil=True, cache=True)
def _draw_partitions(model, state, generator):  # type: ignore[no-untyped-def]
    """Fill `partition_of`; returns the number of partitions."""
    eta = state.parameters[ETA]
    count = state.subgoal_of.shape[0]
    seated = np.zeros(model.prior.shape[0], dtype=np.int64)
    newest = np.full(model.prior.shape[0], -1, dtype=np.int64)
    older = np.empty(count, dtype=np.int64)  # of each partition, one with the same subgoal
    size = np.zeros(count, dtype=np.int64)
    partitions = 0
    for t in range(count):
        if not state.switched[t]:
            state.partition_of[t] = state.partition_of[t - 1]
            continue
        subgoal = state.subgoal_of[t]
        remaining = generator.random() * (seated[subgoal] + eta * model.prior[subgoal])
        partition = newest[subgoal]
        while partition >= 0:
            remaining -= size[partition]
            if remaining < 0.0:
                break
            partition = older[partition]
        if partition < 0:
            partition = partitions
            older[partition] = newest[subgoal]
            newest[subgoal] = partition
            partitions += 1
        size[partition] += 1
        seated[subgoal] += 1
        state.partition_of[t] = partition
    return partitions


@njit(nogil=True, cache=True)
def log_likelihood_table(model, parameters, chosen):  # type: ignore[no-untyped-def]
    """(K, G) log P(a | s, g) of each distinct pair, slips included."""
    table = np.empty_like(chosen)
    for pair in range(chosen.shape[0]):
        by_slip = parameters[SLIP] * model.uniform[model.pair_state[pair]]
        table[pair] = np.log((1.0 - parameters[SLIP]) * chosen[pair] + by_slip)
    return table


@njit(nogil=True, cache=True)
def group_scores(model, state, chosen, groups):  # type: ignore[no-untyped-def]
    """(J, G) log of P(g) times all probabilities in which a partition's subgoal occurs.

    The probabilities of the actions are multiplied, as a logarithm costs more than ten products.
    """
    parameters, candidates = state.parameters, model.prior.shape[0]
    part = np.zeros(groups, dtype=np.int64)
    products = np.ones((groups, candidates))
    powers = np.zeros((groups, candidates), dtype=np.int64)  # of two, taken out of the products
    factors = np.zeros(groups, dtype=np.int64)
    explained = 1.0 - parameters[SLIP]
    least = max(explained * LEAST_PROBABILITY, parameters[SLIP] * model.uniform.min())
    most_factors = max(1, int(math.log(1e-300) / math.log(least)))  # that cannot underflow
    partition_of, state_of, pair_of = state.partition_of, model.state_of, model.pair_of
    for t in model.by_pair:  # a row of the table is read once
        group, pair = partition_of[t], pair_of[t]
        part[group] = model.state_part[state_of[t]]
        by_slip = parameters[SLIP] * model.uniform[state_of[t]]
        for candidate in range(candidates):
            products[group, candidate] *= explained * chosen[pair, candidate] + by_slip
        factors[group] += 1
        if factors[group] % most_factors == 0:
            _take_out_powers(products[group], powers[group])
    scores = np.empty((groups, candidates))
    for group in range(groups):
        for candidate in range(candidates):
            if model.candidate_part[candidate] == part[group]:
                score = math.log(products[group, candidate] * model.prior[candidate])
                scores[group, candidate] = score + powers[group, candidate] * _LN_2
            else:
                scores[group, candidate] = -np.inf
    # What a candidate at which the demonstrator had arrived gains over the others.
    gains = np.empty((2, 2))  # by whether there was a switch, and `_place`
    for place in range(2):
        rho, usual = parameters[ON_ARRIVAL + place], parameters[ELSEWHERE]
        gains[0, place] = floored_log(1.0 - rho) - floored_log(1.0 - usual)
        gains[1, place] = floored_log(rho) - floored_log(usual)
    arrived, near, switched = model.arrived, model.near, state.switched
    for t in range(1, partition_of.shape[0]):
        if not model.starts[t]:
            state_now = state_of[t]
            for index in range(model.near_first[state_now], model.near_first[state_now + 1]):
                place = _place(arrived, state_of, t, near[index])
                scores[partition_of[t - 1], near[index]] += gains[np.int64(switched[t]), place]
    return scores


@njit(nogil=True, cache=True)
def _take_out_powers(product, powers):  # type: ignore[no-untyped-def]
    """Leave of each product (G,) what is in [1, 2), and add its power of two to powers (G,)."""
    bits = product.view(np.int64)
    for candidate in range(bits.shape[0]):
        powers[candidate] += (bits[candidate] >> 52) - 1023
        bits[candidate] = (bits[candidate] & _FRACTION) | _ONE


@njit(nogil=True, cache=True)
def floored_log(probability):  # type: ignore[no-untyped-def]
    """A logarithm of which differences can be taken: impossible is e^-690."""
    return math.log(max(probability, 1e-300))


@njit(nogil=True, cache=True)
def _draw_slips(model, state, chosen, generator):  # type: ignore[no-untyped-def]
    """Which actions are slips."""
    for t in range(state.subgoal_of.shape[0]):
        total = likelihood(model, state.parameters, chosen, t, state.subgoal_of[t])
        state.slipped[t] = generator.random() * total < unexplained(model, state.parameters, t)


@njit(nogil=True, cache=True)
def _draw_switches(model, state, generator):  # type: ignore[no-untyped-def]
    """The switch probabilities, and where the subgoal before was drawn again.

    Both given the subgoals and the weights, which are drawn for this step and then forgotten.
    Given where there were switches, a probability near 1 would move in very small steps.
    """
    weights = _draw_weights(model, state, generator)
    candidates = weights.shape[0]
    same = np.zeros((3, candidates))
    changes = np.zeros(3, dtype=np.int64)
    theta, parameters, switched, counts = (
        state.subgoal_of,
        state.parameters,
        state.switched,
        state.counts,
    )
    starts, arrived, state_of = model.starts, model.arrived, model.state_of
    for t in range(1, theta.shape[0]):
        if not starts[t]:
            candidate = theta[t - 1]
            place = _place(arrived, state_of, t, candidate)
            if theta[t] == candidate:
                same[place, candidate] += 1.0
            else:
                changes[place] += 1
    no_counts, no_costs, nothing = changes[:0], np.empty((0, 0)), weights[:0]
    for place in range(3):
        parameter = ON_ARRIVAL + place
        if not model.is_fixed[parameter]:
            evidence = Evidence(
                no_counts,
                no_costs,
                nothing,
                nothing,
                nothing,
                changes[place : place + 1],
                same[place],
                weights,
            )
            _draw_by_slice(model, parameters, parameter, evidence, generator)
    counts[:] = 0
    for t in range(theta.shape[0]):
        candidate = theta[t]
        if starts[t] or candidate != theta[t - 1]:
            switched[t] = True
        else:
            rho = switch_probability(arrived, state_of, parameters, t, candidate)
            again = rho * weights[candidate]
            switched[t] = generator.random() * (1.0 - rho + again) < again
        counts[candidate] += switched[t]


@njit(nogil=True, cache=True)
def _draw_weights(model, state, generator):  # type: ignore[no-untyped-def]
    """(G,) weight of each candidate, given all draws."""
    total = np.zeros(model.parts)
    weights = np.empty(state.counts.shape[0])
    for candidate in range(weights.shape[0]):
        weight = state.parameters[ETA] * model.prior[candidate] + state.counts[candidate]
        weights[candidate] = generator.standard_gamma(weight)
        total[model.candidate_part[candidate]] += weights[candidate]
    for candidate in range(weights.shape[0]):
        weights[candidate] /= total[model.candidate_part[candidate]]
    return weights


class Evidence(NamedTuple):
    """What there is on one parameter; empty what there is on others.

    Attributes:
        counts: (G,) on eta: draws of each candidate.
        costs: (A + 1, M) on alpha: costs of an action taken, and of all actions.
        times: (M,) how often it was.
        shares: (M,) on the probability of a slip: that of an action taken, if it is none.
        uniform: (M,) on both: its probability if it is a slip.
        changes: (1,) on a switch probability: how often the subgoal changed.
        same: (G,) how often it remained the same.
        weights: (G,) probability of drawing the same again.
    """

    counts: npt.NDArray[np.int64]
    costs: npt.NDArray[np.float64]
    times: npt.NDArray[np.float64]
    shares: npt.NDArray[np.float64]
    uniform: npt.NDArray[np.float64]
    changes: npt.NDArray[np.int64]
    same: npt.NDArray[np.float64]
    weights: npt.NDArray[np.float64]


@njit(nogil=True, cache=True)
def _draw_concentration(model, state, generator):  # type: ignore[no-untyped-def]
    """Eta, given the draws from the urns."""
    if not model.is_fixed[ETA]:
        nothing = np.empty(0)
        evidence = Evidence(
            state.counts,
            np.empty((0, 0)),
            nothing,
            nothing,
            nothing,
            state.counts[:0],
            nothing,
            nothing,
        )
        _draw_by_slice(model, state.parameters, np.int64(ETA), evidence, generator)


@njit(nogil=True, cache=True)
def _draw_action_parameters(model, state, chosen, confidence_too, generator):  # type: ignore[no-untyped-def]
    """The probability of a slip, and alpha, given the subgoals; which actions slipped is open.

    Given the slips, either would move in very small steps.
    """
    none, nothing = state.counts[:0], state.parameters[:0]
    if not model.is_fixed[SLIP]:
        count = state.subgoal_of.shape[0]
        shares, uniform = np.empty(count), np.empty(count)
        for t in range(count):
            shares[t] = chosen[model.pair_of[t], state.subgoal_of[t]]
            uniform[t] = model.uniform[model.state_of[t]]
        evidence = Evidence(
            none, np.empty((0, 0)), nothing, shares, uniform, none, nothing, nothing
        )
        _draw_by_slice(model, state.parameters, np.int64(SLIP), evidence, generator)
    if confidence_too and not model.is_fixed[ALPHA]:
        costs, times, uniform = _costs_taken(model, state.subgoal_of)
        evidence = Evidence(none, costs, times, nothing, uniform, none, nothing, nothing)
        _draw_by_slice(model, state.parameters, np.int64(ALPHA), evidence, generator)


@njit(nogil=True, cache=True)
def _costs_taken(model, subgoal_of):  # type: ignore[no-untyped-def]
    """The distinct rows of actions and subgoals (M,), as `Evidence` has them on alpha."""
    actions, candidates = model.cost.shape[1:]
    count = subgoal_of.shape[0]
    keys, times = np.empty(count, dtype=np.int64), np.zeros(count)
    row_of = np.full(candidates, -1)  # of the pair at hand, from its first row on
    rows = first = np.int64(0)
    for index in range(count):
        t = model.by_pair[index]
        pair, candidate = model.pair_of[t], subgoal_of[t]
        if index > 0 and pair != model.pair_of[model.by_pair[index - 1]]:
            first = rows
        if row_of[candidate] < first:
            row_of[candidate] = rows
            keys[rows] = pair * candidates + candidate
            rows += 1
        times[row_of[candidate]] += 1.0
    costs, uniform = np.empty((actions + 1, rows)), np.empty(rows)
    for row in range(rows):
        pair, candidate = keys[row] // candidates, keys[row] % candidates
        state = model.pair_state[pair]
        costs[0, row] = model.cost[state, model.pair_action[pair], candidate]
        for action in range(actions):
            costs[action + 1, row] = model.cost[state, action, candidate]
        uniform[row] = model.uniform[state]
    return costs, times[:rows], uniform


@njit(nogil=True, cache=True)
def _draw_by_slice(model, parameters, parameter, evidence, generator):  # type: ignore[no-untyped-def]
    """A parameter by slice sampling (Neal 2003, stepping out) on an unbounded scale."""
    now = math.log(parameters[parameter])
    if parameter not in (ALPHA, ETA):
        now -= math.log1p(-parameters[parameter])
    level = _log_density(model, parameters, parameter, evidence, now)
    level -= generator.standard_exponential()
    low = now - _SLICE * generator.random()
    high = low + _SLICE
    while low > -_FARTHEST and _log_density(model, parameters, parameter, evidence, low) > level:
        low -= _SLICE
    while high < _FARTHEST and _log_density(model, parameters, parameter, evidence, high) > level:
        high += _SLICE
    while True:
        proposed = low + generator.random() * (high - low)
        if _log_density(model, parameters, parameter, evidence, proposed) >= level:
            break
        if proposed < now:
            low = proposed
        else:
            high = proposed
    parameters[parameter] = _unscaled(parameter, proposed)


@njit(nogil=True, cache=True)
def _unscaled(parameter, scaled):  # type: ignore[no-untyped-def]
    """A parameter from its logarithm, or a probability from its logit."""
    if parameter not in (ALPHA, ETA):
        return 1.0 / (1.0 + math.exp(-scaled))
    return math.exp(scaled)


@njit(nogil=True, cache=True)
def _log_density(model, parameters, parameter, evidence, scaled):  # type: ignore[no-untyped-def]
    """Log density of the logarithm of alpha or eta, or of the logit of another parameter.

    But for a constant.
    """
    value = _unscaled(parameter, scaled)
    first, second = model.hyper[parameter]
    if parameter in (ALPHA, ETA):
        density = -0.5 * ((scaled - math.log(first)) / second) ** 2
    else:
        density = first * math.log(value) + second * math.log1p(-value)
    if parameter == ETA:
        density += log_urns(model, value, evidence.counts)
    for number in evidence.changes:
        density += number * math.log(value)
    for candidate in range(evidence.same.shape[0]):
        if evidence.same[candidate] > 0.0:
            density += evidence.same[candidate] * math.log1p(
                value * (evidence.weights[candidate] - 1.0)
            )
    if parameter == SLIP:
        density += _log_of_slips(value, evidence)
    if parameter == ALPHA:
        density += _log_of_costs(value, parameters[SLIP], evidence)
    return density


@njit(nogil=True, cache=True)
def _log_of_slips(slip, evidence):  # type: ignore[no-untyped-def]
    """Log probability of the actions by that of a slip."""
    total, product = 0.0, 1.0
    for row in range(evidence.shares.shape[0]):
        product *= (1.0 - slip) * evidence.shares[row] + slip * evidence.uniform[row]
        if product < 1e-100:  # a single factor is not below `LEAST_PROBABILITY`
            total += floored_log(product)
            product = 1.0
    return total + math.log(product)


@njit(nogil=True, cache=True)
def _log_of_costs(alpha, slip, evidence):  # type: ignore[no-untyped-def]
    """Log probability of the actions by alpha."""
    costs = evidence.costs
    taken, weights = np.empty(costs.shape[1]), np.empty(costs.shape[1])
    total = np.zeros(costs.shape[1])
    exponentials(costs[0], -alpha, taken)
    for action in range(1, costs.shape[0]):
        exponentials(costs[action], -alpha, weights)
        for row in range(weights.shape[0]):
            total[row] += weights[row]
    density = 0.0
    for row in range(total.shape[0]):
        share = max(taken[row] / total[row], LEAST_PROBABILITY)
        probability = (1.0 - slip) * share + slip * evidence.uniform[row]
        density += evidence.times[row] * math.log(probability)
    return density


@njit(nogil=True, cache=True)
def log_joint_of(model, state, chosen):  # type: ignore[no-untyped-def]
    """As `PursuitModel.log_joint`."""
    parameters, theta, total = state.parameters, state.subgoal_of, 0.0
    arrived, state_of = model.arrived, model.state_of
    for t in range(theta.shape[0]):
        total += floored_log(likelihood(model, parameters, chosen, t, theta[t]))
        if not model.starts[t]:
            rho = switch_probability(arrived, state_of, parameters, t, theta[t - 1])
            total += floored_log(rho if state.switched[t] else 1.0 - rho)
    return total + log_urns(model, parameters[ETA], state.counts)


@njit(nogil=True, cache=True)
def log_urns(model, eta, counts):  # type: ignore[no-untyped-def]
    """Log probability of the draws (G,) from the urns of all parts, whatever their order."""
    total = 0.0
    drawn = np.zeros(model.parts, dtype=np.int64)
    for candidate in range(counts.shape[0]):
        count = counts[candidate]
        if count > 0:
            weight = eta * model.prior[candidate]
            total += math.lgamma(weight + count) - math.lgamma(weight)
            drawn[model.candidate_part[candidate]] += count
    for part in range(model.parts):
        total += math.lgamma(eta) - math.lgamma(eta + drawn[part])
    return total
