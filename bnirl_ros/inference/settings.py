"""Every setting of an inference, declared once: for Python, the command line and the node."""

from __future__ import annotations

import argparse
import math
from dataclasses import Field, dataclass, field, fields
from typing import Any

from bnirl_ros.errors import InputError
from bnirl_ros.model.candidates import CANDIDATE_KINDS
from bnirl_ros.model.likelihood import LIKELIHOODS
from bnirl_ros.model.pursuits import PRIORS, VALUE_ALPHA


@dataclass(frozen=True)
class Limits:
    """What a setting may be.

    Attributes:
        description: for `--help` and `ros2 param describe`, with the symbol and the unit.
        lowest, highest: bounds, in the range themselves unless `above` or `below` says not.
        above, below: exclusive bounds.
        choices: the values that there are, where they can be counted.
    """

    description: str
    lowest: float = -math.inf
    highest: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    choices: tuple[Any, ...] = ()

    def fault(self, name: str, value: Any) -> str | None:
        """One sentence on what is wrong with a value, or None."""
        if self.choices:
            if value in self.choices:
                return None
            return f"{name} must be one of {', '.join(map(str, self.choices))}, not {value}"
        if isinstance(value, str):
            return None
        if isinstance(value, float) and not math.isfinite(value):
            return f"{name} must be a finite number, not {value}"
        if not max(self.lowest, self.above) <= value <= min(self.highest, self.below) or (
            value in (self.above, self.below)
        ):
            return f"{name} must be {self.range_in_words()}, not {value}"
        return None

    def range_in_words(self) -> str:
        """Such as "above 0 and at most 1"; empty where everything goes."""
        bounds = (
            (self.above, "above {:g}"),
            (self.lowest, "at least {:g}"),
            (self.below, "below {:g}"),
            (self.highest, "at most {:g}"),
        )
        return " and ".join(words.format(bound) for bound, words in bounds if abs(bound) < 1e300)


PAPER_PARAMETERS = {"alpha": 50.0, "eta": 1.0}
"""What the paper's model takes where nothing is given: it infers neither."""

SEQUENTIAL_ONLY = {*PRIORS} - {*PAPER_PARAMETERS} | {"arrival_radius", "likelihood"}
"""Settings that only the sequential model has."""


def _setting(default: Any, description: str, **limits: Any) -> Any:
    return field(default=default, metadata={"limits": Limits(description, **limits)})


def _parameter(name: str, description: str, **limits: Any) -> Any:
    """A parameter of the model, which is inferred where it is not given."""
    words = f"{description}; inferred where not given, prior {PRIORS[name]}"
    if name in PAPER_PARAMETERS:
        words += f"; {PAPER_PARAMETERS[name]:g} for the paper's model"
    return field(default=None, metadata={"limits": Limits(words, **limits)})


def limits_of(setting: Field[Any]) -> Limits:
    """The limits that a field of `Settings` was declared with."""
    limits: Limits = setting.metadata["limits"]
    return limits


def kind_of(setting: Field[Any]) -> type:
    """Type of a setting's values; a parameter that may be inferred is a float."""
    return float if setting.default is None else type(setting.default)


@dataclass(frozen=True)
class Settings:
    """Model and sampling settings; the defaults are those of `bnirl infer` and the node.

    Raises:
        InputError: a value is out of its range; the sentence names it.
    """

    model: str = _setting(
        "sequential",
        "model of the demonstrator: pursuits in sequence, or the mixture of Michini & How",
        choices=("sequential", "paper"),
    )
    alpha: float | None = _parameter(
        "alpha", "confidence [nats for each step lost], or alpha of equation (7)", above=0.0
    )
    eta: float | None = _parameter("eta", "concentration of the subgoals' weights", above=0.0)
    slip: float | None = _parameter(
        "slip", "probability of an action that no subgoal explains", lowest=0.0, below=1.0
    )
    switch_on_arrival: float | None = _parameter(
        "switch_on_arrival", "probability of the next subgoal on arriving", lowest=0.0, highest=1.0
    )
    switch_at_subgoal: float | None = _parameter(
        "switch_at_subgoal",
        "probability of the next subgoal in each further observation there",
        lowest=0.0,
        highest=1.0,
    )
    switch_elsewhere: float | None = _parameter(
        "switch_elsewhere",
        "probability of another subgoal in each observation on the way",
        lowest=0.0,
        highest=1.0,
    )
    arrival_radius: float = _setting(
        0.0, "distance within which a subgoal is reached [m]; 0: in its cell", lowest=0.0
    )
    likelihood: str = _setting(
        "delay",
        "what actions of the sequential model cost: steps, or value as in equation (7); with "
        f"value the prior of alpha is {VALUE_ALPHA}",
        choices=LIKELIHOODS,
    )
    sweeps: int = _setting(1000, "sweeps of each chain, burn-in included", lowest=1)
    burn_in: int = _setting(200, "first sweeps of each chain that are left out", lowest=0)
    thin: int = _setting(1, "every how many sweeps a draw is kept", lowest=1)
    chains: int = _setting(4, "number of independent chains", lowest=1, highest=1000)
    seed: int = _setting(0, "seed of the random numbers", lowest=0)
    success: float = _setting(
        0.7,
        "probability that a move goes as chosen; the rest is spread over the other actions",
        above=0.0,
        highest=1.0,
    )
    discount: float = _setting(0.99, "discount factor gamma", lowest=0.0, below=1.0)
    moves: int = _setting(
        8, "moves to neighbouring cells: 8, or 4 for no diagonals", choices=(4, 8)
    )
    candidates: str = _setting(
        "visited",
        "cells that may be subgoals: the visited ones, or all free ones",
        choices=CANDIDATE_KINDS,
    )

    def __post_init__(self) -> None:
        for setting in fields(self):
            value, kind = getattr(self, setting.name), kind_of(setting)
            if value is None and setting.default is None:
                continue
            if kind is float and type(value) is int:
                object.__setattr__(self, setting.name, float(value))
            elif type(value) is not kind:
                raise InputError(f"{setting.name} must be of type {kind.__name__}, not {value!r}")
            fault = limits_of(setting).fault(setting.name, getattr(self, setting.name))
            if fault:
                raise InputError(fault)
        if self.model == "paper":
            self._refuse_what_the_paper_does_not_know()
        if self.draws < 1:
            raise InputError(
                f"sweeps must leave a draw: {self.sweeps} sweeps less {self.burn_in} of burn-in "
                f"hold none at thin {self.thin}"
            )

    def _refuse_what_the_paper_does_not_know(self) -> None:
        for setting in fields(self):
            sequential = setting.name in SEQUENTIAL_ONLY
            if sequential and getattr(self, setting.name) != setting.default:
                raise InputError(
                    f"{setting.name} is no setting of the paper's model; leave it out, or take "
                    "the sequential model"
                )

    @property
    def fixed(self) -> dict[str, float]:
        """The parameters of the model that are not inferred, by name."""
        given = {name: getattr(self, name) for name in PRIORS}
        if self.model == "paper":
            given = {
                name: default if given[name] is None else given[name]
                for name, default in PAPER_PARAMETERS.items()
            }
        return {name: value for name, value in given.items() if value is not None}

    @property
    def draws(self) -> int:
        """Draws kept from each chain."""
        return (self.sweeps - self.burn_in) // self.thin


def above_zero(text: str) -> float:
    """A finite number above 0 from a command line, for argparse."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be above 0, not {text}")
    return value


def one_or_more(text: str) -> int:
    """A whole number of at least 1 from a command line, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {text}")
    return value
