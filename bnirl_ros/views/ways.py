"""The ways from subgoal to subgoal, each of them once, numbered in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from bnirl_ros.inference.summary import Subgoal, Summary
from bnirl_ros.views.pursuits import pursuits_by_episode

MOST_NUMBERED = 12
"""Pursuits of an episode that are numbered: more could not be followed."""

MOST_WAYS = 24
"""Ways that are told: more would hide each other."""

_Pair = tuple[int, int]  # The ranks that a way leads from and to.


@dataclass(frozen=True)
class Way:
    """The way from one subgoal to another.

    Attributes:
        here, there: the subgoals.
        times: how often it was gone.
        numbers: the 1-based places in the order to which it leads; none where it was gone only
            outside of what is numbered.
    """

    here: Subgoal
    there: Subgoal
    times: int
    numbers: tuple[int, ...]


@dataclass(frozen=True)
class Route:
    """The ways through the subgoals.

    Attributes:
        ways: numbered ones first, in order, then others, the most frequent ones first.
        order: what it is that the numbers count, in words.
    """

    ways: tuple[Way, ...]
    order: str

    @property
    def most(self) -> int:
        """How often the most frequent way was gone, at least 1."""
        return max((way.times for way in self.ways), default=1)

    @property
    def wide(self) -> bool:
        """Whether some ways were gone more often than others."""
        return any(way.times < self.most for way in self.ways)


def route_of(summary: Summary) -> Route:
    """The ways from each subgoal to the one pursued next, or visited next if no model knows more.

    Pursuits are counted over all episodes, and numbered in one of those that are most alike. Where
    they go round, the numbers are those of the visits.
    """
    if summary.pursuits:
        times, numbers, order = _pursued(summary)
    else:
        numbers = _numbered(summary.visit_sequence)
        times, order = Counter(numbers.keys()), "order in which they were first visited"
    others = [pair for pair, _ in times.most_common() if pair not in numbers]
    pairs = [*numbers, *others[: max(MOST_WAYS - len(numbers), 0)]]
    of_rank = {subgoal.rank: subgoal for subgoal in summary.subgoals}
    ways = [
        Way(of_rank[here], of_rank[there], times[here, there], numbers.get((here, there), ()))
        for here, there in pairs
        if here != there
    ]
    return Route(tuple(ways), order)


def _pursued(summary: Summary) -> tuple[Counter[_Pair], dict[_Pair, tuple[int, ...]], str]:
    """How often each way was gone, its numbers if it has any, and what these count."""
    sequences = {
        episode: tuple(pursuit.rank for pursuit in pursuits)
        for episode, pursuits in pursuits_by_episode(summary).items()
    }
    times = Counter(pair for ranks in sequences.values() for pair in pairwise(ranks))
    if summary.repetitions > 1:
        first, last = summary.visit_sequence[0], summary.visit_sequence[-1]
        numbers = {**_numbered(summary.visit_sequence), (last, first): (1,)}
        return times, numbers, f"order of the pursuits, {summary.repetitions} times round"
    alike = Counter(sequences.values())
    shown = max(sequences, key=lambda each: (len(sequences[each]) > 1, alike[sequences[each]]))
    ranks = sequences[shown]
    cut = f"first {MOST_NUMBERED} " if len(ranks) > MOST_NUMBERED else ""
    where = f" in episode {shown}" if len(sequences) > 1 else ""
    return times, _numbered(ranks[:MOST_NUMBERED]), f"order of the {cut}pursuits{where}"


def _numbered(ranks: Sequence[int]) -> dict[_Pair, tuple[int, ...]]:
    """The ways along a sequence of ranks, each with the 1-based places to which it leads."""
    numbers: dict[_Pair, tuple[int, ...]] = {}
    for number, pair in enumerate(pairwise(ranks), start=2):
        numbers[pair] = (*numbers.get(pair, ()), number)
    return numbers
