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


class PlainSampler:
    """Algorithm 2 in plain Python, drawing the same random numbers as the kernel.

    With `printed_sum`, subgoals are drawn from (17) as the paper prints it: with the sum over the
    observations of a partition where the joint (10) has a product. With `redraw`, partitions are
    drawn anew at the end of a sweep, given the subgoals.
    """

    def __init__(
        self,
        mixture: SubgoalMixture,
        generator: np.random.Generator,
        printed_sum: bool = False,
        redraw: bool = False,
    ) -> None:
        self.generator = generator
        self.printed_sum = printed_sum
        self.redraw = redraw
        self.members: list[list[int]] = [list(range(len(mixture.pair_of)))]
        self.subgoals = [
            int(generator.choice(len(mixture.log_prior), p=np.exp(mixture.log_prior)))
        ]

    def sweep(self, mixture: SubgoalMixture) -> None:
        log_likelihood = mixture.log_likelihood[mixture.pair_of]
        likelihood = np.exp(log_likelihood)
        prior = np.exp(mixture.log_prior)
        for table, members in enumerate(self.members):
            if self.printed_sum:
                weights = prior * likelihood[members].sum(axis=0)
            else:
                scores = mixture.log_prior + log_likelihood[members].sum(axis=0)
                weights = np.exp(scores - scores.max())
            self.subgoals[table] = self._categorical(weights)
        for i in range(len(likelihood)):
            self._take_out(i)
            weights = np.array(
                [
                    len(members) * likelihood[i, subgoal]
                    for members, subgoal in zip(self.members, self.subgoals, strict=True)
                ]
                + [mixture.eta * (prior @ likelihood[i])]
            )
            table = self._categorical(weights)
            if table == len(self.members):
                self.members.append([])
                self.subgoals.append(self._categorical(prior * likelihood[i]))
            self.members[table].append(i)
        if self.redraw:
            self._redraw(mixture)

    def _redraw(self, mixture: SubgoalMixture) -> None:
        """Among observations with one subgoal, a CRP with concentration eta P(g)."""
        count = len(mixture.pair_of)
        subgoal_of = self.subgoal_of(count)
        self.members, self.subgoals = [], []
        for i in range(count):
            tables = [t for t, g in enumerate(self.subgoals) if g == subgoal_of[i]][::-1]
            weights = [len(self.members[table]) for table in tables]
            weights.append(mixture.eta * np.exp(mixture.log_prior[subgoal_of[i]]))
            choice = self._categorical(np.array(weights))
            if choice == len(tables):
                self.members.append([i])
                self.subgoals.append(int(subgoal_of[i]))
            else:
                self.members[tables[choice]].append(i)

    def _take_out(self, i: int) -> None:
        table = next(t for t, members in enumerate(self.members) if i in members)
        self.members[table].remove(i)
        if not self.members[table]:  # the last table takes the empty one's place
            self.members[table], self.subgoals[table] = self.members[-1], self.subgoals[-1]
            self.members.pop()
            self.subgoals.pop()

    def _categorical(self, weights: npt.NDArray[np.float64]) -> int:
        remaining = self.generator.random() * weights.sum()
        return int(np.searchsorted(np.cumsum(weights), remaining, side="right"))

    def partition_of(self, count: int) -> npt.NDArray[np.int64]:
        """(N,) table of each observation, numbered in the order of first observations."""
        labels = np.empty(count, dtype=np.int64)
        for label, table in enumerate(sorted(self.members, key=min)):
            labels[table] = label
        return labels

    def subgoal_of(self, count: int) -> npt.NDArray[np.int64]:
        """(N,) subgoal of each observation."""
        subgoals = np.empty(count, dtype=np.int64)
        for members, subgoal in zip(self.members, self.subgoals, strict=True):
            subgoals[members] = subgoal
        return subgoals
