"""What a part of the study is made of, and the settings that all parts share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from bnirl_ros.experiments.study.report import Table
from bnirl_ros.inference.settings import Settings
from bnirl_ros.limits import limits_of

SEED = 20120924
"""From which all random numbers of the study come: the first day of the paper's conference."""

MODELS: tuple[str, ...] = next(
    limits_of(setting).choices for setting in fields(Settings) if setting.name == "model"
)
"""The models that are held against each other: all that there are."""

CHAINS = 2
"""Chains of every inference. Cases run side by side, so more of them would only take longer."""


def settings_of(model: str, **others: Any) -> Settings:
    """The shipped defaults for a model, with the study's number of chains."""
    return Settings(model=model, **({"chains": CHAINS} | others))


@dataclass(frozen=True)
class Part:
    """A part of the study.

    Attributes:
        name: on the command line.
        cases: what to run, given the folder of the recordings of human play; raises InputError
            where something is missing.
        run: runs a case, in any process; returns what JSON can hold.
        table: what the results say, in the order of the cases.
        alone: whether nothing else may run at the same time.
    """

    name: str
    cases: Callable[[Path], Sequence[Any]]
    run: Callable[[Any], dict[str, Any]]
    table: Callable[[Sequence[dict[str, Any]]], Table]
    alone: bool = False
