"""Demonstrators that are not as the models assume: which of their subgoals are found all the same?

A row for each assumption that is wrong. Both models get the same demonstrations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bnirl_ros.experiments.study.intervals import ratio_interval, wilson
from bnirl_ros.experiments.study.part import MODELS, SEED, Part, settings_of
from bnirl_ros.experiments.study.report import Table, share
from bnirl_ros.experiments.study.scores import matches
from bnirl_ros.experiments.study.simulated import (
    SIZE,
    SUBGOALS,
    Demonstrator,
    demonstrate,
    random_map,
)
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.summary import summarise

DEMONSTRATIONS = 120
"""For each row."""

SWEEPS = {"sweeps": 400, "burn_in": 100}
"""Fewer than by default, the same for all: the demonstrations are short, and many."""

DEMONSTRATORS = {
    "as assumed": Demonstrator(noise=0.0),
    "some noise": Demonstrator(),
    "success 0.95, assumed 0.7": Demonstrator(success=0.95),
    "discount 0.9, assumed 0.99": Demonstrator(discount=0.9),
    "detours": Demonstrator(detours=0.3),
    "pauses": Demonstrator(pauses=0.05),
    "changes of mind": Demonstrator(changes_of_mind=0.3),
    "sloppy stops": Demonstrator(sloppiness=1),
}
"""Who is observed, by the name of the row. The noise of the second is in all further ones, too."""

REACHES = {"exact": 0, "near": 1}
"""How far from a true subgoal one that is found may be [cells]."""


@dataclass(frozen=True)
class Case:
    """The demonstration of a row with this number, seen through a model."""

    model: str
    row: str
    number: int


def run(case: Case) -> dict[str, Any]:
    """How many subgoals are true, how many found, and how many of them match."""
    row = list(DEMONSTRATORS).index(case.row)
    generator = np.random.default_rng([SEED, row, case.number])
    grid_map = random_map(generator)
    demonstration, truth = demonstrate(DEMONSTRATORS[case.row], grid_map, generator)
    settings = settings_of(case.model, **SWEEPS)
    summary = summarise(infer(demonstration, grid_map, settings), grid_map)
    found = [subgoal.cell for subgoal in summary.subgoals]
    return {
        "model": case.model,
        "row": case.row,
        "number": case.number,
        "observations": len(demonstration),
        "true": len(truth),
        "found": len(found),
        **{name: matches(truth, found, reach) for name, reach in REACHES.items()},
    }


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each demonstrator and model."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault((result["row"], result["model"]), []).append(result)
    steps = np.mean([result["observations"] for result in results])
    return Table(
        title="Demonstrators that are not as assumed",
        text=f"{DEMONSTRATIONS} demonstrations a row, of {steps:.0f} observations on average, on "
        f"random maps of {SIZE} x {SIZE} cells with {SUBGOALS} subgoals each. All but the first "
        f"act by chance in {Demonstrator().noise:.0%} of their steps. Recall is the share of the "
        "true subgoals that are among those of the mode, precision the share of the mode's "
        "subgoals that are true, in per cent with 95 % intervals (bootstrap over demonstrations); "
        "a second subgoal beside the same true one is wrong. `all and only` is the share of "
        "demonstrations whose subgoals are the true ones within a cell, with Wilson's interval.",
        header=(
            "demonstrator",
            "model",
            "recall, same cell",
            "precision, same cell",
            "recall, within a cell",
            "precision, within a cell",
            "all and only",
        ),
        rows=tuple((*names, *_shares(group)) for names, group in groups.items()),
    )


def _shares(group: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    columns = {name: [result[name] for result in group] for name in ("true", "found", *REACHES)}
    cells = []
    for name in REACHES:
        for whole in ("true", "found"):
            generator = np.random.default_rng(SEED)
            interval = ratio_interval(columns[name], columns[whole], generator)
            cells.append(share(sum(columns[name]) / max(sum(columns[whole]), 1), interval))
    right = sum(result["near"] == result["true"] == result["found"] for result in group)
    return (*cells, share(right / len(group), wilson(right, len(group))))


def cases(recordings: Path) -> Sequence[Case]:
    """Every demonstration of every row, through every model."""
    return [
        Case(model, row, number)
        for row in DEMONSTRATORS
        for model in MODELS
        for number in range(DEMONSTRATIONS)
    ]


PART = Part(name="robustness", cases=cases, run=run, table=table)
