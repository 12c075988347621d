"""Settings with their ranges, declared once: for Python, the command line and the nodes.

A dataclass whose fields are made by `setting` is a table of settings. The options of the command,
the parameters of a node and the checks follow from it.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import Field, dataclass, field, fields
from typing import Any

from bnirl_ros.errors import InputError


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


def setting(default: Any, description: str, **limits: Any) -> Any:
    """A field of a table of settings: its default, its description and its `Limits`."""
    return field(default=default, metadata={"limits": Limits(description, **limits)})


def limits_of(setting: Field[Any]) -> Limits:
    """The limits that a field of a table of settings was declared with."""
    limits: Limits = setting.metadata["limits"]
    return limits


def kind_of(setting: Field[Any]) -> type:
    """Type of a setting's values; a parameter that may be inferred is a float."""
    return float if setting.default is None else type(setting.default)


def check(table: Any) -> None:
    """Refuse values that their limits refuse, and make whole numbers floats where floats belong.

    Args:
        table: an instance of a dataclass of settings, from its `__post_init__`.

    Raises:
        InputError: a value is of another type or out of its range; the sentence names it.
    """
    for each in fields(table):
        value, kind = getattr(table, each.name), kind_of(each)
        if value is None and each.default is None:
            continue
        if kind is float and type(value) is int:
            object.__setattr__(table, each.name, float(value))
        elif type(value) is not kind:
            raise InputError(f"{each.name} must be of type {kind.__name__}, not {value!r}")
        fault = limits_of(each).fault(each.name, getattr(table, each.name))
        if fault:
            raise InputError(fault)


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


def zero_or_more(text: str) -> float:
    """A finite number of at least 0 from a command line, for argparse."""
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be at least 0, not {text}")
    return value
