"""`bnirl infer` on several demonstrations: in one posterior or in one each, by many workers."""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bnirl_ros.cli.inference import in_spite_of, inferred, map_of, print_rate, reading_of, told
from bnirl_ros.cli.terminal import progress_bar, say, warn
from bnirl_ros.errors import InputError
from bnirl_ros.limits import one_or_more

if TYPE_CHECKING:
    from bnirl_ros.fleet.account import Account
    from bnirl_ros.fleet.inferring import Inferred
    from bnirl_ros.fleet.reading import Placed, Reading, Remark, Taken
    from bnirl_ros.fleet.work import Answers, Value, Work
    from bnirl_ros.inference.settings import Settings
    from bnirl_ros.maps import FeatureLayer


def add_many(parser: argparse.ArgumentParser) -> None:
    """The options for several demonstrations."""
    group = parser.add_argument_group(
        "several demonstrations",
        "their episodes are pooled into one posterior; a summary tells what became of each",
    )
    group.add_argument(
        "--each",
        action="store_true",
        help="infer from each by itself, with results in a folder of its own",
    )
    group.add_argument(
        "--jobs",
        type=one_or_more,
        metavar="JOBS",
        help="how many are worked on at the same time, each in a process; the results are the "
        "same (as many as there are cores)",
    )
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the Dask cluster with this scheduler, such as tcp://192.168.1.7:8786; its "
        "workers must find every DEMO at the same path",
    )


def infer_many(
    options: argparse.Namespace, settings: Settings, remappings: Mapping[str, str]
) -> int:
    """`bnirl infer` on several demonstrations; returns the exit status."""
    from bnirl_ros.bags.sources import STANDARD_INPUT
    from bnirl_ros.fleet.account import account_table, write_account
    from bnirl_ros.maps import load_features
    from bnirl_ros.views.results import check_writable

    paths: list[Path] = options.demonstrations
    resolved = [path.resolve() for path in paths]
    for number, path in enumerate(resolved):
        if path in resolved[:number]:
            options.command.error(f"{paths[number]}: is named twice; name each DEMO once")
    if STANDARD_INPUT in paths:
        options.command.error("-: workers have no standard input; infer from it alone")
    if options.jobs and options.scheduler:
        options.command.error("--jobs: is for this machine; leave it out with --scheduler")
    reading = reading_of(options, settings, remappings, map_of(options, paths))
    features = load_features(options.features) if options.features else None
    check_writable(options.out)
    gc.enable()  # this may run for long
    infer_from_all = _infer_each if options.each else _infer_pooled
    accounts, written = infer_from_all(options, settings, reading, features)
    written += write_account(options.out, accounts, pooled=not options.each)
    say(account_table(accounts, pooled=not options.each))
    say(f"Written: {', '.join(str(file) for file in written)}")
    status = 0
    for account in accounts:
        fault = account.error or (account.damage and in_spite_of(account.damage))
        if fault:
            warn(fault)
            status = 1
    return status


def _infer_each(
    options: argparse.Namespace,
    settings: Settings,
    reading: Reading,
    features: FeatureLayer | None,
) -> tuple[list[Account], list[Path]]:
    """What became of each, and the folders with their results."""
    from bnirl_ros.fleet.account import Account, names_of
    from bnirl_ros.fleet.inferring import infer_from
    from bnirl_ros.fleet.processes import cores
    from bnirl_ros.views.results import write_contents

    paths: list[Path] = options.demonstrations
    names = names_of(paths)
    # A worker of a cluster does as many tasks at the same time as it was given threads.
    threads = 1 if options.scheduler else max(1, cores() // _jobs(options))
    accounts = [Account(str(path)) for path in paths]

    def take_in(number: int, found: Inferred) -> None:
        write_contents(options.out / names[number], found.files)
        accounts[number] = replace(
            accounts[number],
            folder=names[number],
            episodes=found.episodes,
            observations=found.observations,
            subgoals=found.subgoals,
            rhat=found.rhat,
            ess=found.ess,
            converged=found.converged,
            left_out=found.left_out,
            damage=found.damage,
        )

    work = partial(
        infer_from,
        reading=reading,
        settings=settings,
        features=features,
        threads=threads,
        report=options.report,
    )
    for number, error in _work_off(work, options, "Inferring", take_in).items():
        accounts[number] = replace(accounts[number], error=error)
    return accounts, [options.out / account.folder for account in accounts if account.folder]


def _infer_pooled(
    options: argparse.Namespace,
    settings: Settings,
    reading: Reading,
    features: FeatureLayer | None,
) -> tuple[list[Account], list[Path]]:
    """What became of each, and the result files of the one posterior."""
    from bnirl_ros.fleet.account import Account
    from bnirl_ros.fleet.pooling import common_map, joined
    from bnirl_ros.fleet.reading import put, take
    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.maps import with_features
    from bnirl_ros.views.report import title_of
    from bnirl_ros.views.results import write_results
    from bnirl_ros.views.tables import report

    paths: list[Path] = options.demonstrations
    accounts = [Account(str(path)) for path in paths]
    taken: dict[int, Taken] = {}

    def take_in(number: int, found: Taken) -> None:
        # Equal maps, of which each came by itself, are kept once.
        known = next(iter(taken.values()), found).grid_map
        same = known.is_same_as(found.grid_map)
        taken[number] = replace(found, grid_map=known) if same else found

    errors = _work_off(partial(take, reading=reading), options, "Reading", take_in)
    in_order = [number for number in range(len(paths)) if number in taken]
    placed: dict[int, Placed] = {}
    if in_order:
        grid_map = common_map([taken[number] for number in in_order])
    for number in in_order:
        try:
            placed[number] = put(taken.pop(number), grid_map, settings.moves, told)
        except InputError as error:
            errors[number] = str(error)
    for number, words in errors.items():
        accounts[number] = replace(accounts[number], error=words)
    if not placed:
        for number in sorted(errors):
            warn(errors[number])
        raise InputError(f"none of the {len(paths)} demonstrations can be used")

    demonstration = joined([each.demonstration for each in placed.values()])
    if features:
        grid_map = with_features(grid_map, features)
    posterior = inferred(demonstration, grid_map, settings)
    summary = summarise(posterior, grid_map)
    title = title_of([paths[number] for number in placed]) if options.report else None
    written = write_results(options.out, posterior, summary, grid_map, settings, title)
    say(report(summary))
    print_rate(posterior)
    start = 0
    for number, each in placed.items():
        rows = slice(start, start + len(each.demonstration))
        start = rows.stop
        accounts[number] = replace(
            accounts[number],
            first_episode=int(demonstration.episode[rows.start]),
            episodes=int(each.demonstration.starts.sum()),
            observations=len(each.demonstration),
            subgoals=len({*summary.rank_of[rows].tolist()} - {0}),
            left_out=each.left_out,
            damage=each.damage,
        )
    return accounts, written


def _work_off(
    work: Work[Value],
    options: argparse.Namespace,
    doing: str,
    take_in: Callable[[int, Value], None],
) -> dict[int, str]:
    """Do the work with all demonstrations, and say what there is to say, in their order.

    Args:
        work: what to do with each.
        options: tell the demonstrations, and where to work.
        doing: the work in a word.
        take_in: given the number of each demonstration and what came of it, as soon as it is done.

    Returns:
        Why nothing came of a demonstration, by its number.
    """
    paths: list[Path] = options.demonstrations
    answers: Answers[Value]
    if options.scheduler:
        from bnirl_ros.fleet.cluster import on_cluster

        answers = on_cluster(work, [path.absolute() for path in paths], options.scheduler)
    else:
        from bnirl_ros.fleet.processes import in_processes

        answers = in_processes(work, paths, _jobs(options))
    remarks: dict[int, Sequence[Remark]] = {}
    errors = {}
    with closing(answers), progress_bar(doing, len(paths), before="Starting") as progress:
        for number, answer in answers:
            remarks[number] = answer.remarks
            if answer.error:
                errors[number] = answer.error
            elif answer.value is not None:
                take_in(number, answer.value)
            if progress:
                progress(1)
    for number, path in enumerate(paths):
        for remark in remarks[number]:
            named = str(path) in remark.sentence
            told(remark if named else replace(remark, sentence=f"{path}: {remark.sentence}"))
    return errors


def _jobs(options: argparse.Namespace) -> int:
    """How many demonstrations are worked on at the same time on this machine."""
    from bnirl_ros.fleet.processes import cores

    return min(options.jobs or cores(), len(options.demonstrations))
