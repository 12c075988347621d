"""The subgoals as a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from bnirl_ros.inference.summary import Subgoal, Summary

_HEADINGS = ("rank", "cell", "place [m]", "probability", "observations", "order")


def subgoal_table(subgoals: Sequence[Subgoal], visit_sequence: Sequence[int]) -> str:
    """One aligned line for each subgoal below a line of headings; no newline at the end.

    Columns: rank; cell (x, y); place, the centre of the cell in the map frame [m]; probability;
    number of observations; order, the 1-based position in the visit sequence.
    """
    order = {rank: position for position, rank in enumerate(visit_sequence, start=1)}
    rows = [
        (
            str(subgoal.rank),
            "({}, {})".format(*subgoal.cell),
            "({:.2f}, {:.2f})".format(*subgoal.position),
            f"{subgoal.probability:.2f}",
            str(subgoal.observations),
            str(order.get(subgoal.rank, "-")),
        )
        for subgoal in subgoals
    ]
    table = [_HEADINGS, *rows]
    widths = [max(len(row[column]) for row in table) for column in range(len(_HEADINGS))]
    return "\n".join(
        "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True))
        for row in table
    )


def convergence(summary: Summary) -> str:
    """One line on how many observations there were and how far the chains agree."""
    rhat = "undefined" if summary.rhat is None else f"{summary.rhat:.3f}"
    size = "undefined" if summary.ess is None else f"{summary.ess:.0f}"
    return (
        f"{len(summary.observations)} observations, {summary.chains} chains of {summary.draws} "
        f"draws, R-hat {rhat}, effective sample size {size}"
    )
