"""When a model is right: is a cell a subgoal as often as the posterior says that it is?

The demonstrator is drawn from the model's own prior, all free cells being candidates, so whatever
is off is the sampler's or the summary's doing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.study.intervals import normal_quantile
from bnirl_ros.experiments.study.part import MODELS, SEED, Part, settings_of
from bnirl_ros.experiments.study.report import Table
from bnirl_ros.experiments.study.scores import Cell
from bnirl_ros.inference.posterior import grid_world, infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.model.likelihood import action_log_likelihood
from bnirl_ros.model.pursuits import pursuit_model

DEMONSTRATIONS = 2000
"""For each model."""

EDGES = (0.0, 0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95, 1.0)
"""Of the bins of stated probabilities; the last bin holds its upper edge, too."""

CLAIMED = 9
"""The bin for which the band is stated: 0.85-0.95."""

LEVEL = 0.99
"""Probability of the band."""

SAMPLING = {"candidates": "free", "sweeps": 1200, "burn_in": 200}
"""What differs from the defaults: candidates that do not depend on the demonstration, as the prior
must not, and the length of the chains."""

Simulator = Callable[[np.random.Generator], tuple[Demonstration, GridMap, list[Cell]]]
"""A demonstration drawn from a model's prior, its map, and the cells that are subgoals in it."""

_MAP = GridMap(
    np.array([[cell == "." for cell in row] for row in ("......", ".##...", "...#..", "......")])
)
_OBSERVATIONS = 40  # of each episode
_EPISODES = 2  # of a demonstrator who pursues subgoals in sequence


def simulate_exchangeable(
    generator: np.random.Generator,
) -> tuple[Demonstration, GridMap, list[Cell]]:
    """From the paper's prior: states by chance, subgoals from the urn, actions by (7)."""
    settings = Settings(model="paper")
    world = grid_world(_MAP, settings)
    free = np.flatnonzero(world.free)
    alpha, eta = settings.fixed["alpha"], settings.fixed["eta"]
    policies = np.exp(action_log_likelihood(goal_values(world, free, free), alpha))
    states = generator.integers(len(free), size=_OBSERVATIONS)
    subgoals: list[int] = []
    for seen in range(_OBSERVATIONS):
        place = generator.random() * (seen + eta)
        old = place < seen
        subgoals.append(subgoals[int(place)] if old else int(generator.integers(len(free))))
    choices = [
        int(np.searchsorted(np.cumsum(policies[state, :, subgoal]), generator.random()))
        for state, subgoal in zip(states, subgoals, strict=True)
    ]
    demonstration = Demonstration(
        episode=np.zeros(_OBSERVATIONS, dtype=np.int64),
        cells=world.cells_of(free[states]),
        action=world.actions[np.minimum(choices, len(world.actions) - 1)],
        last_episode=np.empty(0, dtype=np.int64),
        last_cells=np.empty((0, 2), dtype=np.int64),
    )
    truth = world.cells_of(free[sorted(set(subgoals))])
    return demonstration, _MAP, [(int(x), int(y)) for x, y in truth]


def simulate_in_sequence(
    generator: np.random.Generator,
) -> tuple[Demonstration, GridMap, list[Cell]]:
    """From the prior of the sequential model: parameters, pursuits, slips, and where they lead.

    A subgoal that only slips pursued is none: no posterior counts it as one either.
    """
    world = grid_world(_MAP, Settings())
    free = np.flatnonzero(world.free)
    every = pursuit_model(world, free, np.zeros(len(free)), np.arange(len(free)) == 0, free)
    parameters = np.array([prior.draw(generator) for prior in every.priors.values()])
    _, eta, slip, on_arrival, at_subgoal, elsewhere = parameters
    parameters[2] = 0.0
    policies = every.action_likelihood(parameters)
    outcomes = world.outcomes()

    draws: list[int] = []
    states, choices, explaining = [], [], set()
    row = subgoal = -1
    for t in range(_EPISODES * _OBSERVATIONS):
        if t % _OBSERVATIONS == 0:
            row, rho = int(generator.integers(len(free))), 1.0
        elif row != subgoal:
            rho = elsewhere
        else:
            rho = at_subgoal if states[-1] == row else on_arrival
        if generator.random() < rho:
            place = generator.random() * (len(draws) + eta)
            old = place < len(draws)
            draws.append(draws[int(place)] if old else int(generator.integers(len(free))))
            subgoal = draws[-1]
        distinct = np.isfinite(every.cost[row, :, 0])
        if generator.random() < slip:
            policy = distinct / distinct.sum()
        else:
            policy = policies[row, :, subgoal]
            explaining.add(subgoal)
        choice = int(generator.choice(len(policy), p=policy))
        states.append(row)
        choices.append(choice)
        others = np.delete(np.arange(len(policy)), choice)
        happens = choice if generator.random() < world.success else generator.choice(others)
        row = int(np.searchsorted(free, outcomes[free[row], happens]))
    demonstration = Demonstration(
        episode=np.repeat(np.arange(_EPISODES), _OBSERVATIONS),
        cells=world.cells_of(free[states]),
        action=world.actions[choices],
        last_episode=np.empty(0, dtype=np.int64),
        last_cells=np.empty((0, 2), dtype=np.int64),
    )
    truth = world.cells_of(free[sorted(explaining)])
    return demonstration, _MAP, [(int(x), int(y)) for x, y in truth]


SIMULATORS: dict[str, Simulator] = {
    "sequential": simulate_in_sequence,
    "paper": simulate_exchangeable,
}
"""A demonstrator from each model's own prior. A model that none is given for has no rows."""


@dataclass(frozen=True)
class Bin:
    """Statements of about the same probability.

    Attributes:
        statements: how many.
        stated: their mean probability.
        observed: the share of them that are true.
        band: half the width of the band around `stated` in which `observed` lies with probability
            `LEVEL` where the statements are right, by how they turned out.
        band_if_independent: the same, by what was stated, if no statement depended on another.
    """

    statements: int
    stated: float
    observed: float
    band: float
    band_if_independent: float

    @property
    def holds(self) -> bool:
        """Whether what was observed lies in the wider of the two bands."""
        return abs(self.observed - self.stated) <= max(self.band, self.band_if_independent)


def reliability(
    stated: npt.NDArray[np.float64],
    true: npt.NDArray[np.bool_],
    demonstration: npt.NDArray[np.int64],
) -> Bin:
    """How the statements (M,) of one bin compare with the truth.

    Statements on cells of one demonstration depend on each other: one of two neighbours is the
    subgoal, or two are taken for one another. Demonstrations are independent. If every statement
    is right, the sum of true less stated over the cells of a demonstration has mean 0 given what
    was observed, whatever else its distribution is; so the sum of the squares of these sums is an
    unbiased estimate of the variance of their total. That gives the band, by the central limit
    theorem over demonstrations. Where hardly any statement is wrong the estimate is too small, so
    the band that takes the statements as independent, of a Poisson-binomial variance, is its least
    width.

    Args:
        stated: probabilities.
        true: whether each cell is a subgoal.
        demonstration: (M,) number of the demonstration of each.
    """
    count = max(len(stated), 1)
    _, cluster = np.unique(demonstration, return_inverse=True)
    excess = np.bincount(cluster, weights=true - stated) if len(stated) else np.zeros(1)
    z = normal_quantile(LEVEL)
    return Bin(
        statements=len(stated),
        stated=float(stated.sum() / count),
        observed=float(true.sum() / count),
        band=float(z * np.sqrt((excess**2).sum()) / count),
        band_if_independent=float(z * np.sqrt((stated * (1.0 - stated)).sum()) / count),
    )


def bins_of(
    stated: npt.NDArray[np.float64],
    true: npt.NDArray[np.bool_],
    demonstration: npt.NDArray[np.int64],
) -> list[Bin]:
    """The bin between each two of `EDGES`, of statements (M,) as in `reliability`."""
    number = np.clip(np.searchsorted(EDGES, stated, side="right") - 1, 0, len(EDGES) - 2)
    return [
        reliability(stated[number == each], true[number == each], demonstration[number == each])
        for each in range(len(EDGES) - 1)
    ]


@dataclass(frozen=True)
class Case:
    """The demonstration with this number from a model's prior."""

    model: str
    number: int


def run(case: Case) -> dict[str, Any]:
    """What is stated of each free cell, and whether it is true."""
    generator = np.random.default_rng([SEED, MODELS.index(case.model), case.number])
    demonstration, grid_map, truth = SIMULATORS[case.model](generator)
    settings = settings_of(case.model, **SAMPLING)
    summary = summarise(infer(demonstration, grid_map, settings), grid_map)
    true = np.zeros(grid_map.free.shape, dtype=np.bool_)
    for x, y in truth:
        true[y, x] = True
    return {
        "model": case.model,
        "number": case.number,
        "stated": summary.cell_probability[grid_map.free].tolist(),
        "true": true[grid_map.free].tolist(),
    }


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each model and bin."""
    rows = []
    for model in dict.fromkeys(result["model"] for result in results):
        mine = [result for result in results if result["model"] == model]
        stated = np.concatenate([result["stated"] for result in mine])
        true = np.concatenate([result["true"] for result in mine]).astype(np.bool_)
        cells = [len(result["stated"]) for result in mine]
        bins = bins_of(stated, true, np.repeat(np.arange(len(mine)), cells))
        rows += [_row(model, number, each) for number, each in enumerate(bins)]
    return Table(
        title="What is stated, when the model is right",
        text=f"{DEMONSTRATIONS:,} demonstrations from the model's own prior, all free cells being "
        "candidates. Of the statements that a cell is a subgoal, by the probability given: how "
        f"many are true. The band is that of {LEVEL:.0%} around what was stated on average, for "
        "independent demonstrations with cells that depend on each other in any way; beside it "
        "the one that it would be for independent cells, which is its least width.",
        header=(
            "model",
            "probability",
            "statements",
            "stated",
            "true",
            "band",
            "if independent",
            "within",
        ),
        rows=tuple(rows),
    )


def _row(model: str, number: int, statements: Bin) -> tuple[str, ...]:
    name = f"{EDGES[number]:g}-{EDGES[number + 1]:g}"
    return (
        model,
        f"**{name}**" if number == CLAIMED else name,
        f"{statements.statements:,}",
        f"{statements.stated:.4f}",
        f"{statements.observed:.4f}",
        f"± {statements.band:.4f}",
        f"± {statements.band_if_independent:.4f}",
        "yes" if statements.holds else "no",
    )


def cases(recordings: Path) -> Sequence[Case]:
    """Every demonstration of every model that can be drawn from."""
    return [
        Case(model, number)
        for model in MODELS
        if model in SIMULATORS
        for number in range(DEMONSTRATIONS)
    ]


PART = Part(name="reliability", cases=cases, run=run, table=table)
