"""What a posterior says, as text for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from bnirl_ros.bags.topics import Topic
from bnirl_ros.inference.chains import TIME_BUDGET, Sampling
from bnirl_ros.inference.convergence import Convergence
from bnirl_ros.inference.summary import Parameter, Subgoal, Summary
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.pursuits import knows_pursuits, unexplained_share


def report(summary: Summary) -> str:
    """All that a summary tells on the terminal, line by line; no newline at the end.

    Above all the subgoals, then slips, loop and parameters where the model knows them, and last
    how far the chains agree and whether that is enough.
    """
    lines = [subgoal_table(summary.subgoals, summary.visit_sequence)]
    if summary.repetitions > 1:
        lines.append(f"the visits go round {summary.repetitions} times")
    if knows_pursuits(summary):
        lines.append(f"unexplained: {unexplained_share(summary)} of the observations")
    if summary.parameters:
        lines.append(parameter_table(summary.parameters))
    lines.append(convergence(summary))
    if summary.sampling:
        lines.append(verdict(summary.convergence, summary.sampling))
    return "\n".join(lines)


def subgoal_table(subgoals: Sequence[Subgoal], visit_sequence: Sequence[int]) -> str:
    """The columns of the subgoals side by side, a line for each; no newline at the end."""
    columns = subgoal_columns(subgoals, visit_sequence).items()
    return aligned(list(zip(*([heading, *texts] for heading, texts in columns), strict=True)))


def subgoal_columns(
    subgoals: Sequence[Subgoal], visit_sequence: Sequence[int]
) -> dict[str, list[str]]:
    """What a table tells of the subgoals, by heading.

    Columns: rank; cell (x, y), or the name or the coordinates of the feature; place, the centre of
    the cell (of a feature, of the middle one of its cells) in the map frame [m]; probability;
    number of observations; where the model knows pursuits, their expected number; order, the
    1-based position in the visit sequence.
    """
    columns = {
        "rank": [str(subgoal.rank) for subgoal in subgoals],
        _heading(subgoals): [what_of(subgoal) for subgoal in subgoals],
        "place [m]": ["({:.2f}, {:.2f})".format(*subgoal.position) for subgoal in subgoals],
        "probability": [f"{subgoal.probability:.2f}" for subgoal in subgoals],
        "observations": [str(subgoal.observations) for subgoal in subgoals],
    }
    pursuits = [subgoal.pursuits for subgoal in subgoals if subgoal.pursuits is not None]
    if pursuits:
        columns["pursuits"] = [f"{expected:.1f}" for expected in pursuits]
    order = {rank: position for position, rank in enumerate(visit_sequence, start=1)}
    return columns | {"order": [str(order.get(subgoal.rank, "-")) for subgoal in subgoals]}


def _heading(subgoals: Sequence[Subgoal]) -> str:
    """What the subgoals are, by the first one: all are of the same kind."""
    return "feature" if any(subgoal.feature is not None for subgoal in subgoals) else "cell"


def what_of(subgoal: Subgoal) -> str:
    """A subgoal in words: its cell, or the name or the coordinates of its feature."""
    return subgoal.name or "({})".format(", ".join(map(str, subgoal.feature or subgoal.cell)))


def parameter_table(parameters: Sequence[Parameter]) -> str:
    """One aligned line for each parameter: name, median, and 90 % interval or 'fixed'."""
    rows = [
        (
            parameter.name,
            f"{parameter.median:.3g}",
            interval_of(parameter),
        )
        for parameter in parameters
    ]
    return aligned([("parameter", "median", "90 % interval"), *rows])


def interval_of(parameter: Parameter) -> str:
    """The interval of a parameter in words, or 'fixed'."""
    return "{:.3g} to {:.3g}".format(*parameter.interval) if parameter.inferred else "fixed"


def aligned(table: Sequence[Sequence[str]]) -> str:
    """The rows as lines, each column flush right and as wide as it has to be.

    A text stays on its line, whatever characters it has.
    """
    table = [[plain(text) for text in row] for row in table]
    widths = [max(len(text) for text in column) for column in zip(*table, strict=True)]
    return "\n".join(
        "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True))
        for row in table
    )


def topic_table(topics: Sequence[Topic], motion: Sequence[Topic]) -> str:
    """One aligned line for each topic of a bag; no newline at the end.

    Args:
        topics: all of them.
        motion: those that tell motion, which are numbered in this order.
    """
    order = {topic.name: str(place) for place, topic in enumerate(motion, start=1)}
    rows = [
        (
            order.get(topic.name, "-"),
            str(topic.messages),
            topic.type_name or "unknown",
            topic.name,
            ", ".join(dict.fromkeys(map(str, topic.qos))) or "-",
        )
        for topic in topics
    ]
    return aligned([("motion", "messages", "type", "topic", "quality of service"), *rows])


def convergence(summary: Summary) -> str:
    """One line on how many observations there were and how far the chains agree."""
    return (
        f"{len(summary.observations)} observations, {summary.chains} chains of {summary.draws} "
        f"draws, R-hat {known(summary.rhat, '.3f')}, effective sample size "
        f"{known(summary.ess, '.0f')}"
    )


def verdict(agreed: Convergence, sampling: Sampling) -> str:
    """One line on whether the chains have converged and what stopped them; if not, what to do."""
    if agreed.reached:
        return f"the chains have converged {after(sampling)}"
    remedy = f"--max-sweeps {16 * sampling.sweeps} goes on until they have"
    if agreed.chains < 2:
        remedy = "take --chains 4"
    elif sampling.stopped == TIME_BUDGET:
        remedy = "raise --time-budget"
    return f"the chains have not converged {after(sampling)}: {agreed.doubt}; {remedy}"


def after(sampling: Sampling) -> str:
    """After how many sweeps, and whether time ran out."""
    budget = ", where the time budget was used up" * (sampling.stopped == TIME_BUDGET)
    return f"after {sampling.sweeps:,} sweeps{budget}"


def known(value: float | None, form: str) -> str:
    """A number in a format, or that there is none."""
    return "undefined" if value is None else format(value, form)
