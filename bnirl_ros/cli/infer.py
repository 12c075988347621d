"""`bnirl infer`: from files to the three result files and a table."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from bnirl_ros.cli.inference import (
    DEMONSTRATION,
    add_inference,
    inferred,
    print_rate,
    read,
    remappings_of,
    settings_of,
    told_of,
)
from bnirl_ros.cli.many import add_many, infer_many
from bnirl_ros.cli.terminal import say


def add(commands: Any) -> None:
    """The subcommand and its options."""
    parser = commands.add_parser("infer", help="infer the subgoals of recorded demonstrations")
    parser.add_argument(
        "demonstrations",
        metavar="DEMO",
        nargs="+",
        type=Path,
        help=f"{DEMONSTRATION}; or a folder of bags; several are pooled into one posterior",
    )
    add_inference(parser)
    parser.add_argument(
        "--report", action="store_true", help="also write report.html, a page to hand round"
    )
    add_many(parser)
    parser.set_defaults(run=_infer, command=parser)


def _infer(options: argparse.Namespace) -> int:
    """`bnirl infer`: from files to the three result files and a table."""
    settings = settings_of(options.command, options)
    remappings = remappings_of(options.command, options.remap)

    from bnirl_ros.bags.several import bags_in

    options.demonstrations = [bag for path in options.demonstrations for bag in bags_in(path)]
    if len(options.demonstrations) > 1 or options.each or options.scheduler:
        return infer_many(options, settings, remappings)

    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.views.report import title_of
    from bnirl_ros.views.results import check_writable, write_results
    from bnirl_ros.views.tables import report

    (options.demonstration,) = options.demonstrations
    demonstration, grid_map, damage = read(options, settings, remappings)
    check_writable(options.out)
    posterior = inferred(demonstration, grid_map, settings)
    summary = summarise(posterior, grid_map)
    title = title_of(options.demonstrations) if options.report else None
    try:  # first what was found: to import what draws the picture takes longer than to infer
        say(report(summary))
        print_rate(posterior)
        sys.stdout.flush()
    finally:  # also where nobody reads on
        written = write_results(options.out, posterior, summary, grid_map, settings, title)
    say(f"Written: {', '.join(str(file) for file in written)}")
    return told_of(damage)
