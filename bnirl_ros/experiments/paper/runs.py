"""Many independent jobs on all cores, with the same results whatever their number."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from bnirl_ros.fleet.processes import sparing_children

Job = TypeVar("Job")
Result = TypeVar("Result")

Progress = Callable[[int], None]
"""Told how many jobs were done since the last call."""


def run_all(
    run: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: int,
    progress: Progress | None = None,
) -> list[Result]:
    """The results of all jobs, in their order.

    Args:
        run: a function of a module, which takes all that is by chance from the job itself.
        jobs: what can be sent to another process.
        processes: how many run at the same time; with one, all run in this process.
        progress: told of jobs as they are done.
    """
    results: dict[int, Result] = {}
    if processes == 1:
        for number, job in enumerate(jobs):
            results[number] = run(job)
            if progress:
                progress(1)
        return list(results.values())
    # A process that was forked could inherit a lock from a thread that it does not have.
    executor = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))
    try:
        with sparing_children():
            numbers = {executor.submit(run, job): number for number, job in enumerate(jobs)}
        for done in as_completed(numbers):
            results[numbers[done]] = done.result()
            if progress:
                progress(1)
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():  # a job may take a while to its end
            child.terminate()
        raise
    executor.shutdown()
    return [results[number] for number in range(len(jobs))]
