"""All that `bnirl reproduce` does: run, time, draw, and say what holds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

from bnirl_ros.baselines.abbeel_ng import solver
from bnirl_ros.experiments.identifiability import Start, by_detour, exact_modes, starts
from bnirl_ros.experiments.machine import machine
from bnirl_ros.experiments.paper import sensitivity, table1
from bnirl_ros.experiments.paper.claims import Claim, claims_of, claims_of_times
from bnirl_ros.experiments.paper.courses import Course, Parameters
from bnirl_ros.experiments.paper.experiments import (
    ITERATIONS,
    RUNS,
    SECTIONS,
    Experiment,
    Job,
    Outcome,
    run_job,
)
from bnirl_ros.experiments.paper.figures import draw_figure
from bnirl_ros.experiments.paper.page import Report, write_page
from bnirl_ros.experiments.paper.runs import Progress, run_all
from bnirl_ros.experiments.scenarios import Scenario
from bnirl_ros.inference.settings import Settings
from bnirl_ros.views.results import unwritable

PARTS = (*SECTIONS, "table1")
"""What can be reproduced by itself."""

_SEEDS_OF_STARTS = 10
_TIMED_SECTION = "4.2"

Watch = Callable[[str, int], AbstractContextManager[Progress | None]]
"""Shows progress: given what is done and of how many parts, while it lasts."""


@dataclass(frozen=True)
class Plan:
    """What to reproduce, and how.

    Attributes:
        parts: of `PARTS`.
        runs: of every experiment.
        iterations: of every algorithm.
        parameters: of the paper's model.
        processes: how many run at the same time.
    """

    parts: tuple[str, ...] = PARTS
    runs: int = RUNS
    iterations: int = ITERATIONS
    parameters: Parameters = field(default_factory=Parameters)
    processes: int = 1

    def experiment(self, section: str) -> Experiment:
        """The experiment of a section as it is planned."""
        return replace(
            SECTIONS[section],
            runs=self.runs,
            iterations=self.iterations,
            parameters=self.parameters,
        )

    @property
    def sections(self) -> tuple[str, ...]:
        """The sections among the parts."""
        return tuple(part for part in self.parts if part in SECTIONS)


def reproduce(plan: Plan, folder: Path, watch: Watch) -> Report:
    """Run what is planned, and write figures, tables and page into a folder.

    Raises:
        InputError: the solver of the rivals' quadratic programs is missing, or the folder cannot
            be written to.
    """
    if any(section != "4.1" for section in plan.parts):
        solver()
    began = time.perf_counter()
    experiments = {section: plan.experiment(section) for section in plan.sections}
    varied = {
        section: sensitivity.variations(section, experiment)
        for section, experiment in experiments.items()
    }
    begun_elsewhere = _starts(experiments["4.1"]) if "4.1" in experiments else []
    jobs = [
        job
        for section, experiment in experiments.items()
        for each in (experiment, *(variation.experiment for variation in varied[section]))
        for job in each.jobs
    ]
    courses, exact = _run(list(dict.fromkeys(jobs)), begun_elsewhere, plan.processes, watch)
    outcomes = {
        section: Outcome.of(experiment, courses) for section, experiment in experiments.items()
    }
    times = _times(plan, watch) if "table1" in plan.parts else None
    claims: list[Claim] = []
    for section, outcome in outcomes.items():
        claims += claims_of(section, outcome)
    if times:
        claims += claims_of_times(times)
    report = Report(
        claims=claims,
        outcomes=outcomes,
        variations={
            section: [(each, Outcome.of(each.experiment, courses)) for each in variations]
            for section, variations in varied.items()
        },
        detours=by_detour(begun_elsewhere, exact) if begun_elsewhere else (),
        table1=times,
        parameters=plan.parameters,
        machine=machine(),
        seconds=time.perf_counter() - began,
    )
    _write(report, folder)
    return report


def _starts(experiment: Experiment) -> list[Start]:
    """One demonstration of section 4.1 from each of many cells."""
    scenario = experiment.scenario
    assert isinstance(scenario, Scenario)
    settings = Settings(
        model="paper",
        alpha=experiment.parameters.alpha,
        eta=experiment.parameters.eta,
        sweeps=experiment.iterations,
        burn_in=0,
        chains=1,
    )
    return starts(scenario, min(_SEEDS_OF_STARTS, experiment.runs), settings)


def _run(
    jobs: Sequence[Job], elsewhere: Sequence[Start], processes: int, watch: Watch
) -> tuple[Mapping[Job, Course], list[int]]:
    """The courses of all jobs, and the counts of exact modes from other starts."""
    tasks: list[Job | Start] = [*jobs, *elsewhere]
    if not tasks:
        return {}, []
    courses: dict[Job, Course] = {}
    exact: list[int] = []
    with watch("Running the experiments", len(tasks)) as progress:
        for task, result in zip(tasks, run_all(run_task, tasks, processes, progress), strict=True):
            if isinstance(task, Job) and isinstance(result, Course):
                courses[task] = result
            elif isinstance(result, int):
                exact.append(result)
    return courses, exact


def run_task(task: Job | Start) -> Course | int:
    """Whatever a process is given to do."""
    return run_job(task) if isinstance(task, Job) else exact_modes(task)


def _times(plan: Plan, watch: Watch) -> table1.Table1:
    experiment = plan.experiment(_TIMED_SECTION)
    steps = min(table1.RUNS, experiment.runs) * len(experiment.algorithms)
    with watch("Timing the algorithms", steps) as progress:
        return table1.measure(experiment, progress)


def _write(report: Report, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for section, outcome in report.outcomes.items():
            draw_figure(section, outcome, folder)
        write_page(report, folder)
    except OSError as error:
        raise unwritable(folder, error) from error
