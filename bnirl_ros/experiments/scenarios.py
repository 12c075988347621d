"""Scenarios of the paper's section 4: a world, a simulated demonstrator, and where it goes.

Each scenario is defined here and nowhere else; its bag, its figures and its tests come from this
one definition. What the paper does not print is our choice, and said to be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.maps import GridMap, parse_text_grid
from bnirl_ros.maps.features import PlaceLayer
from bnirl_ros.maps.grid_map import FeatureMap
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.mdp.reward_values import action_values, optimal_values

TIE = 1e-9
"""Actions whose values Q* differ by no more than this are equally good."""

_VALUE_TOLERANCE = 1e-10  # well below TIE: ties that symmetry makes have to be recognised

Cell = tuple[int, int]


SPLITS = ("evenly", "stays", "beside")
"""What happens when the chosen action does not: any other action, each as often; the demonstrator
stays; or it goes to one side of the chosen direction (staying always succeeds).

The paper does not say. `evenly` is what the grid world of this package does."""

WEIGHTS = ("normal", "uniform", "attracting")
"""Distributions of a reward's weights: standard normal; uniform in [-1, 1]; uniform in [-1, 0], so
that every site attracts, the reward falling with the distance from it."""


@dataclass(frozen=True, kw_only=True)
class GridScenario:
    """A world, and where and how often demonstrations begin in it.

    Attributes:
        name: of the scenario, and of its bag.
        section: of the paper.
        grid: the map as text, one row of `#` and `.` a line, the last line y = 0; cells of 1 m.
        start: the cell (x, y), from 0, in which every episode begins.
        episodes: number of demonstrations.
        success: probability that the chosen action happens.
        split: what happens otherwise, one of `SPLITS`.
        discount: gamma.
        moves: 8 or 4.
        seed: of the generator of the demonstrations that are shipped and shown.
    """

    name: str
    section: str
    grid: str
    start: Cell
    episodes: int
    success: float = 0.7
    split: str = "evenly"
    discount: float = 0.99
    moves: int = 8
    seed: int = 0

    @property
    def grid_map(self) -> GridMap:
        """The map, in the frame `map`, its lower left corner at (0, 0)."""
        return parse_text_grid(self.grid.strip(), f"scenario {self.name}")

    @property
    def world(self) -> GridWorld:
        """The grid world of the map, in which noise is split evenly."""
        return GridWorld(self.grid_map.free, self.moves, self.success, self.discount)

    @property
    def process(self) -> GridWorld | FiniteMDP:
        """The MDP in which the demonstrator plans and moves, its states those of `world`."""
        world = self.world
        return world if self.split == "evenly" else _split_process(world, self.split)


@dataclass(frozen=True, kw_only=True)
class Scenario(GridScenario):
    """A demonstrator that goes from subgoal to subgoal (sections 4.1 and 4.3).

    Attributes:
        subgoals: cells (x, y), from 0, in the order in which they are pursued.
    """

    subgoals: tuple[Cell, ...]


@dataclass(frozen=True, kw_only=True)
class RewardScenario(GridScenario):
    """A demonstrator that follows one reward, linear in features (section 4.2).

    Attributes:
        actions: number of actions in each episode.
        features: number of features, each the Manhattan distance (21) from a site.
        sites: cells (x, y), from 0, of the features; none to draw different free cells.
        weights: distribution of the features' weights, one of `WEIGHTS`.
    """

    actions: int
    features: int
    sites: tuple[Cell, ...] = ()
    weights: str = "normal"


def paper_cell(x: int, y: int) -> Cell:
    """Our cell, counted from 0, of one that the paper counts from 1."""
    return x - 1, y - 1


def number_of(cell: Cell) -> Cell:
    """The paper's numbers of one of our cells."""
    return cell[0] + 1, cell[1] + 1


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
)
"""Section 4.3, the grid world with a loop."""

_GRID = """
....................
....................
....................
..........#######...
....................
....................
....................
....................
....#...............
....#...............
....#........#......
....#........#......
....#........#......
.............#......
.............#......
.............#......
.............#......
....................
....................
....................
"""

PAPER_GRID = Scenario(
    name="paper_grid",
    section="4.1",
    # The walls of 4.1 and 4.2 are our choice, too, off the ways between the subgoals. Those of
    # 4.3 would not do: the subgoal (10, 12) of the paper is one of their blocked cells.
    grid=_GRID,
    # So is the start, and that there is one demonstration: it makes about 50 observations, where
    # the axis of the loss in the paper's Figure 3 ends. Every subgoal is a turn for who starts
    # here; for how it is for others, see `identifiability`.
    start=paper_cell(2, 2),
    subgoals=(paper_cell(10, 12), paper_cell(2, 17), paper_cell(2, 2)),
    episodes=1,
)
"""Section 4.1, the grid world."""

PAPER_FEATURES = RewardScenario(
    name="paper_features",
    section="4.2",
    grid=_GRID,
    start=paper_cell(15, 1),
    episodes=5,
    actions=15,
    features=6,
)
"""Section 4.2, the grid world with features; their sites and weights are our choice."""

SCENARIOS = {scenario.name: scenario for scenario in (PAPER_GRID, PAPER_LOOP)}
"""All scenarios with subgoals by name."""


def shipped_demonstration(scenario: Scenario) -> Demonstration:
    """The demonstration of a scenario that is shipped as its bag: the one of its own seed."""
    return demonstrate(scenario, np.random.default_rng(scenario.seed))


def demonstrate(scenario: Scenario, generator: np.random.Generator) -> Demonstration:
    """What the demonstrator of a scenario does.

    It takes an optimal action for its current subgoal and chooses the next one when it arrives,
    however it got there; the noise may carry it there as well. An episode ends on arrival at the
    last subgoal, where the last pose is recorded and no action is taken.
    """
    world, process = scenario.world, scenario.process
    subgoals = world.states_of(scenario.subgoals)
    values = goal_values(process, subgoals, np.arange(world.state_count), _VALUE_TOLERANCE)
    outcomes = world.outcomes()
    seen: list[tuple[int, int, int]] = []
    for number in range(scenario.episodes):
        state = int(world.states_of(scenario.start)[0])
        for values_of_subgoal, subgoal in zip(values.transpose(2, 0, 1), subgoals, strict=True):
            while state != subgoal:
                choice = _one_of(optimal_actions(values_of_subgoal[state]), generator)
                seen.append((number, state, choice))
                happens = outcome_of(choice, world, generator, scenario.split)
                state = int(outcomes[state, happens])
    return _demonstration(world, seen, np.full(scenario.episodes, subgoals[-1]))


@dataclass(frozen=True, eq=False)
class LinearReward:
    """A reward R(s) = w^T phi(s) of the Manhattan distances (21) from k sites.

    Attributes:
        sites: (k, 2) int64 cells.
        weights: (k,) float64 w.
    """

    sites: npt.NDArray[np.int64]
    weights: npt.NDArray[np.float64]


def draw_reward(scenario: RewardScenario, generator: np.random.Generator) -> LinearReward:
    """A reward by chance, its sites and weights as the scenario has them."""
    if scenario.sites:
        sites = np.array(scenario.sites, dtype=np.int64)
    else:
        free = np.flatnonzero(scenario.world.free)
        # As below: numpy keeps the stream of random() across versions.
        drawn = np.argsort(generator.random(len(free)), kind="stable")[: scenario.features]
        sites = scenario.world.cells_of(free[drawn])
    if scenario.weights == "normal":
        weights = generator.standard_normal(len(sites))
    else:
        weights = -generator.random(len(sites))
        if scenario.weights == "uniform":
            weights = 1.0 + 2.0 * weights
    return LinearReward(sites, weights)


def distance_features(grid_map: GridMap, sites: npt.ArrayLike) -> FeatureMap:
    """Manhattan distance (21) of every cell of a map from each of the sites, cells (k, 2)."""
    positions = grid_map.centres_of(sites)
    names = tuple(f"site {number}" for number in range(1, len(positions) + 1))
    return PlaceLayer(names, positions).features_of(grid_map)


def follow_reward(
    scenario: RewardScenario, reward: LinearReward, generator: np.random.Generator
) -> Demonstration:
    """What the demonstrator of section 4.2 does: so many optimal actions, then the last pose."""
    world, process = scenario.world, scenario.process
    features = distance_features(scenario.grid_map, reward.sites).coordinates
    rewards = features.reshape(world.state_count, -1) @ reward.weights[:, None]
    values = optimal_values(process, rewards, _VALUE_TOLERANCE)
    choices = action_values(process, rewards, values, np.arange(world.state_count))[:, :, 0]
    outcomes = world.outcomes()
    seen: list[tuple[int, int, int]] = []
    last_states = []
    for number in range(scenario.episodes):
        state = int(world.states_of(scenario.start)[0])
        for _ in range(scenario.actions):
            choice = _one_of(optimal_actions(choices[state]), generator)
            seen.append((number, state, choice))
            happens = outcome_of(choice, world, generator, scenario.split)
            state = int(outcomes[state, happens])
        last_states.append(state)
    return _demonstration(world, seen, np.array(last_states))


def _demonstration(
    world: GridWorld, seen: list[tuple[int, int, int]], last_states: npt.NDArray[np.int64]
) -> Demonstration:
    """From episode, state and position of the action of each observation, and last poses."""
    episode, states, choices = np.array(seen, dtype=np.int64).reshape(-1, 3).T
    return Demonstration(
        episode=episode,
        cells=world.cells_of(states),
        action=world.actions[choices],
        last_episode=np.arange(len(last_states)),
        last_cells=world.cells_of(last_states),
    )


def optimal_actions(values: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Positions of the best of the values Q* (A,), all that are within `TIE` of it."""
    return np.flatnonzero(values >= values.max() - TIE)


def _one_of(actions: npt.NDArray[np.int64], generator: np.random.Generator) -> int:
    # numpy keeps the stream of random() across versions; that of choice() it may change.
    return int(actions[int(generator.random() * len(actions))])


def outcome_of(
    choice: int, world: GridWorld, generator: np.random.Generator, split: str = "evenly"
) -> int:
    """Position of the action that happens when the one at the position `choice` is taken."""
    if generator.random() < world.success:
        return choice
    return _one_of(_others(choice, len(world.actions), split), generator)


def _others(choice: int, actions: int, split: str) -> npt.NDArray[np.int64]:
    """Positions of the actions that happen, each as often, where the chosen one does not."""
    if split == "evenly":
        return np.delete(np.arange(actions), choice)
    if split == "stays" or choice == 0:
        return np.array([0])
    if split == "beside":
        moves = actions - 1  # they go round the compass, after staying
        return np.array([(choice - 2) % moves + 1, choice % moves + 1])
    raise ValueError(f"split must be one of {', '.join(SPLITS)}, not {split}")


def _split_process(world: GridWorld, split: str) -> FiniteMDP:
    """The MDP of a grid world whose noise is split in this way."""
    actions = len(world.actions)
    outcomes = world.outcomes()
    states = np.arange(world.state_count)
    transitions = np.zeros((actions, world.state_count, world.state_count))
    for choice in range(actions):
        others = _others(choice, actions, split)
        np.add.at(transitions[choice], (states, outcomes[:, choice]), world.success)
        for other in others:
            share = (1.0 - world.success) / len(others)
            np.add.at(transitions[choice], (states, outcomes[:, other]), share)
    return FiniteMDP.from_transitions(transitions, world.discount)
