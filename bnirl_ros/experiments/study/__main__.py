"""The command: `python -m bnirl_ros.experiments.study`."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from bnirl_ros.errors import InputError
from bnirl_ros.experiments.overcooked import add_option
from bnirl_ros.experiments.study import (
    cost,
    intent,
    kitchens,
    next_action,
    reliability,
    robustness,
    turtle,
)
from bnirl_ros.experiments.study.part import Part

PARTS = {
    module.PART.name: module.PART
    for module in (turtle, kitchens, next_action, intent, robustness, reliability, cost)
}

_TELLS = 10  # lines of progress in a part


def run_part(part: Part, recordings: Path, jobs: int) -> list[dict[str, Any]]:
    """The results of all cases of a part, in their order, run in so many processes.

    Raises:
        InputError: something that it needs is missing.
    """
    cases = part.cases(recordings)
    processes = 1 if part.alone else min(jobs, len(cases))
    # A process that was forked could inherit a lock from a thread that it does not have.
    context = multiprocessing.get_context("spawn")
    results: list[dict[str, Any]] = []
    start = time.perf_counter()
    with ProcessPoolExecutor(processes, context) as executor:
        for result in executor.map(part.run, cases):
            results.append(result)
            if len(results) * _TELLS % len(cases) < _TELLS or len(results) == len(cases):
                passed = time.perf_counter() - start
                print(f"{part.name}: {len(results)} of {len(cases)}, {passed:.0f} s", flush=True)
    return results


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 where a part that was named has no data."""
    parser = argparse.ArgumentParser(
        prog="study", description="Measure how well the models find subgoals, in tables."
    )
    parser.add_argument(
        "--only",
        choices=list(PARTS),
        action="append",
        metavar="PART",
        help=f"this part, and others named so, rather than all of {', '.join(PARTS)}",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=os.cpu_count() or 1,
        help="how many cases run at the same time (%(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        default=Path("bnirl_out/study.md"),
        help="the tables; beside it, with the ending .json, goes what they are made of "
        "(%(default)s)",
    )
    add_option(parser, "; the parts that need it are left out without")
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"argument --jobs: must be at least 1, not {options.jobs}")
    tables, numbers, status = [], {}, 0
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for name in options.only or PARTS:
        try:
            results = run_part(PARTS[name], options.overcooked, options.jobs)
        except InputError as error:
            print(f"{name}: left out: {error}", file=sys.stderr)
            status = 1 if options.only else 0
            continue
        tables.append(PARTS[name].table(results).markdown())
        numbers[name] = results
        print(f"\n{tables[-1]}", flush=True)
        # After every part, so that nothing is lost when a later one is stopped.
        options.out.write_text("\n".join(tables), encoding="utf-8")
        options.out.with_suffix(".json").write_text(json.dumps(numbers), encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
