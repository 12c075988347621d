"""Scenarios of the paper's section 4: a world, a simulated demonstrator, and where it goes.

Each scenario is defined here and nowhere else; its bag, its figures and its tests come from this
one definition. Section 4.1 belongs here as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.maps import GridMap, parse_text_grid
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld

TIE = 1e-9
"""Actions whose values Q* differ by no more than this are equally good."""

_VALUE_TOLERANCE = 1e-10  # well below TIE: ties that symmetry makes have to be recognised

Cell = tuple[int, int]


@dataclass(frozen=True)
class Scenario:
    """A world and a demonstrator in it that goes from subgoal to subgoal.

    Attributes:
        name: of its bag, too.
        section: of the paper.
        grid: the map as text, one row of `#` and `.` a line, the last line y = 0; cells of 1 m.
        start: the cell (x, y), from 0, in which every episode begins.
        subgoals: cells (x, y), from 0, in the order in which they are pursued.
        episodes: number of demonstrations.
        success: probability that the chosen action happens.
        discount: gamma.
        moves: 8 or 4.
        seed: of the generator of the demonstrations that are shipped and shown.
    """

    name: str
    section: str
    grid: str
    start: Cell
    subgoals: tuple[Cell, ...]
    episodes: int
    success: float
    discount: float
    moves: int
    seed: int

    @property
    def grid_map(self) -> GridMap:
        """The map, in the frame `map`, its lower left corner at (0, 0)."""
        return parse_text_grid(self.grid.strip(), f"scenario {self.name}")

    @property
    def world(self) -> GridWorld:
        """The grid world in which the demonstrator plans and moves."""
        return GridWorld(self.grid_map.free, self.moves, self.success, self.discount)


def paper_cell(x: int, y: int) -> Cell:
    """Our cell, counted from 0, of one that the paper counts from 1."""
    return x - 1, y - 1


PAPER_LOOP = Scenario(
    name="paper_loop",
    section="4.3",
    # The paper prints the size but not its walls: these are our choice. The one in the middle is
    # off the ways; the others stand behind subgoals, which makes those identifiable: without them
    # a cell behind a subgoal is now and then as good an explanation (see `identifiability`).
    grid="""
....................
....................
........###.........
....................
....................
....................
....................
....................
.........#..........
.........#..........
#.......####.......#
#........#.........#
#........#.........#
....................
....................
....................
....................
....................
....................
....................
""",
    start=paper_cell(10, 1),
    subgoals=(paper_cell(19, 9), paper_cell(10, 17), paper_cell(2, 9), paper_cell(10, 1)),
    episodes=5,
    success=0.7,
    discount=0.99,
    moves=8,
    seed=0,
)
"""Section 4.3, the grid world with a loop."""

SCENARIOS = {scenario.name: scenario for scenario in (PAPER_LOOP,)}
"""All scenarios by name."""


def shipped_demonstration(scenario: Scenario) -> Demonstration:
    """The demonstration of a scenario that is shipped as its bag: the one of its own seed."""
    return demonstrate(scenario, np.random.default_rng(scenario.seed))


def demonstrate(scenario: Scenario, generator: np.random.Generator) -> Demonstration:
    """What the demonstrator of a scenario does.

    It takes an optimal action for its current subgoal and chooses the next one when it arrives,
    however it got there; the noise may carry it there as well. An episode ends on arrival at the
    last subgoal, where the last pose is recorded and no action is taken.
    """
    world = scenario.world
    subgoals = world.states_of(scenario.subgoals)
    values = goal_values(world, subgoals, np.arange(world.state_count), _VALUE_TOLERANCE)
    outcomes = world.outcomes()
    states: list[int] = []
    choices: list[int] = []
    episode: list[int] = []
    for number in range(scenario.episodes):
        state = int(world.states_of(scenario.start)[0])
        for values_of_subgoal, subgoal in zip(values.transpose(2, 0, 1), subgoals, strict=True):
            while state != subgoal:
                choice = _one_of(optimal_actions(values_of_subgoal[state]), generator)
                episode.append(number)
                states.append(state)
                choices.append(choice)
                state = int(outcomes[state, outcome_of(choice, world, generator)])
    return Demonstration(
        episode=np.array(episode, dtype=np.int64),
        cells=world.cells_of(states),
        action=world.actions[choices],
        last_episode=np.arange(scenario.episodes),
        last_cells=world.cells_of(np.full(scenario.episodes, subgoals[-1])),
    )


def optimal_actions(values: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Positions of the best of the values Q* (A,), all that are within `TIE` of it."""
    return np.flatnonzero(values >= values.max() - TIE)


def _one_of(actions: npt.NDArray[np.int64], generator: np.random.Generator) -> int:
    # numpy keeps the stream of random() across versions; that of choice() it may change.
    return int(actions[int(generator.random() * len(actions))])


def outcome_of(choice: int, world: GridWorld, generator: np.random.Generator) -> int:
    """Position of the action that happens when the one at the position `choice` is taken."""
    if generator.random() < world.success:
        return choice
    others = np.delete(np.arange(len(world.actions)), choice)
    return _one_of(others, generator)
