"""What came out, as files: the page, Table 1 as CSV and Markdown, and all numbers as JSON."""

from __future__ import annotations

import csv
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bnirl_ros.experiments.identifiability import DetourBin, detours
from bnirl_ros.experiments.paper import sensitivity, table1
from bnirl_ros.experiments.paper.claims import Claim, verdict
from bnirl_ros.experiments.paper.courses import Course, Parameters
from bnirl_ros.experiments.paper.experiments import LAST, Outcome, rivals, variants
from bnirl_ros.experiments.paper.figures import BAND, FIGURES
from bnirl_ros.experiments.paper.sensitivity import Variation
from bnirl_ros.experiments.paper.table1 import Table1
from bnirl_ros.experiments.scenarios import (
    PAPER_FEATURES,
    PAPER_GRID,
    PAPER_LOOP,
    SPLITS,
    TIE,
    Cell,
    Scenario,
    number_of,
)
from bnirl_ros.experiments.study.report import Table

PAGE = "reproduction.md"
NUMBERS = "reproduction.json"
TABLE_1 = "table_1"


@dataclass(frozen=True)
class Report:
    """All that came out.

    Attributes:
        claims: what the paper says, and whether it holds.
        outcomes: by section.
        variations: of each section, with what they came to.
        detours: how often the mode is exact from other starts of 4.1, by the detour that the first
            subgoal is from there.
        table1: the times, if they were measured.
        parameters: of the paper's model.
        machine: on which all was run.
        seconds: that all took.
    """

    claims: Sequence[Claim]
    outcomes: Mapping[str, Outcome]
    variations: Mapping[str, Sequence[tuple[Variation, Outcome]]]
    detours: Sequence[DetourBin]
    table1: Table1 | None
    parameters: Parameters
    machine: str
    seconds: float


def files_of(report: Report) -> list[str]:
    """Names of the files that a report is written to."""
    figures = [
        f"{FIGURES[section]}.{end}" for section in report.outcomes for end in ("pdf", "png")
    ]
    tables = [f"{TABLE_1}.{end}" for end in ("csv", "md")] if report.table1 else []
    return [PAGE, NUMBERS, *figures, *tables]


def write_page(report: Report, folder: Path) -> None:
    """Write the page and the tables; the figures are there already.

    Raises:
        OSError: a file cannot be written.
    """
    (folder / PAGE).write_text(page(report), encoding="utf-8")
    (folder / NUMBERS).write_text(json.dumps(numbers(report)) + "\n", encoding="utf-8")
    if report.table1:
        (folder / f"{TABLE_1}.md").write_text(_table_1(report.table1).markdown(), encoding="utf-8")
        with (folder / f"{TABLE_1}.csv").open("w", encoding="utf-8", newline="") as file:
            lines = csv.writer(file, lineterminator="\n")
            lines.writerow([*table1.header(report.table1), "machine"])
            for row in table1.rows(report.table1):
                lines.writerow([*row, report.table1.machine])


def short(claims: Sequence[Claim]) -> str:
    """The claims for the terminal, a line or two each; no newline at the end."""
    lines = []
    for claim in claims:
        head = f"{claim.section:8s} {'yes' if claim.holds else 'NO':4s}"
        lines += _wrapped(head, claim.statement)
        lines += _wrapped("", f"{claim.ours}; the paper: {claim.paper}")
        if not claim.holds:
            lines += _wrapped("", f"why: {claim.why}")
    return "\n".join([*lines, verdict(claims)])


def _wrapped(head: str, text: str) -> list[str]:
    """A text in lines of a terminal's width, indented, the first one after a head."""
    return textwrap.wrap(text, 96, initial_indent=f"{head:13s} ", subsequent_indent=" " * 14)


def page(report: Report) -> str:
    """The page as Markdown."""
    parts = [
        "# The paper's experiments again",
        "",
        "Section 4 and Table 1 of Michini and How, *Bayesian Nonparametric Inverse Reinforcement "
        "Learning* (2012), run by `bnirl reproduce`. Cells are numbered as in the paper, from 1.",
        "",
        f"{_settings(report)} Run on {report.machine}; it took {report.seconds:.0f} s.",
        "",
        _claims(report.claims),
        *(_section(section, outcome) for section, outcome in report.outcomes.items()),
    ]
    if report.table1:
        parts.append(_table_1(report.table1).markdown())
    if report.outcomes:
        parts.append(_choices(report).markdown())
    for section, measured in report.variations.items():
        parts.append(sensitivity.table_of(section, measured).markdown())
    if len(report.outcomes) > 1:
        parts.append(_alphas(report).markdown())
    if report.detours:
        parts.append(_detours(report.detours).markdown())
    scenarios = [
        outcome.experiment.scenario
        for outcome in report.outcomes.values()
        if isinstance(outcome.experiment.scenario, Scenario)
    ]
    if scenarios:
        parts.append(_true_detours(scenarios).markdown())
    return "\n".join(parts)


def _settings(report: Report) -> str:
    parameters = report.parameters
    experiment = next((outcome.experiment for outcome in report.outcomes.values()), None)
    much = (
        f"There are {experiment.runs} runs of {experiment.iterations} iterations each, with "
        if experiment
        else "The paper's method has "
    )
    return (
        f"{much}alpha {parameters.alpha:g}, eta {parameters.eta:g} and c 1. An iteration of the "
        "paper's method is a sweep of its Gibbs sampler, and its loss at an iteration is that of "
        "the best sample so far, the paper's empirical mode: each observation is held against the "
        "greedy actions for its own subgoal in that sample. The posterior mode is what coordinate "
        "ascent on the joint (10) reaches from the best of all samples, as `bnirl infer` reports "
        f"it. A final loss is the mean of the last {LAST} iterations."
    )


def _claims(claims: Sequence[Claim]) -> str:
    return Table(
        title=f"What the paper says: {verdict(claims)}",
        text="Where a statement does not hold, the last column says why, as far as the runs tell.",
        header=("section", "statement", "paper", "ours", "holds", "why not"),
        rows=tuple(
            (
                claim.section,
                claim.statement,
                claim.paper,
                claim.ours,
                "yes" if claim.holds else "**no**",
                claim.why,
            )
            for claim in claims
        ),
    ).markdown()


def _section(section: str, outcome: Outcome) -> str:
    experiment = outcome.experiment
    name = FIGURES[section]
    lines = [
        f"## Section {section}",
        "",
        f"![{name.replace('_', ' ')}]({name}.png)",
        "",
        f"Observations of run 1, a dot for staying, and the 0-1 policy loss: the mean of "
        f"{experiment.runs} runs, with a band of {BAND:g} standard errors to either side."
        + (
            " Below, the subgoals of run 1, boxed, and the observations assigned to each: in the "
            "best sample, and in the posterior mode. A cross marks a true subgoal that is "
            "missing."
            if isinstance(experiment.scenario, Scenario)
            else ""
        )
        + f" The same as vectors: `{name}.pdf`.",
        "",
        _losses(section, outcome).markdown(),
    ]
    return "\n".join(lines)


def _losses(section: str, outcome: Outcome) -> Table:
    experiment = outcome.experiment
    shown = [t for t in (1, 2, 5, 10, 20, 50, 100) if t <= experiment.iterations]
    rows = []
    for name in experiment.algorithms:
        losses = outcome.losses(name)
        final = outcome.final_losses(name)
        rows.append(
            (
                name,
                *(f"{losses[:, t].mean():.1f}" for t in shown),
                f"{final.mean():.1f}",
                f"{final.std(ddof=1):.1f}" if len(final) > 1 else "",
            )
        )
    for name in variants(experiment.algorithms):
        of_mode = np.array([found.mode_loss for found in outcome.found(name)])
        spread = f"{of_mode.std(ddof=1):.1f}" if len(of_mode) > 1 else ""
        blank = [""] * len(shown)
        rows.append((f"{name}, posterior mode", *blank, f"{of_mode.mean():.1f}", spread))
    return Table(
        title=f"Section {section}: mean 0-1 loss of {outcome.observations():.0f} observations",
        text="By iteration, and the final loss with its standard deviation over the runs.",
        header=("algorithm", *map(str, shown), "final", "standard deviation"),
        rows=tuple(rows),
    )


def _table_1(table: Table1) -> Table:
    ended = ", ".join(
        f"{cost.algorithm} after {cost.new_answers:.0f}"
        for cost in table.costs.values()
        if cost.new_answers < table.iterations
    )
    return Table(
        title="Table 1: run times",
        text=f"Medians over demonstrations of section 4.2, on one core of: {table.machine}. "
        "The paper's were Matlab's, and its machine is not named. All algorithms solve their MDPs "
        "with the same kernels. An iteration is one that finds a new answer"
        + (f"; there are no more of {ended}." if ended else "."),
        header=table1.header(table),
        rows=tuple(table1.rows(table)),
    )


def _choices(report: Report) -> Table:
    success = PAPER_GRID.success
    return Table(
        title="What the paper does not print, and what we took",
        text="The tables below show what comes of other choices.",
        header=("what", "ours", "because"),
        rows=(
            ("alpha", f"{report.parameters.alpha:g}", "the default of `--model paper`"),
            ("eta", f"{report.parameters.eta:g}", "the default of `--model paper`"),
            ("c", "1", "only alpha c matters"),
            (
                "walls of 4.1 and 4.2",
                "as in Figure 3",
                "off the ways between the subgoals; those of 4.3 block the paper's (10, 12)",
            ),
            (
                "walls of 4.3",
                "as in Figure 5",
                "one off the ways, the others behind subgoals: these are then identifiable",
            ),
            (
                "where noise leads",
                f"the other actions, each with {(1 - success) / 8:.4f}",
                "the simplest; a step into a wall, or past its corner, stays",
            ),
            (
                "start of 4.1",
                _place(PAPER_GRID.start),
                "no subgoal is on the way to another one: see the last table",
            ),
            (
                "demonstrations of 4.1",
                f"{PAPER_GRID.episodes}",
                "about 50 observations, where the axis of the loss in Figure 3 ends",
            ),
            (
                "end of a demonstration of 4.1 and 4.3",
                f"arrival at {_place(PAPER_GRID.subgoals[-1])}, {_place(PAPER_LOOP.subgoals[-1])}",
                "no action is taken there",
            ),
            (
                "sites of 4.2",
                f"{PAPER_FEATURES.features} different free cells, drawn for each run",
                "any others would be a choice among many",
            ),
            ("weights of 4.2", f"{PAPER_FEATURES.weights}", "randomly chosen, says the paper"),
            (
                "0-1 loss",
                f"1 where the action is not within {TIE:g} of the best",
                "exact ties must not decide; rewards are scaled to a range of 1 before",
            ),
            (
                "(16) and (17)",
                "the product of the likelihoods",
                "the sum that is printed is not the conditional of the joint (10)",
            ),
        ),
    )


def _place(cell: Cell) -> str:
    """A cell in the paper's numbers."""
    return "({}, {})".format(*number_of(cell))


def _alphas(report: Report) -> Table:
    """The same as in the tables of other choices, alpha by alpha."""
    cells: dict[str, dict[str, str]] = {}
    for section, measured in report.variations.items():
        for variation, outcome in measured:
            if variation.choice != "alpha":
                continue
            row = cells.setdefault(variation.value, {})
            for name in variants(outcome.experiment.algorithms):
                row[f"{section} {name.removeprefix('BN-IRL ')}"] = _exact_or_loss(outcome, name)
    columns = list(dict.fromkeys(column for row in cells.values() for column in row))
    ours = f"{report.parameters.alpha:g}"
    best = [
        f"The best rival's loss in 4.2 is {_best_rival(outcome):.1f}."
        for section, outcome in report.outcomes.items()
        if section == "4.2"
    ]
    return Table(
        title="One alpha for all",
        text=" ".join(
            [
                "In how many runs the mode is exact, and in 4.2 the loss. A demonstrator that is "
                "always optimal calls for a large alpha. But the larger it is, the more often the "
                "same actions are as likely for a cell beside a subgoal: the joint (10) of both "
                "is then the same, and which one the mode has is by chance.",
                *best,
            ]
        ),
        header=("alpha", *columns),
        rows=tuple(
            (f"**{value}**" if value == ours else value, *(row.get(each, "") for each in columns))
            for value, row in cells.items()
        ),
    )


def _exact_or_loss(outcome: Outcome, name: str) -> str:
    if not isinstance(outcome.experiment.scenario, Scenario):
        return f"{outcome.final_losses(name).mean():.1f}"
    found = outcome.found(name)
    return f"{sum(each.mode_exact for each in found)} of {len(found)}"


def _best_rival(outcome: Outcome) -> float:
    names = rivals(outcome.experiment.algorithms)
    return min(float(outcome.final_losses(name).mean()) for name in names)


def _true_detours(scenarios: Sequence[Scenario]) -> Table:
    rows = []
    for scenario in scenarios:
        for split in SPLITS:
            found = detours(replace(scenario, split=split))
            told = [
                f"{_place(cell)} {steps:.1f}"
                for cell, steps in zip(scenario.subgoals, found, strict=True)
            ]
            value = f"**{split}**" if split == scenario.split else split
            rows.append((scenario.section, value, ", ".join(told)))
    return Table(
        title="What noise does to the way",
        text="How many steps longer the way to another subgoal is over each true subgoal than "
        "straight, at least, by where noise leads. Diagonal steps make many ways equally short. "
        "Where it is 0, the subgoal lies on one of them, and the mode can do without it.",
        header=("section", "noise", "subgoals and their detours [steps]"),
        rows=tuple(rows),
    )


def _detours(bins: Sequence[DetourBin]) -> Table:
    rows = []
    for bin_ in bins:
        high = f"to {bin_.high:g}" if math.isfinite(bin_.high) else "or more"
        share = f"{bin_.exact / bin_.demonstrations:.0%}" if bin_.demonstrations else ""
        rows.append(
            (
                f"{bin_.low:g} {high}",
                str(bin_.starts),
                str(bin_.demonstrations),
                str(bin_.exact),
                share,
            )
        )
    return Table(
        title="A true subgoal on the way to another one",
        text="Section 4.1 with one demonstration from cells all over the map, by how many steps "
        "longer the way to another subgoal is over (10, 12) than straight, at least. Who comes by "
        "(10, 12) on a shortest way does nothing that the other subgoal alone would not explain, "
        "and the mode leaves it out.",
        header=("detour [steps]", "starts", "demonstrations", "mode exact", "share"),
        rows=tuple(rows),
    )


def numbers(report: Report) -> dict[str, Any]:
    """What the page is made of, as JSON holds it."""
    return {
        "format": 1,
        "machine": report.machine,
        "seconds": report.seconds,
        "parameters": asdict(report.parameters),
        "claims": [asdict(claim) for claim in report.claims],
        "sections": {
            section: {
                name: [_course(course) for course in courses]
                for name, courses in outcome.courses.items()
            }
            for section, outcome in report.outcomes.items()
        },
        "table_1": [asdict(cost) for cost in report.table1.costs.values()]
        if report.table1
        else [],
    }


def _course(course: Course) -> dict[str, Any]:
    """A course as JSON holds it: what is not known is null."""
    loss = [None if math.isnan(value) else int(value) for value in course.loss.tolist()]
    document: dict[str, Any] = {
        "observations": course.observations,
        "loss": loss,
        "constant": course.constant,
    }
    if course.found is not None:
        found = asdict(course.found)
        found["sample_loss"] = course.found.sample_loss.tolist()
        cost = course.found.unmatched_cost
        document["found"] = found | {"unmatched_cost": None if math.isnan(cost) else cost}
    return document
