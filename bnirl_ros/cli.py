"""The `bnirl` command."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from bnirl_ros import __version__
from bnirl_ros.errors import InputError

if TYPE_CHECKING:  # what a command needs is imported when it runs, so that --help is quick
    from bnirl_ros.demonstrations.demonstration import Demonstration
    from bnirl_ros.inference.settings import Settings
    from bnirl_ros.maps.grid_map import GridMap


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 for bad input, 2 for wrong arguments."""
    # A command lives so short that collecting garbage, while libraries are imported and again at
    # the end, would be a fifth of its time.
    gc.disable()
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        if given[:1] == ["replay"]:  # its options are replay_node's, which argparse cannot know
            return _replay(given[1:])
        options = _parser().parse_args(given)
        return int(options.run(options))
    except InputError as error:
        print(f"bnirl: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("bnirl: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read our output, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    finally:
        gc.freeze()
        gc.enable()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bnirl", description="Tell what a demonstrator was going for."
    )
    parser.add_argument("--version", action="version", version=f"bnirl {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    from bnirl_ros.demonstrations.placement import EPISODE_GAP
    from bnirl_ros.inference.settings import above_zero

    infer = commands.add_parser("infer", help="infer the subgoals of a recorded demonstration")
    infer.add_argument(
        "demonstration", metavar="DEMO", type=Path, help="rosbag2 folder, .mcap file or .csv"
    )
    infer.add_argument(
        "--map", type=Path, help="Nav2 map .yaml or text grid .txt; wins over a map in the bag"
    )
    infer.add_argument(
        "--features",
        type=Path,
        help="labels (Nav2-style .yaml, .txt) or places (.yaml) of the map's cells: infer feature "
        "subgoals",
    )
    infer.add_argument(
        "--out", type=Path, default=Path("bnirl_out"), help="folder for the results (%(default)s)"
    )
    infer.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="a:=b",
        help="read the topic a (pose, action or map) from the recorded topic b",
    )
    _add_settings(infer)
    infer.add_argument(
        "--episode-gap",
        type=above_zero,
        default=EPISODE_GAP,
        metavar="SECONDS",
        help="longest time between two poses of one episode (%(default)s)",
    )
    infer.set_defaults(run=_infer, command=infer)

    commands.add_parser("replay", help="play a recorded demonstration onto its topics")

    demo = commands.add_parser("demo", help="watch a human demonstration become subgoals")
    demo.add_argument("--bag", type=Path, help="another bag than the human demonstration")
    demo.add_argument(
        "--out", type=Path, default=Path("bnirl_out"), help="folder for the results (%(default)s)"
    )
    demo.set_defaults(run=_demo)
    return parser


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """An option for every setting, with its range and default."""
    from bnirl_ros.inference.settings import Settings, kind_of, limits_of

    for setting in fields(Settings):
        limits = limits_of(setting)
        words = limits.range_in_words()
        parser.add_argument(
            "--" + setting.name.replace("_", "-"),
            type=kind_of(setting),
            default=setting.default,
            choices=limits.choices or None,
            metavar=None if limits.choices else setting.name.upper(),
            help=(f"{limits.description}{', ' * bool(words)}{words}").replace("%", "%%")
            + ("" if setting.default is None else " (%(default)s)"),
        )


def _settings(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Settings:
    from bnirl_ros.inference.settings import Settings

    values = {setting.name: getattr(options, setting.name) for setting in fields(Settings)}
    try:
        return Settings(**values)
    except InputError as error:
        parser.error(str(error))


def _remappings(parser: argparse.ArgumentParser, rules: Sequence[str]) -> Mapping[str, str]:
    """Recorded topic by the contract's name, from rules `a:=b`."""
    from bnirl_ros.demonstrations.messages import TOPIC_TYPES

    remappings = {}
    for rule in rules:
        name, separator, topic = rule.partition(":=")
        name = name.removeprefix("/")
        if not separator or not topic or name not in TOPIC_TYPES:
            parser.error(f"--remap {rule}: must be one of {', '.join(TOPIC_TYPES)}, then :=/topic")
        remappings[name] = topic
    return remappings


def _infer(options: argparse.Namespace) -> int:
    """`bnirl infer`: from a file to the three result files and a table."""
    settings = _settings(options.command, options)
    remappings = _remappings(options.command, options.remap)

    from bnirl_ros.inference.posterior import infer
    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.views.plot import import_matplotlib
    from bnirl_ros.views.results import check_writable, write_results
    from bnirl_ros.views.tables import report

    demonstration, grid_map, damage = _read(options, settings, remappings)
    check_writable(options.out)
    Thread(target=import_matplotlib, daemon=True).start()  # while the chains leave the GIL alone
    with ExitStack() as stack:
        progress = _progress(stack, settings.sweeps * settings.chains)
        posterior = infer(demonstration, grid_map, settings, progress)
    summary = summarise(posterior, grid_map)
    written = write_results(options.out, posterior, summary, grid_map, settings)
    print(report(summary))
    print(f"Written: {', '.join(str(file) for file in written)}")
    if damage:
        raise InputError(f"{damage}; the results are from what could be read")
    return 0


def _replay(arguments: Sequence[str]) -> int:
    """`bnirl replay`: the same as replay_node."""
    from bnirl_ros.nodes.start import require_ros

    require_ros()
    from bnirl_ros.nodes.replay_node import main as replay

    gc.enable()  # this may run for long
    return replay(arguments, "bnirl replay")


def _demo(options: argparse.Namespace) -> int:
    """`bnirl demo`: both nodes, a human bag, and what comes of it."""
    from bnirl_ros.nodes.start import require_ros

    require_ros()
    from bnirl_ros.nodes.demo import main as demo

    gc.enable()  # this may run for long
    return demo(options.bag, options.out)


def _read(
    options: argparse.Namespace, settings: Settings, remappings: Mapping[str, str]
) -> tuple[Demonstration, GridMap, str | None]:
    """The demonstration, its map, and a sentence on damage to the file, if there is any."""
    from bnirl_ros.maps import load_features, load_map, with_features

    path: Path = options.demonstration
    command: argparse.ArgumentParser = options.command
    given_map = load_map(options.map) if options.map else None
    features = load_features(options.features) if options.features else None
    if path.suffix.lower() == ".csv":
        from bnirl_ros.demonstrations.csv_file import read_csv

        if given_map is None:
            command.error(f"{path}: a CSV file tells no map; give one with --map")
        demonstration = read_csv(path, given_map, settings.moves)
        return demonstration, with_features(given_map, features) if features else given_map, None

    from bnirl_ros.bags.demonstration import read_demonstration
    from bnirl_ros.demonstrations.placement import place

    recorded = read_demonstration(path, remappings)
    grid_map = given_map or recorded.grid_map
    for warning in recorded.warnings:
        _warn(warning)
    if grid_map is None:
        reasons = "".join(f" ({fault})" for fault in recorded.faults if "map" in fault)
        raise InputError(f"{path}: has no map that can be used{reasons}; give one with --map")
    placement = place(recorded.recording, grid_map, settings.moves, options.episode_gap)
    for fault, count in (recorded.faults + placement.faults).items():
        _warn(f"{path}: left out {count} x {fault}")
    if len(placement.demonstration) == 0:
        raise InputError(
            f"{path}: {recorded.damage or 'no pose and action of equal stamps lie on the map'}; "
            "check its topics, their frame and the map"
        )
    if features:
        grid_map = with_features(grid_map, features)
    return placement.demonstration, grid_map, recorded.damage


def _progress(stack: ExitStack, total: int) -> Callable[[int], None] | None:
    """A progress bar on a terminal's standard error, told of sweeps; nothing elsewhere."""
    if not sys.stderr.isatty():
        return None
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    bar = stack.enter_context(
        Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            transient=True,
        )
    )
    task = bar.add_task("Solving the goals", total=None)

    def advance(sweeps: int) -> None:
        bar.update(task, description="Sampling", total=total, advance=sweeps)

    return advance


def _warn(sentence: str) -> None:
    print(f"bnirl: {sentence}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
