"""The `bnirl` command."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, TypeVar

from bnirl_ros import __version__
from bnirl_ros.errors import InputError

if TYPE_CHECKING:  # what a command needs is imported when it runs, so that --help is quick
    import numpy as np
    import numpy.typing as npt

    from bnirl_ros.demonstrations.demonstration import Demonstration
    from bnirl_ros.inference.posterior import Posterior
    from bnirl_ros.inference.scoring import Losses
    from bnirl_ros.inference.settings import Settings
    from bnirl_ros.maps.grid_map import GridMap
    from bnirl_ros.views.predictions import Foreseen


REPRODUCIBLE = ("4.1", "4.2", "4.3", "table1", "all")
"""What `bnirl reproduce` can be asked for."""


_Table = TypeVar("_Table", bound=Any)
"""A class of settings."""


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

    infer = commands.add_parser("infer", help="infer the subgoals of a recorded demonstration")
    _add_inference(infer)
    infer.set_defaults(run=_infer, command=infer)

    predict = commands.add_parser(
        "predict",
        help="foresee the actions of a demonstrator like the recorded one",
        description="Infer the subgoals of a recorded demonstration, and foresee with them: each "
        "action of others, given its episode so far, or what is done first by who begins in a "
        "cell.",
    )
    _add_inference(predict)
    foreseen = predict.add_mutually_exclusive_group()
    foreseen.add_argument(
        "--held-out",
        action="append",
        default=[],
        type=Path,
        metavar="OTHER",
        help="a demonstration on the same map (rosbag2 folder, .mcap or .csv), to foresee action "
        "by action and to measure how well; may be given several times",
    )
    foreseen.add_argument(
        "--cell",
        action="append",
        default=[],
        type=_cell,
        metavar="x,y",
        help="a cell to begin in; may be given several times (all visited cells; all free ones "
        "with --candidates free)",
    )
    predict.set_defaults(run=_predict, command=predict)

    _add_waypoints(
        commands.add_parser(
            "waypoints", help="write the subgoals as waypoints for Nav2, and as GeoJSON"
        )
    )

    _add_reproduce(commands.add_parser("reproduce", help="run the paper's experiments again"))

    commands.add_parser("replay", help="play a recorded demonstration onto its topics")

    demo = commands.add_parser("demo", help="watch a human demonstration become subgoals")
    demo.add_argument("--bag", type=Path, help="another bag than the human demonstration")
    demo.add_argument(
        "--out", type=Path, default=Path("bnirl_out"), help="folder for the results (%(default)s)"
    )
    demo.set_defaults(run=_demo)
    return parser


def _add_inference(parser: argparse.ArgumentParser) -> None:
    """What is inferred from, and every option of an inference."""
    from bnirl_ros.demonstrations.placement import EPISODE_GAP
    from bnirl_ros.limits import above_zero

    parser.add_argument(
        "demonstration", metavar="DEMO", type=Path, help="rosbag2 folder, .mcap file or .csv"
    )
    parser.add_argument(
        "--map", type=Path, help="Nav2 map .yaml or text grid .txt; wins over a map in the bag"
    )
    parser.add_argument(
        "--features",
        type=Path,
        help="labels (Nav2-style .yaml, .txt) or places (.yaml) of the map's cells: infer feature "
        "subgoals",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("bnirl_out"), help="folder for the results (%(default)s)"
    )
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="a:=b",
        help="read the topic a (pose, action or map) from the recorded topic b",
    )
    _add_settings(parser)
    parser.add_argument(
        "--episode-gap",
        type=above_zero,
        default=EPISODE_GAP,
        metavar="SECONDS",
        help="longest time between two poses of one episode (%(default)s)",
    )
    _add_discretising(parser)


def _add_waypoints(parser: argparse.ArgumentParser) -> None:
    """The options of `bnirl waypoints`."""
    parser.description = (
        "Write the subgoals in the order in which they were visited, each heading for the next: "
        "waypoints.yaml, which Nav2's RViz panel and subgoal_node load, and waypoints.geojson."
    )
    parser.add_argument(
        "subgoals", metavar="SUBGOALS_JSON", type=Path, help="the subgoals.json of an inference"
    )
    parser.add_argument("--out", type=Path, help="folder for the files (that of SUBGOALS_JSON)")
    parser.add_argument(
        "--datum",
        nargs=3,
        type=float,
        metavar=("LAT", "LON", "YAW"),
        help="latitude and longitude [degrees] of the map frame's origin, and its x axis "
        "counter-clockwise from east [rad]: write longitudes and latitudes into waypoints.geojson "
        "(metres of the map frame)",
    )
    parser.set_defaults(run=_waypoints, command=parser)


def _add_reproduce(parser: argparse.ArgumentParser) -> None:
    """The options of `bnirl reproduce`."""
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


def _cell(text: str) -> tuple[int, int]:
    """A cell `x,y` from the command line."""
    try:
        x, y = map(int, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be x,y, two whole numbers such as 3,1, not {text!r}"
        ) from None
    return x, y


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """An option for every setting of the inference."""
    from bnirl_ros.inference.settings import Settings

    _add_options(parser, Settings)


def _add_discretising(parser: argparse.ArgumentParser) -> None:
    """An option for every setting by which a raw bag becomes a demonstration."""
    from bnirl_ros.demonstrations.discretising import Discretising

    group = parser.add_argument_group(
        "a bag without pose and action",
        "where the robot was is taken from odometry, AMCL's or other stamped poses, tf, or "
        "velocity commands, and put on a planning map with larger cells",
    )
    _add_options(group, Discretising)


def _add_options(parser: argparse._ActionsContainer, table: type) -> None:
    """An option for every field of a table of settings, with its range and default."""
    from bnirl_ros.limits import kind_of, limits_of

    for setting in fields(table):
        limits = limits_of(setting)
        words = limits.range_in_words()
        parser.add_argument(
            "--" + setting.name.replace("_", "-"),
            type=kind_of(setting),
            default=setting.default,
            choices=limits.choices or None,
            metavar=None if limits.choices else setting.name.upper(),
            help=(f"{limits.description}{', ' * bool(words)}{words}").replace("%", "%%")
            + ("" if setting.default in (None, "") else " (%(default)s)"),
        )


def _settings(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Settings:
    from bnirl_ros.inference.settings import Settings

    return _table(Settings, parser, options)


def _table(
    table: type[_Table], parser: argparse.ArgumentParser, options: argparse.Namespace
) -> _Table:
    """What the options say of a table of settings."""
    values = {setting.name: getattr(options, setting.name) for setting in fields(table)}
    try:
        return table(**values)
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

    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.views.map_panel import import_matplotlib
    from bnirl_ros.views.results import check_writable, write_results
    from bnirl_ros.views.tables import report

    demonstration, grid_map, damage = _read(options, settings, remappings)
    check_writable(options.out)
    Thread(target=import_matplotlib, daemon=True).start()  # while the chains leave the GIL alone
    posterior = _inferred(demonstration, grid_map, settings)
    summary = summarise(posterior, grid_map)
    written = write_results(options.out, posterior, summary, grid_map, settings)
    print(report(summary))
    print(f"Written: {', '.join(str(file) for file in written)}")
    return _told_of(damage)


def _predict(options: argparse.Namespace) -> int:
    """`bnirl predict`: from a file to predictions.csv and a table."""
    settings = _settings(options.command, options)
    remappings = _remappings(options.command, options.remap)

    from bnirl_ros.inference.prediction import beginning_in
    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.views.predictions import cell_table, loss_table, write_predictions
    from bnirl_ros.views.results import check_writable
    from bnirl_ros.views.tables import convergence

    demonstration, grid_map, damage = _read(options, settings, remappings)
    for cell in options.cell:
        if fault := grid_map.fault_of(cell):
            raise InputError(f"--cell: {fault}; choose a free one")
    others = []
    for path in options.held_out:
        if path.resolve() == options.demonstration.resolve():
            _warn(f"{path}: is what was learnt from; how well it is foreseen tells little")
        held_out, _, also_damaged = _placed(path, grid_map, options, settings, remappings, True)
        others.append((str(path), held_out))
        damage = damage or also_damaged
    check_writable(options.out)
    posterior = _inferred(demonstration, grid_map, settings)
    if not others:
        cells = options.cell or _places_to_begin(posterior, grid_map)
        others = [("", beginning_in(cells))]
    everything = [_foreseen(posterior, *other, grid_map) for other in others]
    written = write_predictions(options.out, everything, posterior.candidates)
    if options.held_out:
        print(loss_table(_losses(posterior, everything, grid_map)))
        print(_how_much(everything))
    else:
        print(cell_table(everything[0], posterior.candidates, grid_map))
    print(f"learnt from {convergence(summarise(posterior, grid_map))}")
    print(f"Written: {', '.join(str(file) for file in written)}")
    return _told_of(damage)


def _waypoints(options: argparse.Namespace) -> int:
    """`bnirl waypoints`: from subgoals.json to waypoints.yaml and waypoints.geojson."""
    from bnirl_ros.maps.datum import Datum
    from bnirl_ros.views.results import read_visits
    from bnirl_ros.views.waypoint_files import PANEL_FRAME, write_waypoints

    try:
        datum = Datum(*options.datum) if options.datum else None
    except InputError as error:
        options.command.error(f"argument --{error}")
    visits = read_visits(options.subgoals)
    out: Path = options.out or options.subgoals.parent
    written = write_waypoints(out, visits, datum)
    if visits.frame_id != PANEL_FRAME:
        _warn(
            f"{written[0]}: is in the frame {visits.frame_id}; Nav2's RViz panel, which reads no "
            f"frame, would take it to be in {PANEL_FRAME}"
        )
    print(f"Waypoints in the frame {visits.frame_id}: {len(visits.subgoals)}")
    print(f"Written: {', '.join(str(file) for file in written)}")
    return 0


def _foreseen(
    posterior: Posterior, source: str, demonstration: Demonstration, grid_map: GridMap
) -> Foreseen:
    from bnirl_ros.inference.prediction import predict
    from bnirl_ros.views.predictions import Foreseen

    try:
        return Foreseen(source, demonstration, predict(posterior, demonstration, grid_map))
    except InputError as error:
        raise InputError(f"{source or '--cell'}: {error}") from None


def _places_to_begin(posterior: Posterior, grid_map: GridMap) -> npt.NDArray[np.int64]:
    """(U, 2) the visited cells, or the free ones where these are candidates."""
    import numpy as np

    from bnirl_ros.inference.posterior import grid_world

    world = grid_world(grid_map, posterior.settings)
    visited = posterior.demonstration.cells, posterior.demonstration.last_cells
    states = np.unique(world.states_of(np.concatenate(visited)))
    if posterior.settings.candidates == "free":
        states = np.flatnonzero(world.free)
    # Cells without features may be in a part of the map that has no candidate.
    return world.cells_of(states[posterior.candidates.reachable_from(world, states)])


def _losses(
    posterior: Posterior, everything: Sequence[Foreseen], grid_map: GridMap
) -> dict[str, Losses]:
    """What each prediction loses at all that was held out, by its name."""
    import numpy as np

    from bnirl_ros.inference.posterior import grid_world
    from bnirl_ros.inference.prediction import predict_from_mode
    from bnirl_ros.inference.scoring import WITHOUT_MODEL, Losses, losses

    world = grid_world(grid_map, posterior.settings)
    lost: dict[str, list[Losses]] = {}
    for each in everything:
        other = each.demonstration
        foreseen = {
            "predictive": each.prediction.probability,
            "likeliest subgoal (19)": predict_from_mode(posterior, other, grid_map).probability,
        }
        for name, prediction in WITHOUT_MODEL.items():
            foreseen[name] = prediction(posterior.demonstration, other, world)
        for name, probability in foreseen.items():
            lost.setdefault(name, []).append(losses(probability, other, world))
    return {
        name: Losses(
            log=np.concatenate([part.log for part in parts]),
            zero_one=np.concatenate([part.zero_one for part in parts]),
        )
        for name, parts in lost.items()
    }


def _how_much(everything: Sequence[Foreseen]) -> str:
    """One line on what was held out."""
    actions = sum(len(each.demonstration) for each in everything)
    episodes = sum(int(each.demonstration.starts.sum()) for each in everything)
    return f"{actions} actions in {episodes} episodes held out; a blocked move counts as staying"


def _inferred(demonstration: Demonstration, grid_map: GridMap, settings: Settings) -> Posterior:
    """The posterior, with a progress bar on the way."""
    from bnirl_ros.inference.posterior import infer

    total = settings.sweeps * settings.chains
    with _progress("Sampling", total, before="Solving the goals") as progress:
        return infer(demonstration, grid_map, settings, progress)


def _told_of(damage: str | None) -> int:
    """Exit status 0, unless a file was damaged, which is told last."""
    if damage:
        raise InputError(f"{damage}; the results are from what could be read")
    return 0


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
    report = reproduce(plan, options.out, _progress)
    print(short(report.claims))
    print(f"Written: {', '.join(str(options.out / name) for name in files_of(report))}")
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
    given_map = load_map(options.map) if options.map else None
    features = load_features(options.features) if options.features else None
    if given_map is None and _is_csv(path):
        options.command.error(f"{path}: a CSV file tells no map; give one with --map")
    demonstration, grid_map, damage = _placed(path, given_map, options, settings, remappings)
    return demonstration, with_features(grid_map, features) if features else grid_map, damage


def _is_csv(path: Path) -> bool:
    return path.suffix.lower() == ".csv"


def _placed(
    path: Path,
    given_map: GridMap | None,
    options: argparse.Namespace,
    settings: Settings,
    remappings: Mapping[str, str],
    as_given: bool = False,
) -> tuple[Demonstration, GridMap, str | None]:
    """A demonstration on a given map, or the bag's own; the map; and a sentence on damage.

    A raw bag is put on a planning map that is made of the given one, unless that is to be taken
    as given.
    """
    if given_map is not None and _is_csv(path):
        from bnirl_ros.demonstrations.csv_file import read_csv

        return read_csv(path, given_map, settings.moves), given_map, None

    from bnirl_ros.bags.demonstration import read_demonstration
    from bnirl_ros.bags.raw_demonstration import is_raw, read_raw_demonstration
    from bnirl_ros.demonstrations.discretising import Discretising
    from bnirl_ros.demonstrations.placement import place

    discretising = _table(Discretising, options.command, options)
    episode_gap = options.episode_gap
    if is_raw(path, discretising, remappings):
        recorded, words = read_raw_demonstration(
            path, discretising, given_map, settings.moves, remappings.get("map", "map")
        )
        print(f"Discretised: {words}")
        grid_map = given_map if as_given else recorded.grid_map
        episode_gap = discretising.longest_silence
    else:
        recorded = read_demonstration(path, remappings)
        grid_map = given_map or recorded.grid_map
    for warning in recorded.warnings:
        _warn(warning)
    if grid_map is None:
        reasons = "".join(f" ({fault})" for fault in recorded.faults if "map" in fault)
        raise InputError(f"{path}: has no map that can be used{reasons}; give one with --map")
    placement = place(recorded.recording, grid_map, settings.moves, episode_gap)
    for fault, count in (recorded.faults + placement.faults).items():
        _warn(f"{path}: left out {count} x {fault}")
    if len(placement.demonstration) == 0:
        raise InputError(
            f"{path}: {recorded.damage or 'no pose and action of equal stamps lie on the map'}; "
            "check its topics, their frame and the map"
        )
    return placement.demonstration, grid_map, recorded.damage


@contextmanager
def _progress(
    doing: str, total: int, before: str | None = None
) -> Iterator[Callable[[int], None] | None]:
    """A progress bar on a terminal's standard error; nothing elsewhere.

    Args:
        doing: what is done.
        total: in how many steps; whoever does it tells how many more are done.
        before: what is done until the first ones are, if that is something else.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task(before or doing, total=None if before else total)

        def advance(steps: int) -> None:
            bar.update(task, description=doing, total=total, advance=steps)

        yield advance


def _warn(sentence: str) -> None:
    print(f"bnirl: {sentence}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
