"""Simulated demonstrators whose true subgoals are known, on random maps, and their bad habits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.scenarios import outcome_of
from bnirl_ros.experiments.study.scores import Cell, apart
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.likelihood import action_log_likelihood

SIZE = 15
"""Edge of a random map [cells]."""

SUBGOALS = 4
"""True subgoals of a demonstrator."""

LEAST_APART = 4
"""What is at least between two of them, in moves on an open map."""

WEIGHTS = (0.4, 0.3, 0.2, 0.1)
"""How often a demonstrator goes for each of its subgoals, one never twice in a row."""

EPISODES = 3
"""Episodes of a demonstration."""

PURSUITS = 12
"""Pursuits in an episode."""

_WALLS = 9
_LEAST_FREE = 0.6
_UNTIL_ARRIVAL = np.inf


@dataclass(frozen=True)
class Demonstrator:
    """How somebody acts who goes from subgoal to subgoal; the defaults are without bad habits.

    Attributes:
        success: probability that the chosen action happens.
        discount: with which the demonstrator plans.
        confidence: of the softmax (7) by which it chooses its actions.
        noise: probability of an action by chance instead.
        detours: probability of a walk to a cell by chance before a pursuit.
        pauses: probability, in every step, of standing still for 3 to 6 steps first.
        changes_of_mind: probability that a pursuit is given up half-way.
        sloppiness: how far from its subgoal it may stop [cells, diagonals count as one].
    """

    success: float = 0.7
    discount: float = 0.99
    confidence: float = 50.0
    noise: float = 0.05
    detours: float = 0.0
    pauses: float = 0.0
    changes_of_mind: float = 0.0
    sloppiness: int = 0


@dataclass(frozen=True)
class Leg:
    """A part of the way.

    Attributes:
        subgoal: the true one that is pursued; None on a detour.
        target: the cell that is walked to.
        share: of the way there, after which it is given up; infinite to arrive.
    """

    subgoal: Cell | None
    target: Cell
    share: float = _UNTIL_ARRIVAL


def random_map(generator: np.random.Generator) -> GridMap:
    """A square with some straight walls, all of its free cells within reach of each other."""
    while True:
        free = np.ones((SIZE, SIZE), dtype=np.bool_)
        for _ in range(_WALLS):
            row, column = generator.integers(SIZE, size=2)
            length = generator.integers(3, 8)
            wall = free if generator.random() < 0.5 else free.T
            wall[row, column : column + length] = False
        rooms, _ = label(free)  # neighbours share an edge, so that no diagonal step is blocked
        room = rooms == int(np.argmax(np.bincount(rooms[free])))
        if room.mean() >= _LEAST_FREE:
            return GridMap(room)


def free_cells(grid_map: GridMap) -> list[Cell]:
    """The free cells of a map, by row and column."""
    return [(int(x), int(y)) for y, x in np.argwhere(grid_map.free)]


def random_subgoals(grid_map: GridMap, generator: np.random.Generator) -> list[Cell]:
    """`SUBGOALS` free cells, `LEAST_APART` from each other."""
    cells = free_cells(grid_map)
    while True:
        chosen: list[Cell] = []
        for index in generator.permutation(len(cells)):
            if all(apart(cells[index], other) >= LEAST_APART for other in chosen):
                chosen.append(cells[index])
            if len(chosen) == SUBGOALS:
                return chosen


def itinerary(
    demonstrator: Demonstrator,
    subgoals: list[Cell],
    grid_map: GridMap,
    generator: np.random.Generator,
) -> Iterator[Leg]:
    """The legs of an episode: `PURSUITS` of subgoals, and detours."""
    cells = free_cells(grid_map)
    weights = np.array(WEIGHTS)
    current = None
    for _ in range(PURSUITS):
        left = [index for index in range(len(subgoals)) if index != current]
        current = left[_one_by(weights[left], generator)]
        subgoal = subgoals[current]
        if generator.random() < demonstrator.detours:
            yield Leg(None, cells[generator.integers(len(cells))])
        near = [cell for cell in cells if apart(cell, subgoal) <= demonstrator.sloppiness]
        target = near[generator.integers(len(near))]
        given_up = generator.random() < demonstrator.changes_of_mind
        yield Leg(subgoal, target, 0.5 if given_up else _UNTIL_ARRIVAL)


def demonstrate(
    demonstrator: Demonstrator,
    grid_map: GridMap,
    generator: np.random.Generator,
    episodes: int = EPISODES,
) -> tuple[Demonstration, list[Cell]]:
    """Some episodes of a demonstrator, and the subgoals at which it arrived in them.

    An episode begins anywhere. What is recorded is the action that was chosen, whatever happened,
    and the last pose.
    """
    world = GridWorld(grid_map.free, success=demonstrator.success, discount=demonstrator.discount)
    subgoals = random_subgoals(grid_map, generator)
    goals = np.flatnonzero(world.free)
    values = goal_values(world, goals, np.arange(world.state_count))
    policies = np.exp(action_log_likelihood(values, demonstrator.confidence))
    policy_of = dict(zip(goals.tolist(), policies.transpose(2, 0, 1), strict=True))
    outcomes = world.outcomes()
    observed: list[tuple[int, int, int]] = []
    last_states = []
    arrived: set[Cell] = set()
    for episode in range(episodes):
        state = int(goals[generator.integers(len(goals))])
        for leg in itinerary(demonstrator, subgoals, grid_map, generator):
            target = int(world.states_of(leg.target)[0])
            steps_left = leg.share * apart(_cell(world, state), leg.target)
            while state != target and steps_left > 0:
                if generator.random() < demonstrator.pauses:
                    observed += [(episode, state, 0)] * int(generator.integers(3, 7))
                if generator.random() < demonstrator.noise:
                    choice = int(generator.integers(len(world.actions)))
                else:
                    choice = _one_by(policy_of[target][state], generator)
                observed.append((episode, state, choice))
                state = int(outcomes[state, outcome_of(choice, world, generator)])
                steps_left -= 1
            if leg.subgoal is not None and leg.share == _UNTIL_ARRIVAL:
                arrived.add(leg.subgoal)
        last_states.append(state)
    numbers, states, choices = np.array(observed, dtype=np.int64).T
    demonstration = Demonstration(
        episode=numbers,
        cells=world.cells_of(states),
        action=world.actions[choices],
        last_episode=np.arange(episodes),
        last_cells=world.cells_of(last_states),
    )
    return demonstration, sorted(arrived)


def _cell(world: GridWorld, state: int) -> Cell:
    x, y = world.cells_of(state)[0]
    return int(x), int(y)


def _one_by(weights: npt.NDArray[np.float64], generator: np.random.Generator) -> int:
    """An index with probability proportional to its weight."""
    # numpy keeps the stream of random() across versions; that of choice() it may change.
    bounds = np.cumsum(weights)
    return int(np.searchsorted(bounds, generator.random() * bounds[-1], side="right"))
