"""`bnirl reproduce`: the paper's experiments, and what holds of what it says of them."""

from __future__ import annotations

import argparse
import gc
import os
from pathlib import Path
from typing import Any

from bnirl_ros.cli.terminal import progress_bar, say

REPRODUCIBLE = ("4.1", "4.2", "4.3", "table1", "all")
"""What can be asked for."""


def add(commands: Any) -> None:
    """The subcommand and its options."""
    parser = commands.add_parser("reproduce", help="run the paper's experiments again")
    from bnirl_ros.inference.settings import PAPER_PARAMETERS
    from bnirl_ros.limits import above_zero, one_or_more

    parser.description = (
        "Run the experiments of section 4 of Michini and How (2012) and the times of its Table 1, "
        "and tell what holds: on the terminal, and with figures and tables in reproduction.md."
    )
    parser.add_argument(
        "part",
        nargs="?",
        choices=REPRODUCIBLE,
        default="all",
        help="a section or the table (%(default)s)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("bnirl_out"), help="folder for the results (%(default)s)"
    )
    for name, what in (("alpha", "confidence of (7)"), ("eta", "concentration of (5)")):
        parser.add_argument(
            f"--{name}",
            type=above_zero,
            default=PAPER_PARAMETERS[name],
            help=f"{what}, above 0; the paper does not print it (%(default)s)",
        )
    parser.add_argument(
        "--runs", type=one_or_more, default=25, help="of each experiment (%(default)s)"
    )
    parser.add_argument(
        "--iterations", type=one_or_more, default=100, help="of each algorithm (%(default)s)"
    )
    parser.add_argument(
        "--jobs",
        type=one_or_more,
        default=os.cpu_count() or 1,
        help="how many run at the same time; the results are the same (%(default)s)",
    )
    parser.set_defaults(run=_reproduce, command=parser)


def _reproduce(options: argparse.Namespace) -> int:
    """`bnirl reproduce`: the paper's experiments, and what holds of what it says of them."""
    from bnirl_ros.experiments.paper.courses import Parameters
    from bnirl_ros.experiments.paper.page import files_of, short
    from bnirl_ros.experiments.paper.reproduce import PARTS, Plan, reproduce
    from bnirl_ros.views.results import check_writable

    check_writable(options.out)
    gc.enable()  # this may run for long
    plan = Plan(
        parts=PARTS if options.part == "all" else (options.part,),
        runs=options.runs,
        iterations=options.iterations,
        parameters=Parameters(options.alpha, options.eta),
        processes=options.jobs,
    )
    report = reproduce(plan, options.out, progress_bar)
    say(short(report.claims))
    say(f"Written: {', '.join(str(options.out / name) for name in files_of(report))}")
    return 0
