"""How far the results depend on what the paper does not print: one choice changed at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bnirl_ros.experiments.paper.courses import Parameters
from bnirl_ros.experiments.paper.experiments import Experiment, Outcome, rivals, variants
from bnirl_ros.experiments.scenarios import (
    SPLITS,
    WEIGHTS,
    Cell,
    RewardScenario,
    number_of,
    paper_cell,
)
from bnirl_ros.experiments.study.report import Table

ALPHAS = (5.0, 50.0, 500.0, 5000.0, 50000.0)
ETAS = (0.1, 1.0, 10.0, 100.0)

STARTS = ((2, 2), (10, 1), (20, 1), (20, 12))
"""Of section 4.1, in the paper's numbers; from the last, (10, 12) is no detour to (2, 17)."""

EPISODES = (1, 3, 5)
"""Numbers of demonstrations of section 4.1."""

SITES = ((5, 5), (16, 5), (5, 16), (16, 16), (10, 3), (10, 18))
"""Sites of section 4.2's features spread over the map, in the paper's numbers."""

RIVAL = "Abbeel IRL"
"""The one with which the variants are compared where 4.2's world is another."""

Walls = tuple[tuple[int, int, int, int], ...]
"""Rectangles of blocked cells (x, y, x, y), corners included, in the paper's numbers."""

WALLS: dict[str, dict[str, Walls]] = {
    "4.1": {
        "none": (),
        "across the ways": ((6, 5, 6, 9), (3, 8, 4, 8), (5, 15, 8, 15)),
        "behind the subgoals": ((11, 11, 11, 14), (1, 18, 4, 18), (1, 1, 3, 1)),
    },
    "4.3": {
        "none": (),
        "those of 4.1": ((5, 8, 5, 12), (14, 4, 14, 10), (11, 17, 17, 17)),
        "across the ways": ((6, 2, 6, 8), (14, 11, 14, 17)),
    },
}
"""Other walls than ours, by section."""


@dataclass(frozen=True)
class Variation:
    """One choice made in another way, or as we made it.

    Attributes:
        section: of the paper.
        choice: what is chosen.
        value: how, in words.
        ours: whether it is our choice.
        experiment: with that choice.
    """

    section: str
    choice: str
    value: str
    ours: bool
    experiment: Experiment


def variations(section: str, experiment: Experiment) -> list[Variation]:
    """All variations of a section's experiment."""
    base = replace(experiment, algorithms=tuple(variants(experiment.algorithms)))
    return [
        *_of_parameters(section, base),
        *(_of_subgoals(section, base) if section in WALLS else _of_features(section, base)),
    ]


def _of_parameters(section: str, base: Experiment) -> list[Variation]:
    ours = base.parameters
    return [
        Variation(
            section,
            name,
            f"{value:g}",
            getattr(ours, name) == value,
            replace(base, parameters=_parameters(ours, name, value)),
        )
        for name, values in (("alpha", ALPHAS), ("eta", ETAS))
        for value in sorted({*values, getattr(ours, name)})
    ]


def _parameters(ours: Parameters, name: str, value: float) -> Parameters:
    return replace(ours, **{name: value})


def _of_subgoals(section: str, base: Experiment) -> list[Variation]:
    scenario = base.scenario
    found = [Variation(section, "walls", "ours", True, base)]
    for value, walls in WALLS[section].items():
        world = replace(scenario, grid=grid_of(walls))
        found.append(Variation(section, "walls", value, False, replace(base, scenario=world)))
    for split in SPLITS:
        other = replace(base, scenario=replace(scenario, split=split))
        found.append(Variation(section, "noise", split, split == scenario.split, other))
    if section == "4.1":  # the paper prints both for the other sections
        for start in STARTS:
            other = replace(base, scenario=replace(scenario, start=paper_cell(*start)))
            ours = paper_cell(*start) == scenario.start
            found.append(Variation(section, "start", f"({start[0]}, {start[1]})", ours, other))
        for episodes in EPISODES:
            other = replace(base, scenario=replace(scenario, episodes=episodes))
            ours = episodes == scenario.episodes
            found.append(Variation(section, "demonstrations", str(episodes), ours, other))
    return found


def _of_features(section: str, base: Experiment) -> list[Variation]:
    scenario = base.scenario
    if not isinstance(scenario, RewardScenario):
        raise ValueError(f"section {section} has no features")
    base = replace(base, algorithms=(*base.algorithms, RIVAL))
    sites = tuple(paper_cell(*site) for site in SITES)
    choices: list[tuple[str, str, bool, RewardScenario]] = [
        ("walls", "ours", True, scenario),
        ("walls", "none", False, replace(scenario, grid=grid_of(()))),
        ("sites", "drawn for each run", True, scenario),
        ("sites", _in_words(sites), False, replace(scenario, sites=sites)),
        *(
            ("weights", weights, weights == scenario.weights, replace(scenario, weights=weights))
            for weights in WEIGHTS
        ),
        *(
            ("noise", split, split == scenario.split, replace(scenario, split=split))
            for split in SPLITS
        ),
    ]
    return [
        Variation(section, choice, value, ours, replace(base, scenario=world))
        for choice, value, ours, world in choices
    ]


def _in_words(cells: Sequence[Cell]) -> str:
    return " ".join("({}, {})".format(*number_of(cell)) for cell in cells)


def grid_of(walls: Walls, size: int = 20) -> str:
    """A square map as text with these walls."""
    blocked = np.zeros((size, size), dtype=np.bool_)
    for left, low, right, high in walls:
        blocked[low - 1 : high, left - 1 : right] = True
    return "\n".join("".join("#" if cell else "." for cell in row) for row in blocked[::-1])


def table_of(section: str, measured: Sequence[tuple[Variation, Outcome]]) -> Table:
    """What the variations of a section came to, our choices in bold."""
    with_truth = section in WALLS
    names = list(measured[0][1].experiment.algorithms)
    rival = next((name for _, outcome in measured for name in rivals(list(outcome.courses))), None)
    header = ["choice", "value", "observations"]
    for name in variants(names):
        short = name.removeprefix("BN-IRL ")
        if with_truth:
            header += [f"{short}: mode exact", f"{short}: best sample exact"]
        header += [f"{short}: loss", f"{short}: loss of the mode"]
    header += [f"{rival}: loss"] if rival else []
    lines = []
    for variation, outcome in measured:
        value = f"**{variation.value}**" if variation.ours else variation.value
        line = [variation.choice, value, f"{outcome.observations():.0f}"]
        for name in variants(names):
            found = outcome.found(name)
            if with_truth:
                line.append(f"{sum(each.mode_exact for each in found)} of {len(found)}")
                line.append(f"{sum(each.best_exact for each in found)} of {len(found)}")
            line.append(f"{outcome.final_losses(name).mean():.1f}")
            line.append(f"{np.mean([each.mode_loss for each in found]):.1f}")
        if rival:
            known = rival in outcome.courses
            line.append(f"{outcome.final_losses(rival).mean():.1f}" if known else "")
        lines.append(tuple(line))
    return Table(
        title=f"Section {section}: other choices",
        text="One choice at a time is made in another way; ours are in bold. Losses are means "
        "over the runs after the last iteration: that of the best sample, and that of the "
        "posterior mode."
        + (
            " Exact is a run whose subgoals are exactly the true ones."
            if with_truth
            else f" {RIVAL} is run again where the world or the reward is another."
        ),
        header=tuple(header),
        rows=tuple(lines),
    )
