"""The posterior mode of the sequential model: the most probable pursuits.

Coordinate ascent on the joint, with the weights of the subgoals integrated out and the parameters
at their posterior medians, from the best of every hundred draws of each chain: whole blocks of
observations by the Viterbi algorithm, all pursuits of one subgoal at once, and subgoals of few
pursuits given up.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.kernels import count_draws
from bnirl_ros.inference.mode import Mode
from bnirl_ros.inference.pursuit_gibbs import (
    KernelModel,
    filled_forward,
    floored_log,
    group_scores,
    kernel_model,
    likelihood,
    log_joint_of,
    log_likelihood_table,
    log_urns,
    near,
    softmax_table,
    state_of,
    switch_probability,
    unexplained,
    urn_ratio,
    urn_weights,
)
from bnirl_ros.mdp.distinct import distinct
from bnirl_ros.model.pursuits import ALPHA, ELSEWHERE, ETA, PRIORS, PursuitModel
from bnirl_ros.threads import workers

_STRETCH = 100  # draws of a chain, of which the best one is a start
_GAIN = 1e-9  # nats; a smaller gain is rounding
_BLOCKS = (np.int64(1024), np.int64(32))  # observations that the Viterbi algorithm takes at once
_FEW = 4  # draws; a subgoal with more of them is not worth giving up
_REPLACEMENTS = 8  # candidates tried in its place, the most likely ones
_NONE = np.int64(-1)  # in the place of a candidate


def posterior_mode(model: PursuitModel, chains: Draws) -> Mode:
    """The best pursuits that ascent reaches from the best of every hundred draws of each chain.

    A subgoal's partition is all observations that it explains; an observation that is more
    probably a slip than not is in none.

    Args:
        model: the model that was sampled.
        chains: draws with leading axes (chain, draw).
    """
    parameters = np.median(chains.parameters.reshape(-1, len(PRIORS)), axis=0)
    joints = chains.log_joint
    # The best draws of chains may all lie below the same lesser mode.
    stretches = np.array_split(np.arange(joints.shape[1]), max(1, joints.shape[1] // _STRETCH))
    starts = [
        (chain, stretch[joints[chain, stretch].argmax()])
        for chain in range(len(joints))
        for stretch in stretches
    ]
    tables = _tables(model, parameters)
    with workers(len(starts)) as threads:
        modes = threads.map(
            lambda start: _ascended(model, chains.subgoal_of[start], parameters, *tables), starts
        )
        return max(modes, key=lambda mode: mode.log_joint)


def _tables(
    model: PursuitModel, parameters: npt.NDArray[np.float64]
) -> tuple[KernelModel, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """What all ascents with the same parameters read: `softmax_table` and its logarithms."""
    kernel = kernel_model(model)
    chosen = softmax_table(kernel, parameters[ALPHA])
    return kernel, chosen, log_likelihood_table(kernel, parameters, chosen)


def ascend(
    model: PursuitModel, subgoal_of: npt.ArrayLike, parameters: npt.NDArray[np.float64]
) -> Mode:
    """Coordinate ascent from a draw.

    Args:
        model: the model.
        subgoal_of: (N,) candidate index of each observation's subgoal; -1 for a slip, which is
            taken for part of the pursuit around it.
        parameters: in the order of `PRIORS`.
    """
    return _ascended(model, subgoal_of, parameters, *_tables(model, parameters))


def _ascended(
    model: PursuitModel,
    subgoal_of: npt.ArrayLike,
    parameters: npt.NDArray[np.float64],
    kernel: KernelModel,
    chosen: npt.NDArray[np.float64],
    likely: npt.NDArray[np.float64],
) -> Mode:
    """`ascend` with its tables."""
    given = np.asarray(subgoal_of, dtype=np.int32)
    subgoals = _with_slips(model, given)
    state = state_of(model, subgoals, model.starts, parameters)
    return _mode(subgoals, *_ascend(kernel, state, chosen, likely))


def extended(
    model: PursuitModel,
    subgoal_of: npt.NDArray[np.int32],
    parameters: npt.NDArray[np.float64],
) -> Mode:
    """The mode of a demonstration that has grown, from that of before.

    Only the last observations of the last episode are given other subgoals than before: the best
    path through the new ones and some of those before them.

    Args:
        model: the model now.
        subgoal_of: (N before,) candidate index, among those now, of what the mode was; -1 for a
            slip.
        parameters: in the order of `PRIORS`.
    """
    count, known = len(model.state_of), len(subgoal_of)
    given = np.concatenate([subgoal_of, np.full(count - known, -1, dtype=np.int32)])
    state = state_of(model, _with_slips(model, given), model.starts, parameters)
    subgoals = state.subgoal_of
    # One more before the block tells where it comes from, and stays as it is.
    first = max(known - int(_BLOCKS[1]), 0)
    end = replace(
        model,
        state_of=model.state_of[first:],
        action_of=model.action_of[first:],
        starts=np.append(True, model.starts[first + 1 :]),
    )
    _improve_end(
        kernel_model(end),
        state._replace(subgoal_of=subgoals[first:], switched=state.switched[first:]),
        np.int64(0 if model.starts[first] else 1),
    )
    # Candidates that are pursued nowhere make no difference to the joint.
    used, narrow = distinct(subgoals, len(model.prior))
    narrowed = replace(
        model,
        cost=model.cost[:, :, used],
        arrived=model.arrived[:, used],
        candidate_part=model.candidate_part[used],
        place=model.place[used],
    )
    state = state._replace(subgoal_of=narrow.astype(np.int32), counts=state.counts[used])
    kernel = kernel_model(narrowed)._replace(prior=model.prior[used])
    return _mode(subgoals, *_joint_and_slips(kernel, state))


def _mode(subgoals: npt.NDArray[np.int32], value: float, slipped: npt.NDArray[np.bool_]) -> Mode:
    """From subgoals (N,), the log joint, and which observations are slips."""
    labels, first, number = np.unique(
        np.where(slipped, -1, subgoals), return_index=True, return_inverse=True
    )
    first[labels < 0] = -1  # slips come first, as -1
    return Mode(
        subgoal_of=np.where(slipped, -1, subgoals).astype(np.int32),
        partition_of=(np.argsort(np.argsort(first))[number] - slipped.any()).astype(np.int32),
        log_joint=value,
    )


def _with_slips(model: PursuitModel, subgoal_of: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """(N,) subgoals with those of slips (-1), each taken for part of the pursuit around it."""
    missing = model.starts & (subgoal_of < 0)
    if missing.any():
        subgoal_of = np.where(missing, _next_known(subgoal_of, model), subgoal_of)
    return filled_forward(subgoal_of)


def _next_known(subgoal_of: npt.NDArray[np.int32], model: PursuitModel) -> npt.NDArray[np.int32]:
    """(N,) the next subgoal that is known; one that can be reached if there is none."""
    later = filled_forward(subgoal_of[::-1])[::-1]
    part = model.state_part[model.state_of]
    found = (later >= 0) & (model.candidate_part[later] == part)
    _, of_part = np.unique(model.candidate_part, return_index=True)
    return np.where(found, later, of_part[part]).astype(np.int32)


@njit(nogil=True, cache=True)
def _ascend(model, state, chosen, likely):  # type: ignore[no-untyped-def]
    """Ascent that changes `state`; returns the log joint and (N,) which actions are slips."""
    value = _climb(model, state, chosen, likely)
    gained = True
    while gained:
        gained = False
        for candidate in range(state.counts.shape[0]):
            if not 0 < state.counts[candidate] <= _FEW:
                continue
            # Given up (-1), or one of the most likely candidates in its place.
            for replacement in _replacements(model, state, chosen, candidate):
                subgoal_of, switched = state.subgoal_of.copy(), state.switched.copy()
                if replacement < 0:
                    _improve_blocks(model, state, likely, _BLOCKS[0], candidate, candidate)
                else:
                    _replace(state, candidate, replacement)
                    for length in _BLOCKS:
                        _improve_blocks(model, state, likely, length, replacement, _NONE)
                trial = log_joint_of(model, state, chosen)
                if trial > value + _GAIN:
                    value = trial
                    gained = True
                    break
                _restore(state, subgoal_of, switched)
        if gained:
            value = _climb(model, state, chosen, likely)
    return value, _slips(model, state, chosen)


@njit(nogil=True, cache=True)
def _improve_end(model, state, first):  # type: ignore[no-untyped-def]
    """The best paths through the observations from `first` on, episode by episode."""
    chosen = softmax_table(model, state.parameters[ALPHA])
    likely = log_likelihood_table(model, state.parameters, chosen)
    _improve_from(model, state, likely, first, _BLOCKS[0], _NONE, _NONE)


@njit(nogil=True, cache=True)
def _joint_and_slips(model, state):  # type: ignore[no-untyped-def]
    """As `log_joint_of`, with few candidates, and (N,) which actions are more probably slips."""
    chosen = softmax_table(model, state.parameters[ALPHA])
    likely = log_likelihood_table(model, state.parameters, chosen)
    total, rho_before, kept, left = 0.0, -1.0, 0.0, 0.0
    for t in range(state.subgoal_of.shape[0]):
        total += likely[model.pair_of[t], state.subgoal_of[t]]
        if not model.starts[t]:
            rho = switch_probability(
                model.arrived, model.state_of, state.parameters, t, state.subgoal_of[t - 1]
            )
            if rho != rho_before:
                rho_before, kept, left = rho, floored_log(1.0 - rho), floored_log(rho)
            total += left if state.switched[t] else kept
    total += log_urns(model, state.parameters[ETA], state.counts)
    return total, _slips(model, state, chosen)


@njit(nogil=True, cache=True)
def _slips(model, state, chosen):  # type: ignore[no-untyped-def]
    """(N,) which actions are more probably slips than not."""
    count = state.subgoal_of.shape[0]
    slipped = np.empty(count, dtype=np.bool_)
    for t in range(count):
        total = likelihood(model, state.parameters, chosen, t, state.subgoal_of[t])
        slipped[t] = unexplained(model, state.parameters, t) > 0.5 * total
    return slipped


@njit(nogil=True, cache=True)
def _replacements(model, state, chosen, candidate):  # type: ignore[no-untyped-def]
    """-1, and the candidates that suit the pursuits of one best; none for the only one there."""
    state.partition_of[:] = 1
    for t in range(state.subgoal_of.shape[0]):
        if state.subgoal_of[t] == candidate:
            state.partition_of[t] = 0
    scores = group_scores(model, state, chosen, np.int64(2))[0]
    best = scores.argsort()[::-1][:_REPLACEMENTS]
    # Those of another part of the map, at -inf, are none.
    best = best[(scores[best] > -np.inf) & (best != candidate)]
    replacements = np.full(best.shape[0] + 1, -1, dtype=np.int64)
    replacements[1:] = best
    return replacements if best.shape[0] > 0 else best


@njit(nogil=True, cache=True)
def _replace(state, old, new):  # type: ignore[no-untyped-def]
    """All pursuits of one subgoal become pursuits of another."""
    for t in range(state.subgoal_of.shape[0]):
        if state.subgoal_of[t] == old:
            state.subgoal_of[t] = new
    state.counts[new] += state.counts[old]
    state.counts[old] = 0


@njit(nogil=True, cache=True)
def _restore(state, subgoal_of, switched):  # type: ignore[no-untyped-def]
    state.subgoal_of[:] = subgoal_of
    state.switched[:] = switched
    state.counts[:] = 0
    count_draws(state.counts, subgoal_of, switched, 1)


@njit(nogil=True, cache=True)
def _climb(model, state, chosen, likely):  # type: ignore[no-untyped-def]
    """Blocks and whole subgoals in turn until nothing gains; returns the log joint."""
    value = log_joint_of(model, state, chosen)
    while True:
        for length in _BLOCKS:
            _improve_blocks(model, state, likely, length, _NONE, _NONE)
        _move_subgoals(model, state, chosen)
        now = log_joint_of(model, state, chosen)
        if now <= value + _GAIN:
            return now
        value = now


@njit(nogil=True, cache=True)
def _improve_blocks(model, state, likely, length, concerned, forbidden):  # type: ignore[no-untyped-def]
    """The best path through each block given the others, if it is better than the present one.

    With a candidate `concerned`, only through the blocks where it occurs; if it is `forbidden`,
    the best path without it.
    """
    _improve_from(model, state, likely, np.int64(0), length, concerned, forbidden)


@njit(nogil=True, cache=True)
def _improve_from(model, state, likely, first, length, concerned, forbidden):  # type: ignore[no-untyped-def]
    """As `_improve_blocks`, but what comes before `first` stays as it is."""
    count = model.starts.shape[0]
    while first < count:
        end = first + 1
        while end < count and end - first < length and not model.starts[end]:
            end += 1
        if concerned < 0 or (state.subgoal_of[first:end] == concerned).any():
            _best_block(model, state, likely, first, end, forbidden)
        first = end


@njit(nogil=True, cache=True)
def _best_block(model, state, likely, first, end, forbidden):  # type: ignore[no-untyped-def]
    """The Viterbi algorithm over observations `first` to `end` of one episode."""
    theta, parameters, counts = state.subgoal_of, state.parameters, state.counts
    goes_on = end < model.starts.shape[0] and not model.starts[end]
    if goes_on and theta[end] == forbidden and not state.switched[end]:
        state.switched[end] = True  # the next block gives it another subgoal
        counts[forbidden] += 1
    goes_on = goes_on and theta[end] != forbidden
    last = end + 1 if goes_on else end
    part = model.state_part[model.state_of[first]]
    # With the block's own draws: an estimate of the weights, where it is most of what there is.
    weights = urn_weights(model, parameters[ETA], counts, part)
    count_draws(counts, theta[first:last], state.switched[first:last], -1)
    if forbidden >= 0:
        weights[forbidden] = 0.0
    new_theta, new_switched = _viterbi(model, parameters, likely, weights, theta, first, end, last)
    gain = -np.inf
    if forbidden < 0:
        gain = _path_score(
            model, parameters, likely, weights, new_theta, new_switched, theta, first
        )
        gain += urn_ratio(model, parameters[ETA], counts, weights, new_theta, new_switched)
        old, switched = theta[first:last], state.switched[first:last]
        gain -= _path_score(model, parameters, likely, weights, old, switched, theta, first)
        gain -= urn_ratio(model, parameters[ETA], counts, weights, old, switched)
    if forbidden >= 0 or gain > _GAIN:
        theta[first:last] = new_theta
        state.switched[first:last] = new_switched
    count_draws(counts, theta[first:last], state.switched[first:last], 1)


@njit(nogil=True, cache=True)
def _infinite_log(probability):  # type: ignore[no-untyped-def]
    """A logarithm that rules out what is impossible."""
    return math.log(probability) if probability > 0.0 else -np.inf


@njit(nogil=True, cache=True)
def _viterbi(model, parameters, likely, weights, theta, first, end, last):  # type: ignore[no-untyped-def]
    """Subgoals and switches from `first` to `last`; `last` > `end` if the episode goes on.

    `likely` (K, G) has the logarithms of the likelihoods.
    """
    candidates = weights.shape[0]
    log_weights = np.empty(candidates)
    for candidate in range(candidates):
        log_weights[candidate] = _infinite_log(weights[candidate])
    best = np.full(candidates, -np.inf)
    if not model.starts[first]:
        best[theta[first - 1]] = 0.0
    came_by_switch = np.empty((last - first, candidates), dtype=np.bool_)
    came_from = np.empty(last - first, dtype=np.int64)
    leaving = np.empty(candidates)
    elsewhere = parameters[ELSEWHERE]
    for t in range(first, last):
        i = t - first
        if model.starts[t]:
            best[:] = log_weights
            came_by_switch[i] = True
        else:
            leaving[:] = best + _infinite_log(elsewhere)
            keeping = best + _infinite_log(1.0 - elsewhere)
            for candidate in near(model, t):
                rho = switch_probability(model.arrived, model.state_of, parameters, t, candidate)
                leaving[candidate] = best[candidate] + _infinite_log(rho)
                keeping[candidate] = best[candidate] + _infinite_log(1.0 - rho)
            came_from[i] = leaving.argmax()
            leave = leaving[came_from[i]]
            for candidate in range(candidates):
                switched = leave + log_weights[candidate]
                came_by_switch[i, candidate] = switched > keeping[candidate]
                best[candidate] = max(keeping[candidate], switched)
        if t < end:
            best += likely[model.pair_of[t]]
    new_theta = np.empty(last - first, dtype=np.int32)
    new_switched = np.empty(last - first, dtype=np.bool_)
    target = best.argmax() if last == end else theta[end]
    for i in range(last - first - 1, -1, -1):
        new_theta[i] = target
        new_switched[i] = came_by_switch[i, target]
        if new_switched[i] and i > 0:
            target = came_from[i]
    return new_theta, new_switched


@njit(nogil=True, cache=True)
def _path_score(model, parameters, likely, weights, path, switched, theta, first):  # type: ignore[no-untyped-def]
    """Log probability of a path from `first` on, its draws made from `weights`."""
    score = 0.0
    for i in range(path.shape[0]):
        t = first + i
        if not model.starts[t]:
            before = path[i - 1] if i > 0 else theta[first - 1]
            rho = switch_probability(model.arrived, model.state_of, parameters, t, before)
            score += floored_log(rho if switched[i] else 1.0 - rho)
        if switched[i]:
            score += math.log(weights[path[i]])
        score += likely[model.pair_of[t], path[i]]
    return score


@njit(nogil=True, cache=True)
def _move_subgoals(model, state, chosen):  # type: ignore[no-untyped-def]
    """All pursuits of a subgoal to the candidate that suits them best, if the joint gains."""
    candidates = state.counts.shape[0]
    group_of = np.full(candidates, -1, dtype=np.int32)
    groups = np.int64(0)
    for t in range(state.subgoal_of.shape[0]):
        if group_of[state.subgoal_of[t]] < 0:
            group_of[state.subgoal_of[t]] = groups
            groups += 1
        state.partition_of[t] = group_of[state.subgoal_of[t]]
    scores = group_scores(model, state, chosen, groups)
    value = log_joint_of(model, state, chosen)
    for old in range(candidates):
        if group_of[old] < 0:
            continue
        new = scores[group_of[old]].argmax()
        if new != old:
            subgoal_of = state.subgoal_of.copy()
            _replace(state, old, new)
            trial = log_joint_of(model, state, chosen)
            if trial > value + _GAIN:
                value = trial
            else:
                _restore(state, subgoal_of, state.switched)
