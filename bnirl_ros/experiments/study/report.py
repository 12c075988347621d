"""What a part of the study says: tables in markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A table with what has to be known to read it.

    Attributes:
        title: a line.
        text: a paragraph.
        header: names of the columns; the first one is that of the rows.
        rows: as many cells each as there are columns.
    """

    title: str
    text: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """The table as a section of a markdown file; all columns but the first are centred."""
        rule = ("---", *[":-:"] * (len(self.header) - 1))
        lines = [_line(row) for row in (self.header, rule, *self.rows)]
        return "\n".join([f"### {self.title}", "", self.text, "", *lines, ""])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def share(value: float, interval: tuple[float, float]) -> str:
    """A share with its interval, in per cent: `93 (90-95)`."""
    low, high = interval
    return f"{100 * value:.0f} ({100 * low:.0f}-{100 * high:.0f})"
