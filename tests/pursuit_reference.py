"""The sequential model in plain numpy: every history of a small case, and the model's own story.

Nothing here is shared with the kernels. Probabilities are multiplied as the model tells them, one
observation after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bnirl_ros.model.pursuits import PRIORS, PursuitModel

Parameters = npt.NDArray[np.float64]


def switch_probability(model: PursuitModel, parameters: Parameters, t: int, subgoal: int) -> float:
    """Rho before observation t, where `subgoal` was pursued until then; 1 at a start."""
    value = dict(zip(PRIORS, parameters, strict=True))
    if model.starts[t]:
        return 1.0
    if not model.arrived[model.state_of[t], subgoal]:
        return float(value["switch_elsewhere"])
    if model.arrived[model.state_of[t - 1], subgoal]:
        return float(value["switch_at_subgoal"])
    return float(value["switch_on_arrival"])


def explained_probability(
    model: PursuitModel, parameters: Parameters, state: int, subgoal: int
) -> npt.NDArray[np.float64]:
    """(A,) softmax over the actions that differ; 0 for those that do the same as another."""
    weights = np.array([np.exp(-parameters[0] * cost) for cost in model.cost[state, :, subgoal]])
    return np.asarray(weights / weights.sum())


def uniform_probability(model: PursuitModel, state: int) -> npt.NDArray[np.float64]:
    """(A,) the same of a slip: uniform over the actions that differ."""
    differs = np.isfinite(model.cost[state, :, 0])
    return np.asarray(differs / differs.sum())


def likelihood_of(model: PursuitModel, parameters: Parameters, t: int) -> npt.NDArray[np.float64]:
    """(G,) P(a_t | s_t, g), slips summed over."""
    state, action, slip = model.state_of[t], model.action_of[t], parameters[2]
    return np.array(
        [
            (1.0 - slip) * explained_probability(model, parameters, state, g)[action]
            + slip * uniform_probability(model, state)[action]
            for g in range(len(model.candidate_part))
        ]
    )


def urn_probability(
    model: PursuitModel, parameters: Parameters, drawn: list[int], subgoal: int
) -> float:
    """Probability that the urn of the subgoal's part gives it, after the draws from all urns."""
    part = model.candidate_part
    share = 1.0 / np.count_nonzero(part == part[subgoal])
    eta = parameters[1]
    before = sum(1 for other in drawn if part[other] == part[subgoal])
    return float((eta * share + drawn.count(subgoal)) / (eta + before))


def histories(model: PursuitModel) -> Iterator[tuple[tuple[int, ...], tuple[bool, ...]]]:
    """Every sequence of subgoals and of switches that goes with it."""
    choices = [
        np.flatnonzero(model.candidate_part == model.state_part[state]).tolist()
        for state in model.state_of
    ]
    for subgoals in product(*choices):
        free = [
            (True,) if model.starts[t] or subgoals[t] != subgoals[t - 1] else (False, True)
            for t in range(len(subgoals))
        ]
        for switched in product(*free):
            yield subgoals, switched


def history_probability(
    model: PursuitModel,
    parameters: Parameters,
    subgoals: tuple[int, ...],
    switched: tuple[bool, ...],
) -> float:
    """P(subgoals, switches | parameters), draw by draw from the urn; no actions yet."""
    probability, drawn = 1.0, []
    for t, subgoal in enumerate(subgoals):
        rho = switch_probability(model, parameters, t, subgoals[t - 1])
        probability *= rho if switched[t] else 1.0 - rho
        if switched[t]:
            probability *= urn_probability(model, parameters, drawn, subgoal)
            drawn.append(subgoal)
    return probability


def largest_joint(model: PursuitModel, parameters: Parameters) -> float:
    """Largest log P(subgoals, switches, actions | parameters), slips summed over."""
    likelihood = np.array(
        [likelihood_of(model, parameters, t) for t in range(len(model.state_of))]
    )
    return float(
        np.log(
            max(
                history_probability(model, parameters, subgoals, switched)
                * np.prod(likelihood[np.arange(len(subgoals)), list(subgoals)])
                for subgoals, switched in histories(model)
            )
        )
    )


def table_counts(customers: int, concentration: float) -> npt.NDArray[np.float64]:
    """(customers + 1,) distribution of the number of tables of a Chinese restaurant process."""
    distribution = np.zeros(customers + 1)
    distribution[0] = 1.0
    for seated in range(customers):
        new = concentration / (seated + concentration)
        distribution[1:] = (1.0 - new) * distribution[1:] + new * distribution[:-1]
        distribution[0] *= 1.0 - new
    return distribution


def run_count(subgoal_of: list[int], starts: list[bool]) -> int:
    """Number of maximal runs of one subgoal within an episode, slips (-1) left out."""
    runs, before = 0, None
    for subgoal, begins in zip(subgoal_of, starts, strict=True):
        if begins:
            before = None
        if subgoal >= 0:
            runs += subgoal != before
            before = subgoal
    return runs


class PursuitEnumeration:
    """The exact posterior of a small case with known parameters: every history and every slip.

    Attributes:
        subgoal_of: (N, G + 1) distribution of each observation's subgoal; the last one: a slip.
        pursued: (N, G) the same of the subgoal that is pursued, through slips too.
        run_count: (N + 1,) distribution of the number of pursuits, as `runs` counts them.
        subgoal_probability: (G,) probability that a candidate explains some observation.
        co_assignment: (N, N) probability that two observations are explained by one partition.
        partition_count: (N + 1,) distribution of the number of partitions that explain something.
        switched: (N,) probability of a switch at each observation.
        log_evidence: log P(actions | parameters).
    """

    def __init__(self, model: PursuitModel, parameters: Parameters) -> None:
        count, candidates = len(model.state_of), len(model.candidate_part)
        everyone = np.arange(count)
        concentration = np.array(
            [
                parameters[1] / np.count_nonzero(model.candidate_part == part)
                for part in model.candidate_part
            ]
        )
        explained, unexplained = np.empty((count, candidates)), np.empty(count)
        for t, (state, action) in enumerate(zip(model.state_of, model.action_of, strict=True)):
            unexplained[t] = parameters[2] * uniform_probability(model, state)[action]
            for g in range(candidates):
                softmax = explained_probability(model, parameters, state, g)
                explained[t, g] = (1.0 - parameters[2]) * softmax[action]
        slips = np.array(list(product([False, True], repeat=count)))
        self.subgoal_of = np.zeros((count, candidates + 1))
        self.pursued = np.zeros((count, candidates))
        self.run_count = np.zeros(count + 1)
        self.subgoal_probability = np.zeros(candidates)
        self.co_assignment = np.zeros((count, count))
        self.partition_count = np.zeros(count + 1)
        self.switched = np.zeros(count)
        total = 0.0
        told: dict[tuple[int, ...], tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]] = {}
        of_sizes = np.zeros((count + 1) ** candidates)  # weight by how many draws of each subgoal
        for subgoals, switched in histories(model):
            theta = np.array(subgoals)
            likely = explained[everyone, theta]
            weight = history_probability(model, parameters, subgoals, switched)
            weight *= np.prod(likely + unexplained)
            if weight == 0.0:
                continue
            total += weight
            self.switched += weight * np.array(switched)
            self.pursued[everyone, theta] += weight
            share = likely / (likely + unexplained)  # slips are independent, given the history
            joint = weight * np.where(slips, 1.0 - share, share).prod(axis=1)
            if subgoals not in told:
                shown = np.where(slips, -1, theta)
                runs = [run_count(row, model.starts.tolist()) for row in shown.tolist()]
                told[subgoals] = shown, np.array(runs)
            shown, runs_of = told[subgoals]
            self.run_count += np.bincount(runs_of, weights=joint, minlength=count + 1)
            for g in range(candidates):
                here = shown == g
                self.subgoal_of[:, g] += joint @ here
                self.subgoal_probability[g] += joint @ here.any(axis=1)
            self.subgoal_of[:, -1] += joint @ slips
            # Two draws of one subgoal: in one partition with probability 1 / (1 + eta P(g)).
            draw_of = np.cumsum(switched) - 1
            one_draw = draw_of[:, None] == draw_of
            together = np.where(one_draw, 1.0, 1.0 / (1.0 + concentration[theta]))
            together *= theta[:, None] == theta
            self.co_assignment += together * ((~slips).T @ (joint[:, None] * ~slips))
            # Draws that explain nothing are not told: those left are seated as if alone.
            sizes = np.zeros(len(slips), dtype=np.int64)
            for draw in range(draw_of[-1] + 1):
                seen = (~slips[:, draw_of == draw]).any(axis=1)
                sizes += seen * (count + 1) ** theta[draw_of == draw][0]
            of_sizes += np.bincount(sizes, weights=joint, minlength=len(of_sizes))
        for number in np.flatnonzero(of_sizes):
            distribution = np.ones(1)
            for g in range(candidates):
                size = number // (count + 1) ** g % (count + 1)
                distribution = np.convolve(distribution, table_counts(size, concentration[g]))
            self.partition_count[: len(distribution)] += of_sizes[number] * distribution
        self.subgoal_of /= total
        self.pursued /= total
        self.run_count /= total
        self.subgoal_probability /= total
        self.co_assignment /= total
        self.partition_count /= total
        self.switched /= total
        self.log_evidence = float(np.log(total))


class Story(NamedTuple):
    """What the model tells of a demonstration, drawn from its prior.

    Attributes:
        subgoal_of: (N,) subgoal that is pursued at each observation.
        switched: (N,) bool whether it is a draw of its own.
        partition_of: (N,) partition of that draw, numbered from 0.
        slipped: (N,) bool whether the action is a slip.
    """

    subgoal_of: npt.NDArray[np.int64]
    switched: npt.NDArray[np.bool_]
    partition_of: npt.NDArray[np.int64]
    slipped: npt.NDArray[np.bool_]


def parameters_drawn(model: PursuitModel, generator: np.random.Generator) -> Parameters:
    """The parameters from their priors, or their fixed values."""
    return np.array(
        [
            model.fixed[name] if name in model.fixed else model.priors[name].draw(generator)
            for name in PRIORS
        ]
    )


def story_drawn(
    model: PursuitModel, parameters: Parameters, generator: np.random.Generator
) -> Story:
    """Switches by rho, subgoals from a Chinese restaurant process in each part, then slips."""
    count = len(model.state_of)
    subgoal_of = np.zeros(count, dtype=np.int64)
    switched = np.zeros(count, dtype=np.bool_)
    partition_of = np.zeros(count, dtype=np.int64)
    subgoals: list[int] = []  # of each partition
    sizes: list[int] = []
    for t, state in enumerate(model.state_of):
        rho = switch_probability(model, parameters, t, subgoal_of[t - 1])
        switched[t] = generator.random() < rho
        if not switched[t]:
            subgoal_of[t], partition_of[t] = subgoal_of[t - 1], partition_of[t - 1]
            continue
        part = model.state_part[state]
        weights = np.array(
            [
                size * (model.candidate_part[g] == part)
                for size, g in zip(sizes, subgoals, strict=True)
            ]
            + [parameters[1]]
        )
        partition = int(generator.choice(len(weights), p=weights / weights.sum()))
        if partition == len(sizes):
            sizes.append(0)
            subgoals.append(int(generator.choice(np.flatnonzero(model.candidate_part == part))))
        sizes[partition] += 1
        subgoal_of[t], partition_of[t] = subgoals[partition], partition
    return Story(subgoal_of, switched, partition_of, generator.random(count) < parameters[2])


def actions_drawn(
    model: PursuitModel,
    parameters: Parameters,
    subgoal_of: npt.NDArray[np.integer],
    slipped: npt.NDArray[np.bool_],
    generator: np.random.Generator,
) -> npt.NDArray[np.int64]:
    """(N,) actions, each uniform if it is a slip, and else from the softmax."""
    costs = model.cost[model.state_of, :, subgoal_of]
    weights = np.exp(-parameters[0] * costs)
    weights[slipped] = np.isfinite(costs[slipped])
    cumulative = np.cumsum(weights, axis=1)
    aim = generator.random(len(costs)) * cumulative[:, -1]
    return (aim[:, None] >= cumulative).sum(axis=1)
