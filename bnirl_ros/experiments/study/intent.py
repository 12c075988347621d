"""How early and how surely is the next subgoal named, while a demonstrator is on its way to it?

What the next one is, is read off the recording, not off the model: the place that is reached next
of those that its author, or the players' interactions, tell to be the true ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.overcooked import (
    LAYOUTS,
    MOVES,
    read_interactions,
    read_overcooked,
)
from bnirl_ros.experiments.study import turtle
from bnirl_ros.experiments.study.intervals import ratio_interval
from bnirl_ros.experiments.study.kitchens import LEAST_SHARE, true_cells
from bnirl_ros.experiments.study.next_action import split_trials
from bnirl_ros.experiments.study.part import SEED, Part, settings_of
from bnirl_ros.experiments.study.report import Table, share
from bnirl_ros.experiments.study.scores import Cell
from bnirl_ros.experiments.turtle import WAYPOINTS
from bnirl_ros.inference.filtering import filtered, foreseen, middle_of_draws
from bnirl_ros.inference.intent import by_subgoal
from bnirl_ros.inference.posterior import infer, pursuit_model_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES

SURE = 0.5
"""More probable than this is more probable than not."""

MOMENTS = {
    "at the outset": 0.0,
    "after a quarter": 0.25,
    "half-way": 0.5,
    "after 3/4": 0.75,
    "a step before": 1.0,
}
"""When the belief is looked at: share of a leg's steps that were taken, rounded down; but one step
is always left."""

SHORTEST = 2
"""Steps of a leg at the least: in a shorter one there is nothing to foresee."""

_STAY = ACTION_NAMES.index("stay")


@dataclass(frozen=True)
class Leg:
    """The way from one true subgoal to the next.

    Attributes:
        first: its first observation, by the row in the demonstration.
        steps: how many observations there are before the one made at its end.
        goal: which of the true subgoals it ends at.
    """

    first: int
    steps: int
    goal: int


@dataclass(frozen=True, eq=False)
class Watched:
    """What was learnt from, what is watched, and where the true subgoals are.

    Attributes:
        learnt, held_out: the two parts of a recording.
        grid_map: their map.
        legs: of what is watched.
        places: for each true subgoal the cells that count as it.
        group: (L,) number of what is drawn again for an interval, of each leg.
        settings: to learn with.
    """

    learnt: Demonstration
    held_out: Demonstration
    grid_map: GridMap
    legs: list[Leg]
    places: list[set[Cell]]
    group: list[int]
    settings: Settings


def legs_between(demonstration: Demonstration, arrivals: Sequence[tuple[int, int]]) -> list[Leg]:
    """The legs that end with each of the arrivals, but for those that are too short.

    The first of an episode begins with it, and each other one with the first move after the
    arrival before: staying there is still being there.

    Args:
        demonstration: of several episodes.
        arrivals: row of the observation that is made at a true subgoal, and which it is, in order.
    """
    legs, left = [], 0
    for row, goal in arrivals:
        begins = int(np.searchsorted(demonstration.episode, demonstration.episode[row]))
        first = max(begins, left)
        if row - first >= SHORTEST:
            legs.append(Leg(first, row - first, goal))
        left = row + int(demonstration.action[row] == _STAY)
    return legs


def of_kitchen(recordings: Path, layout: str) -> Watched:
    """Every second trial; who stays in a true cell, interacting, has arrived there."""
    demonstration, grid_map = read_overcooked(recordings, layout)
    learnt, held_out = split_trials(demonstration)
    truth = sorted(true_cells(read_interactions(recordings, layout)))
    number_of = {cell: number for number, cell in enumerate(truth)}
    stays = np.flatnonzero(held_out.action == _STAY)
    cells = [(int(x), int(y)) for x, y in held_out.cells[stays]]
    arrivals = [
        (int(row), number_of[cell])
        for row, cell in zip(stays, cells, strict=True)
        if cell in number_of
    ]
    legs = legs_between(held_out, arrivals)
    trials = [int(held_out.episode[leg.first]) // 2 for leg in legs]
    settings = settings_of("sequential", moves=MOVES)
    return Watched(learnt, held_out, grid_map, legs, [{cell} for cell in truth], trials, settings)


def of_turtle(recordings: Path, first_lap_only: bool) -> Watched:
    """What follows the first lap of the drive, or all of it; near a waypoint it has arrived.

    Args:
        recordings: not needed; the bag comes with the package.
        first_lap_only: whether only the first lap is learnt from, and the rest watched, rather
            than all of it learnt from and watched.
    """
    whole, grid_map = turtle.drive()
    arrivals = waypoint_arrivals(grid_map.centres_of(whole.cells))
    lap = arrivals[len(WAYPOINTS)][0] if first_lap_only else 0
    held_out = _rows(whole, slice(lap, None))
    legs = legs_between(held_out, [(row - lap, goal) for row, goal in arrivals if row >= lap])
    near = np.linalg.norm(grid_map.centres_of(_all_cells(grid_map))[:, None] - WAYPOINTS, axis=2)
    places = [
        {(int(x), int(y)) for x, y in _all_cells(grid_map)[apart <= turtle.REACH]}
        for apart in near.T
    ]
    return Watched(
        _rows(whole, slice(lap)) if first_lap_only else whole,
        held_out,
        grid_map,
        legs,
        places,
        list(range(len(legs))),
        settings_of("sequential"),
    )


def waypoint_arrivals(centres: npt.NDArray[np.float64]) -> list[tuple[int, int]]:
    """The first of the positions (N, 2) at each waypoint after those before, and which it is [m].

    In the author's order, round and round, as far as the positions go.
    """
    apart = np.linalg.norm(centres[:, None] - np.array(WAYPOINTS), axis=2)
    arrivals, row = [], 0
    for goal in cycle(range(len(WAYPOINTS))):
        reached = np.flatnonzero(apart[row:, goal] <= turtle.REACH)
        if not len(reached):
            return arrivals
        row += int(reached[0])
        arrivals.append((row, goal))
    raise AssertionError("a cycle has no end")


def _all_cells(grid_map: GridMap) -> npt.NDArray[np.int64]:
    return np.argwhere(grid_map.free)[:, ::-1]


def _rows(demonstration: Demonstration, part: slice) -> Demonstration:
    """Consecutive observations of a single episode, the first ones or the last."""
    count = len(demonstration)
    _, end, _ = part.indices(count)
    last = demonstration.last_cells if end == count else demonstration.cells[end : end + 1]
    return Demonstration(
        demonstration.episode[part],
        demonstration.cells[part],
        demonstration.action[part],
        demonstration.episode[: len(last)],
        last,
    )


SOURCES: dict[str, Callable[[Path], Watched]] = {
    "turtle, its own drive": partial(of_turtle, first_lap_only=False),
    "turtle, after one lap": partial(of_turtle, first_lap_only=True),
    **{f"`{layout}`": partial(of_kitchen, layout=layout) for layout in LAYOUTS},
}
"""What is watched, by the headings of the table."""


@dataclass(frozen=True)
class Case:
    """Something to watch, one of `SOURCES`."""

    recordings: Path
    source: str


@dataclass(frozen=True)
class Course:
    """How well a leg's goal is known on the way there.

    Attributes:
        group: what is drawn again together with it.
        right: after 0, 1, ... steps, one less than there are, the probability of the goal; of
            several subgoals that lie there, of the most probable one.
        wrong: then that of the most probable other subgoal.
    """

    group: int
    right: list[float]
    wrong: list[float]

    @property
    def named_after(self) -> int:
        """Steps after which the goal stays the most probable until it is reached; all if never."""
        return max(
            (step + 1 for step in range(len(self.right)) if not self.named(step)), default=0
        )

    def named(self, step: int) -> bool:
        """Whether the goal is the most probable subgoal after so many steps."""
        return self.right[step] > self.wrong[step]

    def step_at(self, moment: float) -> int:
        """How many steps were taken at one of the `MOMENTS`."""
        return min(int(moment * len(self.right)), len(self.right) - 1)


def courses_of(
    watched: Watched,
    cells: Sequence[Cell],
    before: npt.NDArray[np.float64],
    after: npt.NDArray[np.float64],
) -> list[Course]:
    """What is believed in each of the legs.

    Args:
        watched: N observations.
        cells: of the J subgoals that were learnt.
        before, after: (N, J) their probabilities before each action and after it.
    """
    courses = []
    for leg, group in zip(watched.legs, watched.group, strict=True):
        on_the_way = after[leg.first : leg.first + leg.steps - 1]
        belief = np.concatenate([before[leg.first : leg.first + 1], on_the_way])
        there = np.array([cell in watched.places[leg.goal] for cell in cells])
        right, wrong = (
            belief[:, chosen].max(axis=1, initial=0.0).tolist() for chosen in (there, ~there)
        )
        courses.append(Course(group, right, wrong))
    return courses


def run(case: Case) -> dict[str, Any]:
    """The courses of all legs of a source."""
    watched = SOURCES[case.source](case.recordings)
    posterior = infer(watched.learnt, watched.grid_map, watched.settings)
    weights, parameters = middle_of_draws(posterior)
    model = pursuit_model_of(
        watched.held_out, posterior.candidates, watched.grid_map, watched.settings
    )
    summary = summarise(posterior, watched.grid_map)
    before = by_subgoal(foreseen(model, weights, parameters), summary)
    after = by_subgoal(filtered(model, weights, parameters)[0], summary)
    cells = [subgoal.cell for subgoal in summary.subgoals]
    courses = courses_of(watched, cells, before, after)
    return {"source": case.source, "courses": [asdict(course) for course in courses]}


def _probability(course: Course, moment: float) -> float:
    return course.right[course.step_at(moment)]


def _named(course: Course, moment: float) -> float:
    return course.named(course.step_at(moment))


def _deceived(course: Course, moment: float) -> float:
    return course.wrong[course.step_at(moment)] > SURE


MEASURES: Mapping[str, Callable[[Course], float]] = {
    f"{words} {name} [%]": partial(measure, moment=moment)
    for words, measure in (
        ("its probability", _probability),
        ("it is the most probable one", _named),
        ("another one is more probable than not", _deceived),
    )
    for name, moment in MOMENTS.items()
} | {
    "way made when it is the most probable one for good [%]": lambda course: (
        course.named_after / len(course.right)
    ),
    "steps from then to the arrival": lambda course: len(course.right) - course.named_after,
}
"""The rows of the table, each the mean over legs of a number of one; shares in per cent."""


def mean(courses: Sequence[Course], measure: Callable[[Course], float]) -> tuple[float, Any]:
    """The mean of a measure over legs, and its 95 % interval, groups being what is drawn again."""
    values = np.array([float(measure(course)) for course in courses])
    _, number = np.unique([course.group for course in courses], return_inverse=True)
    generator = np.random.default_rng(SEED)
    interval = ratio_interval(np.bincount(number, values), np.bincount(number), generator)
    return float(values.mean()), interval


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each measure, a column for each source."""
    of_source = {
        result["source"]: [Course(**course) for course in result["courses"]] for result in results
    }
    rows = [
        ("legs", *(f"{len(courses):,}" for courses in of_source.values())),
        (
            "steps of one",
            *(
                f"{np.mean([len(course.right) for course in courses]):.1f}"
                for courses in of_source.values()
            ),
        ),
    ]
    for name, measure in MEASURES.items():
        cells = []
        for courses in of_source.values():
            value, (low, high) = mean(courses, measure)
            in_percent = name.endswith("[%]")
            cells.append(
                share(value, (low, high)) if in_percent else f"{value:.1f} ({low:.1f}-{high:.1f})"
            )
        rows.append((name, *cells))
    return Table(
        title="The subgoal that is gone for now",
        text="How early and how surely the filter tells which of the true subgoals is reached "
        "next, by the sequential model; means over legs, the ways from one to the next, with "
        "95 % intervals (bootstrap over trials, of the turtle over legs). Of the turtle the "
        f"waypoints are true, reached within {turtle.REACH} m; of the kitchens those cells with "
        f"at least {LEAST_SHARE:.0%} of the interactions that had an effect, reached where "
        f"somebody interacts there. Legs of less than {SHORTEST} steps are left out. Kitchens are "
        "learnt from every second trial, and the others are watched; the turtle's drive is "
        "watched after it was learnt from itself, and what follows its first lap after that lap "
        "alone. The most probable one is what `current_subgoal` tells. For good: until it is "
        "reached; a leg in which it never is counts as one whose whole way was made.",
        header=("the next subgoal", *of_source),
        rows=tuple(rows),
    )


def cases(recordings: Path) -> Sequence[Case]:
    """Every source.

    Raises:
        InputError: the recordings are missing.
    """
    for layout in LAYOUTS:
        read_interactions(recordings, layout)
    return [Case(recordings, source) for source in SOURCES]


PART = Part(name="intent", cases=cases, run=run, table=table)
