"""Table 1: what initialisation and an iteration of each algorithm take.

Measured on the demonstrations of section 4.2, in one process on one core while nothing else of
ours runs, after a first time that compiles the kernels. All algorithms solve their MDPs with the
same kernels.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from bnirl_ros.experiments.machine import machine, one_core
from bnirl_ros.experiments.paper.courses import BNIRL, Parameters, mixture_of, rival_of
from bnirl_ros.experiments.paper.experiments import Experiment, generator_of
from bnirl_ros.experiments.paper.runs import Progress
from bnirl_ros.experiments.paper.trials import Trial, candidate_subgoals, trial_of
from bnirl_ros.inference import partition_gibbs

PAPER: dict[str, tuple[float, float]] = {
    "BN-IRL State": (15.3, 0.21),
    "Abbeel IRL": (0.42, 1.65),
    "MaxMargin IRL": (0.41, 1.16),
    "Bayesian IRL": (0.56, 3.27),
}
"""The paper's seconds for initialisation and for an iteration; it has one row for its method."""

RUNS = 5
"""Demonstrations on which times are measured."""

REPETITIONS = 5
"""How often initialisation, and the method's iterations, are measured on each of them."""


@dataclass(frozen=True)
class Cost:
    """What an algorithm takes, the median over demonstrations and repetitions.

    Attributes:
        algorithm: its name.
        initialisation: [s].
        iteration: one that finds a new answer [s].
        iterations: all of them, one after the other, on one demonstration [s].
        new_answers: how many of the iterations found a new answer; an algorithm that has ended
            finds none.
    """

    algorithm: str
    initialisation: float
    iteration: float
    iterations: float
    new_answers: float


@dataclass(frozen=True)
class Table1:
    """The table, and where it was measured.

    Attributes:
        costs: by algorithm.
        iterations: how many `Cost.iterations` are.
        machine: processor, cores, and versions.
    """

    costs: Mapping[str, Cost]
    iterations: int
    machine: str


def measure(experiment: Experiment, progress: Progress | None = None) -> Table1:
    """Time the algorithms of an experiment on its first demonstrations.

    Args:
        experiment: that of section 4.2.
        progress: told of demonstrations as they are done with, for each algorithm.
    """
    trials = [trial_of(experiment.scenario, run) for run in range(min(RUNS, experiment.runs))]
    costs = {}
    with one_core():
        for name in experiment.algorithms:
            _time(trials[0], name, 0, experiment, 1)  # compiles
            times = []
            for run, trial in enumerate(trials):
                times.append(_time(trial, name, run, experiment, REPETITIONS))
                if progress:
                    progress(1)
            costs[name] = Cost(name, *np.median(times, axis=0).tolist())
    return Table1(costs, experiment.iterations, machine())


def _time(
    trial: Trial, name: str, run: int, experiment: Experiment, repetitions: int
) -> tuple[float, float, float, float]:
    """Initialisation, an iteration, all iterations [s], and how many found a new answer."""
    if name in BNIRL:
        return _time_bnirl(trial, name, run, experiment, repetitions)
    return _time_rival(trial, name, run, experiment, repetitions)


def _time_bnirl(
    trial: Trial, name: str, run: int, experiment: Experiment, repetitions: int
) -> tuple[float, float, float, float]:
    def initialise() -> tuple[Any, Any]:
        mixture = _prepared(trial, BNIRL[name], experiment.parameters)
        return mixture, partition_gibbs.initial_state(mixture, generator_of(run, name))

    first, (mixture, _) = _median_time(initialise, repetitions)
    draws = partition_gibbs.room_for(mixture, (experiment.iterations,))

    def iterate() -> None:
        state = partition_gibbs.initial_state(mixture, generator_of(run, name))
        partition_gibbs.advance(mixture, state, generator_of(run, name), draws)

    all_sweeps, _ = _median_time(iterate, repetitions)
    count = experiment.iterations
    return first, all_sweeps / count, all_sweeps, float(count)


def _prepared(trial: Trial, variant: str, parameters: Parameters) -> Any:
    """The model with all that its sampler keeps of it."""
    mixture = mixture_of(trial, candidate_subgoals(trial, variant), parameters)
    _ = mixture.new_partition_weight  # found when first asked for
    return mixture


def _time_rival(
    trial: Trial, name: str, run: int, experiment: Experiment, repetitions: int
) -> tuple[float, float, float, float]:
    first, _ = _median_time(lambda: rival_of(trial, name, generator_of(run, name)), repetitions)
    rival = rival_of(trial, name, generator_of(run, name))
    answers, times = [], [time.perf_counter()]
    for _ in range(experiment.iterations):
        answers.append(rival.iterate())
        times.append(time.perf_counter())
    taken = np.diff(times)
    new = np.array([True, *(after is not before for before, after in pairwise(answers))])
    return first, float(np.median(taken[new])), float(taken.sum()), float(new.sum())


def _median_time(run: Callable[[], Any], repetitions: int) -> tuple[float, Any]:
    """Median seconds that a function takes, and its last result."""
    taken = []
    result = None
    for _ in range(repetitions):
        start = time.perf_counter()
        result = run()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken)), result


def header(table: Table1) -> tuple[str, ...]:
    """Names of the columns of `rows`."""
    return (
        "algorithm",
        "initialisation [s]",
        "iteration [s]",
        f"initialisation and {table.iterations} iterations [s]",
        "initialisation, paper [s]",
        "iteration, paper [s]",
    )


def rows(table: Table1) -> list[tuple[str, ...]]:
    """A row for each algorithm, with the paper's figures where it has some."""
    result = []
    for name, cost in table.costs.items():
        paper = [f"{seconds:g}" for seconds in PAPER[name]] if name in PAPER else ["", ""]
        total = cost.initialisation + cost.iterations
        ours = [f"{seconds:.2g}" for seconds in (cost.initialisation, cost.iteration, total)]
        result.append((name, *ours, *paper))
    return result


def rival_costs(table: Table1) -> Sequence[Cost]:
    """Those of the algorithms that are not the paper's."""
    return [cost for name, cost in table.costs.items() if name not in BNIRL]


def variant_costs(table: Table1) -> Sequence[Cost]:
    """Those of the variants of the paper's method."""
    return [cost for name, cost in table.costs.items() if name in BNIRL]
