"""What a worker does with each demonstration, wherever the worker is, and what becomes of it."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from bnirl_ros.errors import InputError
from bnirl_ros.fleet.reading import Remark, Tell

Value = TypeVar("Value")
Made = TypeVar("Made", covariant=True)


class Work(Protocol[Made]):
    """What is to be done with each demonstration; it can be sent to another process."""

    def __call__(self, path: Path, *, tell: Tell) -> Made:
        """What comes of the demonstration in a file.

        Raises:
            InputError: it cannot be used.
        """


@dataclass(frozen=True, eq=False)
class Answer(Generic[Value]):
    """What became of a demonstration.

    Attributes:
        value: what came of it; None where there is an error.
        remarks: sentences on what was read, in their order.
        error: a sentence on why nothing came of it.
    """

    value: Value | None = None
    remarks: tuple[Remark, ...] = ()
    error: str | None = None


Answers = Generator[tuple[int, Answer[Value]], None, None]
"""The numbers of demonstrations, each with its answer, as soon as it is there."""


def attempt(work: Work[Value], path: Path) -> Answer[Value]:
    """What becomes of a demonstration; whatever goes wrong with it must not stop the others."""
    remarks: list[Remark] = []
    try:
        value = work(path, tell=remarks.append)
    except InputError as error:
        return Answer(None, tuple(remarks), str(error))
    except Exception as error:  # a fault of ours, or not enough memory
        words = f"{path}: {type(error).__name__}: {error}; infer from it alone to learn more"
        return Answer(None, tuple(remarks), words)
    return Answer(value, tuple(remarks))
