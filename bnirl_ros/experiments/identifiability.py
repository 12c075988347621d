"""How often the posterior mode of a scenario's demonstrations is exactly its true subgoals.

`python -m bnirl_ros.experiments.identifiability` measures it for `paper_loop`, over the
demonstrations of the seeds 0 to 49 and with the default settings: in 50 of 50.

It depends on the walls, which the paper does not print. Without those behind the subgoals it was
48: in the other two the mode had the cell to the left of the paper's (2, 9) in its place. Other
walls in the middle can cost much more: two of 7 cells, at x = 6 and x = 14 in the paper's numbers,
left 2 of the first 10 seeds.

It depends as much on where demonstrations begin. Whoever comes by a subgoal on the shortest way to
another one does nothing that the other one alone would not explain. `--starts` lets one
demonstration begin in many cells of the map, and counts by how many steps of a detour the first
subgoal is from there. With the paper's model and 100 sweeps, as `bnirl reproduce` runs it on
`paper_grid`, the mode is exact in 7 % where that is less than half a step, and in 99 % where it is
eight or more.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from bnirl_ros.experiments.scenarios import SCENARIOS, Cell, Scenario, demonstrate
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.limits import one_or_more
from bnirl_ros.mdp.goal_values import goal_values

EDGES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Of the bins of detours [steps]; the last bin has no upper edge."""

EVERY = 2
"""Demonstrations begin in every such cell of every such row that is free."""


def mode_subgoals(scenario: Scenario, seed: int, settings: Settings) -> set[Cell]:
    """Subgoals of the posterior mode of the demonstrations that a seed gives."""
    demonstration = demonstrate(scenario, np.random.default_rng(seed))
    posterior = infer(demonstration, scenario.grid_map, settings)
    cells = posterior.candidates.coordinates[np.unique(posterior.mode.subgoal_of)]
    return {(int(x), int(y)) for x, y in cells}


def detours(scenario: Scenario) -> list[float]:
    """How many steps more the way to another subgoal takes over each subgoal than straight.

    From where the demonstrator begins to pursue it, and to that one of the others where this is
    the least. A way's length is the certain number of steps that is worth as much as the uncertain
    one, log h / log gamma with the discounted first-passage value h. 0 means that the subgoal lies
    on a shortest way to another one, which explains as well what is done on the way to it.
    """
    world = scenario.world
    goals = world.states_of(scenario.subgoals)
    stops = np.concatenate([world.states_of(scenario.start), goals])
    values = goal_values(scenario.process, goals, stops).max(axis=1)
    at_goal = np.diag(values[1:])
    length = np.log(values / at_goal) / np.log(scenario.discount)  # [stop, goal]
    return [
        float(
            min(
                max(0.0, length[here, here] + length[here + 1, other] - length[here, other])
                for other in range(len(goals))
                if goals[other] != goals[here]
            )
        )
        for here in range(len(goals))
    ]


@dataclass(frozen=True)
class Start:
    """One demonstration of a scenario from another start, so and so often.

    Attributes:
        scenario: with that start and a single episode.
        seeds: how many demonstrations, from 0.
        settings: of the inference, but for its seed.
    """

    scenario: Scenario
    seeds: int
    settings: Settings


def starts(scenario: Scenario, seeds: int, settings: Settings) -> list[Start]:
    """Starts all over the free part of the map, those at the first subgoal left out."""
    free = scenario.grid_map.free
    cells = product(range(0, free.shape[1], EVERY), range(0, free.shape[0], EVERY))
    return [
        Start(replace(scenario, start=(x, y), episodes=1), seeds, settings)
        for x, y in cells
        if free[y, x] and (x, y) != scenario.subgoals[0]
    ]


def exact_modes(start: Start) -> int:
    """Of how many of the demonstrations the mode is exactly the true subgoals."""
    truth = set(start.scenario.subgoals)
    return sum(
        mode_subgoals(start.scenario, seed, replace(start.settings, seed=seed)) == truth
        for seed in range(start.seeds)
    )


@dataclass(frozen=True)
class DetourBin:
    """What was found from starts from which the first subgoal is about as much of a detour.

    Attributes:
        low, high: the detours [steps]; `high` may be infinite.
        starts: how many.
        demonstrations: from them.
        exact: of how many of these the mode is exactly the true subgoals.
    """

    low: float
    high: float
    starts: int
    demonstrations: int
    exact: int


def by_detour(chosen: Sequence[Start], exact: Sequence[int]) -> list[DetourBin]:
    """Starts with their counts of `exact_modes`, by the detour of the first subgoal."""
    first = np.array([detours(start.scenario)[0] for start in chosen])
    bins = np.searchsorted(EDGES, first, side="right") - 1
    return [
        DetourBin(
            low=low,
            high=(*EDGES[1:], np.inf)[number],
            starts=int((bins == number).sum()),
            demonstrations=sum(
                start.seeds for start, bin_ in zip(chosen, bins, strict=True) if bin_ == number
            ),
            exact=sum(count for count, bin_ in zip(exact, bins, strict=True) if bin_ == number),
        )
        for number, low in enumerate(EDGES)
    ]


def main() -> None:
    """Print, seed by seed or detour by detour, whether the mode is the truth."""
    parser = argparse.ArgumentParser(description=mode_subgoals.__doc__)
    parser.add_argument("--scenario", choices=sorted(SCENARIOS), default="paper_loop")
    parser.add_argument("--seeds", type=one_or_more, default=50, help="how many (%(default)s)")
    parser.add_argument(
        "--starts", action="store_true", help="one demonstration from each of many cells instead"
    )
    options = parser.parse_args()
    scenario: Scenario = SCENARIOS[options.scenario]
    if options.starts:
        _print_starts(scenario, options.seeds)
    else:
        _print_seeds(scenario, options.seeds)


def _print_seeds(scenario: Scenario, seeds: int) -> None:
    truth = set(scenario.subgoals)
    exact = 0
    for seed in range(seeds):
        found = mode_subgoals(scenario, seed, Settings())
        exact += found == truth
        print(
            f"seed {seed}: "
            + ("exactly the true subgoals" if found == truth else "")
            + "".join(f" with {cell}" for cell in sorted(found - truth))
            + "".join(f" without {cell}" for cell in sorted(truth - found)),
            flush=True,
        )
    print(f"{exact} of {seeds} modes are exactly the true subgoals of {scenario.name}")


def _print_starts(scenario: Scenario, seeds: int) -> None:
    chosen = starts(scenario, seeds, Settings())
    counts = []
    for start in chosen:
        counts.append(exact_modes(start))
        x, y = start.scenario.start
        print(
            f"from ({x}, {y}): a detour of {detours(start.scenario)[0]:.2f} steps, "
            f"{counts[-1]} of {seeds} modes exact",
            flush=True,
        )
    for bin_ in by_detour(chosen, counts):
        print(
            f"{bin_.low:g} to {bin_.high:g} steps: {bin_.exact} of {bin_.demonstrations} modes "
            f"are exactly the true subgoals, from {bin_.starts} starts"
        )


if __name__ == "__main__":
    main()
