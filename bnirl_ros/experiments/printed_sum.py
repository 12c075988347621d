"""What the sum that (16) and (17) print does, where the joint (10) has a product.

`python -m bnirl_ros.experiments.printed_sum` samples the loop of section 4.3 both ways, with
Algorithm 2 in plain Python, and tells in which share of the samples each true subgoal is among the
four with most observations.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.experiments.scenarios import PAPER_LOOP, demonstrate
from bnirl_ros.inference.posterior import model_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.model.mixture import SubgoalMixture


class PlainSampler:
    """Algorithm 2, to be read beside the page; it draws the same random numbers as the kernel.

    Attributes:
        members: the observations of each partition.
        subgoals: the candidate index of each partition's subgoal.
    """

    def __init__(
        self,
        mixture: SubgoalMixture,
        generator: np.random.Generator,
        printed_sum: bool = False,
        redraw: bool = False,
    ) -> None:
        """One partition with a subgoal from the prior: step 1 (b).

        Args:
            mixture: the model.
            generator: source of randomness.
            printed_sum: whether subgoals are drawn from (17) as it is printed, with the sum over
                the observations of a partition where the joint (10) has a product.
            redraw: whether partitions are drawn anew at the end of a sweep, given the subgoals.
        """
        self.generator = generator
        self.printed_sum = printed_sum
        self.redraw = redraw
        self.members: list[list[int]] = [list(range(len(mixture.pair_of)))]
        self.subgoals = [
            int(generator.choice(len(mixture.log_prior), p=np.exp(mixture.log_prior)))
        ]

    def sweep(self, mixture: SubgoalMixture) -> None:
        """Step 2: each subgoal (17), then each assignment (14)."""
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


@dataclass(frozen=True)
class Shares:
    """In how many of the samples what is found.

    Attributes:
        of_subgoal: for each of the J true subgoals, the share of samples in which it is among the
            J subgoals with most observations.
        partitions: mean number of partitions.
        subgoals: mean number of distinct subgoals.
    """

    of_subgoal: tuple[float, ...]
    partitions: float
    subgoals: float


def shares(seed: int, printed_sum: bool, sweeps: int = 100, burn_in: int = 50) -> Shares:
    """What Algorithm 2 finds in the loop of section 4.3, alpha 50 and eta 1.

    Args:
        seed: of the demonstration and of the sampler.
        printed_sum: whether with the printed sum.
        sweeps: in all.
        burn_in: first ones that are left out.
    """
    demonstration = demonstrate(PAPER_LOOP, np.random.default_rng(seed))
    candidates, model = model_of(demonstration, PAPER_LOOP.grid_map, Settings(model="paper"))
    assert isinstance(model, SubgoalMixture)
    sampler = PlainSampler(model, np.random.default_rng(seed), printed_sum)
    cells = [(int(x), int(y)) for x, y in candidates.coordinates]
    found, partitions, distinct = [], [], []
    for sweep in range(sweeps):
        sampler.sweep(model)
        if sweep >= burn_in:
            observations: Counter[tuple[int, int]] = Counter()
            for members, subgoal in zip(sampler.members, sampler.subgoals, strict=True):
                observations[cells[subgoal]] += len(members)
            largest = [cell for cell, _ in observations.most_common(len(PAPER_LOOP.subgoals))]
            found.append([true in largest for true in PAPER_LOOP.subgoals])
            partitions.append(len(sampler.subgoals))
            distinct.append(len(observations))
    of_subgoal = tuple(float(share) for share in np.mean(found, axis=0))
    return Shares(of_subgoal, float(np.mean(partitions)), float(np.mean(distinct)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each way, over several demonstrations."""
    parser = argparse.ArgumentParser(description=shares.__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="demonstrations (%(default)s)")
    options = parser.parse_args(arguments)
    header = "".join(f"  ({x + 1:2}, {y + 1:2})" for x, y in PAPER_LOOP.subgoals)
    print(f"{'among the four largest':24}{header}  partitions  distinct subgoals")
    for printed_sum in (False, True):
        runs = [shares(seed, printed_sum) for seed in range(options.seeds)]
        found = np.mean([run.of_subgoal for run in runs], axis=0)
        print(
            f"{'the printed sum' if printed_sum else 'the product':24}"
            + "".join(f"{100 * share:8.0f} %" for share in found)
            + f"{np.mean([run.partitions for run in runs]):12.1f}"
            + f"{np.mean([run.subgoals for run in runs]):19.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
