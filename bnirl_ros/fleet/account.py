"""What became of every demonstration of a fleet: a table, and files."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from bnirl_ros.views.results import finite, write_whole
from bnirl_ros.views.tables import aligned

FILES = ("summary.json", "summary.csv")
"""What is written of it."""

FORMAT = 1
"""Format number of summary.json; added fields keep it."""


@dataclass(frozen=True)
class Account:
    """What became of one demonstration.

    Attributes:
        demonstration: its file, as it was given.
        folder: with its results, below that of the summary; empty where it has none of its own.
        first_episode: its first episode's number among those of all; None where it is not pooled.
        episodes, observations: how many it has; None where it could not be used.
        subgoals: how many it has; of a pooled one, how many of all were pursued in it.
        rhat, ess: of its chains; None where undefined, and where it is pooled.
        converged: whether its chains have; None where there are none, or it is pooled.
        left_out: what could not be used of it, counted by fault.
        damage: a sentence on where its file is damaged; None for a sound one.
        error: a sentence on why it could not be used; None where it could.
    """

    demonstration: str
    folder: str = ""
    first_episode: int | None = None
    episodes: int | None = None
    observations: int | None = None
    subgoals: int | None = None
    rhat: float | None = None
    ess: float | None = None
    converged: bool | None = None
    left_out: Mapping[str, int] = field(default_factory=dict)
    damage: str | None = None
    error: str | None = None


def write_account(folder: Path, accounts: Sequence[Account], pooled: bool) -> list[Path]:
    """Write summary.json and summary.csv; returns their paths.

    Args:
        folder: made where it is not there.
        accounts: of every demonstration.
        pooled: whether there is one posterior of all.

    Raises:
        InputError: the folder cannot be written to.
    """
    rows = [
        asdict(account) | {"rhat": finite(account.rhat), "ess": finite(account.ess)}
        for account in accounts
    ]
    document = {"format": FORMAT, "pooled": pooled, "demonstrations": rows}
    text = json.dumps(document, indent=2) + "\n"
    return write_whole(
        folder,
        {
            FILES[0]: lambda path: path.write_text(text, encoding="utf-8"),
            FILES[1]: lambda path: _write_csv(path, rows),
        },
    )


def _write_csv(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """A line for each; of what was left out, how much it was in all."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = csv.DictWriter(file, [each.name for each in fields(Account)])
        table.writeheader()
        for row in rows:
            table.writerow(row | {"left_out": sum(row["left_out"].values())})


def account_table(accounts: Sequence[Account], pooled: bool) -> str:
    """A line for each demonstration; no newline at the end."""
    columns = {
        "demonstration": [account.demonstration for account in accounts],
        "episodes": [_number(account.episodes) for account in accounts],
        "observations": [_number(account.observations) for account in accounts],
        "left out": [str(sum(account.left_out.values())) for account in accounts],
        "subgoals": [_number(account.subgoals) for account in accounts],
    }
    if not pooled:
        columns["R-hat"] = [_number(account.rhat, ".3f") for account in accounts]
        told = {None: "-", False: "no", True: "yes"}
        columns["converged"] = [told[account.converged] for account in accounts]
        columns["results"] = [account.folder or "failed" for account in accounts]
    else:
        columns["results"] = ["failed" if account.error else "pooled" for account in accounts]
    return aligned(
        list(zip(*([heading, *texts] for heading, texts in columns.items()), strict=True))
    )


def _number(value: float | None, style: str = "") -> str:
    return "-" if value is None else format(value, style)


def names_of(paths: Sequence[Path]) -> list[str]:
    """A name for each demonstration, that of its file without the ending, and none twice.

    Where several have the same name, all but the first get a number.
    """
    stems = [_stem(path) for path in paths]
    counts: dict[str, int] = {}
    names: dict[str, None] = {}
    for stem in stems:
        name = stem
        while name in names or name in FILES or (name != stem and name in stems):
            counts[stem] = counts.get(stem, 1) + 1
            name = f"{stem}_{counts[stem]}"
        names[name] = None
    return list(names)


def _stem(path: Path) -> str:
    named = path if path.name not in ("", "..") else path.resolve()
    return (named.name if path.is_dir() else named.stem) or "demonstration"
