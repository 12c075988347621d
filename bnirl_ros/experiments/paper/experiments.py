"""The experiments of section 4: which algorithms run on which scenario, how often and how long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from bnirl_ros.experiments.paper.courses import (
    ALGORITHMS,
    BNIRL,
    Course,
    Found,
    Parameters,
    course_of,
)
from bnirl_ros.experiments.paper.trials import trial_of
from bnirl_ros.experiments.scenarios import (
    PAPER_FEATURES,
    PAPER_GRID,
    PAPER_LOOP,
    RewardScenario,
    Scenario,
)

RUNS = 25
"""Of every experiment, as in the paper."""

ITERATIONS = 100
"""Of every algorithm in a run; a Gibbs iteration is a sweep."""

LAST = 10
"""Iterations at the end over whose mean an algorithm's final loss is taken."""


@dataclass(frozen=True)
class Experiment:
    """Some algorithms, each on so many demonstrations of a scenario.

    Attributes:
        scenario: what is demonstrated.
        algorithms: names from `ALGORITHMS`.
        parameters: of the paper's model.
        runs: number of demonstrations; run r, from 0, is the same for all algorithms.
        iterations: of each algorithm.
    """

    scenario: Scenario | RewardScenario
    algorithms: tuple[str, ...]
    parameters: Parameters = field(default_factory=Parameters)
    runs: int = RUNS
    iterations: int = ITERATIONS

    @property
    def jobs(self) -> list[Job]:
        """One for each algorithm and run, algorithm by algorithm."""
        return [
            Job(
                self.scenario,
                name,
                run,
                self.iterations,
                # What it does not depend on must not tell it from another job.
                self.parameters if name in BNIRL else Parameters(),
            )
            for name in self.algorithms
            for run in range(self.runs)
        ]


@dataclass(frozen=True)
class Job:
    """One algorithm on one demonstration; equal jobs have equal courses.

    Attributes:
        scenario, algorithm, iterations, parameters: as in `Experiment`.
        run: number of the demonstration.
    """

    scenario: Scenario | RewardScenario
    algorithm: str
    run: int
    iterations: int
    parameters: Parameters


def run_job(job: Job) -> Course:
    """The course of a job; all that is by chance follows from its run and its algorithm."""
    return course_of(
        job.algorithm,
        trial_of(job.scenario, job.run),
        job.iterations,
        generator_of(job.run, job.algorithm),
        job.parameters,
    )


def generator_of(run: int, algorithm: str) -> np.random.Generator:
    """The source of an algorithm's randomness in a run."""
    return np.random.default_rng([run, ALGORITHMS.index(algorithm)])


@dataclass(frozen=True, eq=False)
class Outcome:
    """All courses of an experiment.

    Attributes:
        experiment: what was run.
        courses: by algorithm, in the order of the runs.
    """

    experiment: Experiment
    courses: Mapping[str, Sequence[Course]]

    @classmethod
    def of(cls, experiment: Experiment, courses: Mapping[Job, Course]) -> Outcome:
        """From the courses of the experiment's jobs, others among them or not."""
        by_algorithm: dict[str, list[Course]] = {name: [] for name in experiment.algorithms}
        for job in experiment.jobs:
            by_algorithm[job.algorithm].append(courses[job])
        return cls(experiment, by_algorithm)

    def losses(self, algorithm: str) -> npt.NDArray[np.float64]:
        """(runs, T + 1) 0-1 loss at each iteration."""
        return np.stack([course.loss for course in self.courses[algorithm]])

    def final_losses(self, algorithm: str) -> npt.NDArray[np.float64]:
        """(runs,) 0-1 loss after the last iteration.

        That of a single iteration says little of an algorithm that goes up and down, so it is the
        mean over the last `LAST` of them.
        """
        return np.asarray(self.losses(algorithm)[:, 1:][:, -LAST:].mean(axis=1))

    def observations(self) -> float:
        """Mean number of observations of a run."""
        courses = next(iter(self.courses.values()))
        return float(np.mean([course.observations for course in courses]))

    def found(self, algorithm: str) -> list[Found]:
        """What the paper's method found in each run."""
        return [course.found for course in self.courses[algorithm] if course.found is not None]


SECTIONS: dict[str, Experiment] = {
    "4.1": Experiment(PAPER_GRID, ("BN-IRL State",)),
    "4.2": Experiment(PAPER_FEATURES, ALGORITHMS),
    "4.3": Experiment(PAPER_LOOP, ALGORITHMS),
}
"""The experiments by section of the paper."""


def variants(algorithms: Sequence[str]) -> list[str]:
    """Those of some algorithms that are the paper's method."""
    return [name for name in algorithms if name in BNIRL]


def rivals(algorithms: Sequence[str]) -> list[str]:
    """Those that are not."""
    return [name for name in algorithms if name not in BNIRL]
