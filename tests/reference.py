"""Plain numpy forms of what the kernels do: slow, short, and close to the page."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from bnirl_ros.model.mixture import SubgoalMixture


def optimal_values(
    transitions: npt.NDArray[np.float64], reward: npt.NDArray[np.float64], discount: float
) -> npt.NDArray[np.float64]:
    """Q* (S, A) of a reward (S,) by value iteration on equation (2) until nothing changes."""
    values = np.zeros(len(reward))
    while True:
        action_values = reward[:, None] + discount * (transitions @ values).T
        if np.abs(action_values.max(axis=1) - values).max() < 1e-13:
            return action_values
        values = action_values.max(axis=1)


def grid_transitions(
    free: npt.NDArray[np.bool_], steps: list[tuple[int, int]], success: float
) -> npt.NDArray[np.float64]:
    """T (A, S, S) of a grid world, cell by cell from the contract's sentences."""
    height, width = free.shape

    def is_free(x: int, y: int) -> bool:
        return 0 <= x < width and 0 <= y < height and bool(free[y, x])

    def outcome(x: int, y: int, dx: int, dy: int) -> int:
        if not is_free(x, y) or not is_free(x + dx, y + dy):
            return y * width + x
        if dx and dy and not (is_free(x + dx, y) and is_free(x, y + dy)):
            return y * width + x
        return (y + dy) * width + x + dx

    transitions = np.zeros((len(steps), free.size, free.size))
    for y in range(height):
        for x in range(width):
            for action in range(len(steps)):
                for other, (dx, dy) in enumerate(steps):
                    share = success if other == action else (1.0 - success) / (len(steps) - 1)
                    transitions[action, y * width + x, outcome(x, y, dx, dy)] += share
    return transitions


def set_partitions(count: int) -> Iterator[tuple[int, ...]]:
    """Every partition of `count` things, each once, as labels in the order of appearance."""

    def extend(labels: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        if len(labels) == count:
            yield labels
            return
        for label in range(max(labels, default=-1) + 2):
            yield from extend((*labels, label))

    return extend(())


class Enumeration:
    """The exact posterior of a small mixture: every set partition and every subgoal.

    Attributes:
        co_assignment: (N, N) probability that two observations share a partition.
        partition_count: (N + 1,) distribution of the number of partitions.
        subgoal_probability: (G,) probability that some partition has the subgoal.
        subgoal_of: (N, G) distribution of each observation's subgoal.
    """

    def __init__(self, mixture: SubgoalMixture) -> None:
        log_likelihood = mixture.log_likelihood[mixture.pair_of]
        count, candidates = log_likelihood.shape
        prior = np.exp(mixture.log_prior)
        self.co_assignment = np.zeros((count, count))
        self.partition_count = np.zeros(count + 1)
        self.subgoal_probability = np.zeros(candidates)
        self.subgoal_of = np.zeros((count, candidates))
        total = 0.0
        for labels in map(np.array, set_partitions(count)):
            blocks = [np.flatnonzero(labels == label) for label in range(labels.max() + 1)]
            weight = 1.0
            has_subgoal = np.empty((len(blocks), candidates))
            for label, block in enumerate(blocks):
                # (5): eta (n - 1)! a block; (10): a product of likelihoods, summed over subgoals
                joint = prior * np.exp(log_likelihood[block].sum(axis=0))
                weight *= mixture.eta * np.prod(np.arange(1, len(block))) * joint.sum()
                has_subgoal[label] = joint / joint.sum()
            total += weight
            self.co_assignment += weight * (labels[:, None] == labels)
            self.partition_count[len(blocks)] += weight
            self.subgoal_probability += weight * (1.0 - np.prod(1.0 - has_subgoal, axis=0))
            self.subgoal_of += weight * has_subgoal[labels]
        for result in vars(self).values():
            result /= total
