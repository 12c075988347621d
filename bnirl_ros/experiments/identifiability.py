"""How often the posterior mode of a scenario's demonstrations is exactly its true subgoals.

`python -m bnirl_ros.experiments.identifiability` measures it for `paper_loop`, over the
demonstrations of the seeds 0 to 49 and with the default settings: in 50 of 50.

It depends on the walls, which the paper does not print. Without those behind the subgoals it was
48: in the other two the mode had the cell to the left of the paper's (2, 9) in its place. Other
walls in the middle can cost much more: two of 7 cells, at x = 6 and x = 14 in the paper's numbers,
left 2 of the first 10 seeds.
"""

from __future__ import annotations

import argparse

import numpy as np

from bnirl_ros.experiments.scenarios import SCENARIOS, Cell, Scenario, demonstrate
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings


def mode_subgoals(scenario: Scenario, seed: int, settings: Settings) -> set[Cell]:
    """Subgoals of the posterior mode of the demonstrations that a seed gives."""
    demonstration = demonstrate(scenario, np.random.default_rng(seed))
    posterior = infer(demonstration, scenario.grid_map, settings)
    cells = posterior.candidates.coordinates[np.unique(posterior.mode.subgoal_of)]
    return {(int(x), int(y)) for x, y in cells}


def main() -> None:
    """Print, seed by seed, whether the mode is the truth, and what else it is."""
    parser = argparse.ArgumentParser(description=mode_subgoals.__doc__)
    parser.add_argument("--scenario", choices=sorted(SCENARIOS), default="paper_loop")
    parser.add_argument("--seeds", type=int, default=50, help="how many (%(default)s)")
    options = parser.parse_args()
    scenario: Scenario = SCENARIOS[options.scenario]
    truth = set(scenario.subgoals)
    exact = 0
    for seed in range(options.seeds):
        found = mode_subgoals(scenario, seed, Settings())
        exact += found == truth
        print(
            f"seed {seed}: "
            + ("exactly the true subgoals" if found == truth else "")
            + "".join(f" with {cell}" for cell in sorted(found - truth))
            + "".join(f" without {cell}" for cell in sorted(truth - found)),
            flush=True,
        )
    print(f"{exact} of {options.seeds} modes are exactly the true subgoals of {scenario.name}")


if __name__ == "__main__":
    main()
