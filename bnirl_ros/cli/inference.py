"""What the commands that infer share: their options, and from these to a posterior."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from bnirl_ros.cli.terminal import progress_bar, say, warn
from bnirl_ros.errors import InputError

if TYPE_CHECKING:
    from bnirl_ros.demonstrations.demonstration import Demonstration
    from bnirl_ros.fleet.reading import Reading, Remark
    from bnirl_ros.inference.posterior import Posterior
    from bnirl_ros.inference.settings import Settings
    from bnirl_ros.maps.grid_map import GridMap

_Table = TypeVar("_Table", bound=Any)
"""A class of settings."""


DEMONSTRATION = "rosbag2 folder, .mcap file, also compressed, .csv, or - for a bag from a pipe"
"""What may be inferred from."""


def add_inference(parser: argparse.ArgumentParser) -> None:
    """Every option of an inference."""
    from bnirl_ros.demonstrations.discretising import Discretising
    from bnirl_ros.demonstrations.placement import EPISODE_GAP
    from bnirl_ros.inference.settings import Settings
    from bnirl_ros.limits import above_zero

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
    add_options(parser, Settings)
    parser.add_argument(
        "--episode-gap",
        type=above_zero,
        default=EPISODE_GAP,
        metavar="SECONDS",
        help="longest time between two poses of one episode (%(default)s)",
    )
    group = parser.add_argument_group(
        "a bag without pose and action",
        "where the robot was is taken from odometry, AMCL's or other stamped poses, tf, or "
        "velocity commands, and put on a planning map with larger cells",
    )
    add_options(group, Discretising)


def add_options(parser: argparse._ActionsContainer, table: type) -> None:
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


def settings_of(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Settings:
    from bnirl_ros.inference.settings import Settings

    return table_of(Settings, parser, options)


def table_of(
    table: type[_Table], parser: argparse.ArgumentParser, options: argparse.Namespace
) -> _Table:
    """What the options say of a table of settings."""
    values = {setting.name: getattr(options, setting.name) for setting in fields(table)}
    try:
        return table(**values)
    except InputError as error:
        parser.error(str(error))


def remappings_of(parser: argparse.ArgumentParser, rules: Sequence[str]) -> Mapping[str, str]:
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


def read(
    options: argparse.Namespace, settings: Settings, remappings: Mapping[str, str]
) -> tuple[Demonstration, GridMap, str | None]:
    """The demonstration, its map, and a sentence on damage to the file, if there is any."""
    from bnirl_ros.maps import load_features, with_features

    path: Path = options.demonstration
    given_map = map_of(options, [path])
    features = load_features(options.features) if options.features else None
    demonstration, grid_map, damage = placed(path, given_map, options, settings, remappings)
    return demonstration, with_features(grid_map, features) if features else grid_map, damage


def map_of(options: argparse.Namespace, paths: Sequence[Path]) -> GridMap | None:
    """The map that was given, if any; it has to be for a CSV file."""
    from bnirl_ros.fleet.reading import is_csv
    from bnirl_ros.maps import load_map

    if options.map:
        return load_map(options.map)
    for path in paths:
        if is_csv(path):
            options.command.error(f"{path}: a CSV file tells no map; give one with --map")
    return None


def placed(
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
    from bnirl_ros.fleet.reading import read

    reading = reading_of(options, settings, remappings, given_map, as_given)
    found = read(path, reading, told)
    return found.demonstration, found.grid_map, found.damage


def reading_of(
    options: argparse.Namespace,
    settings: Settings,
    remappings: Mapping[str, str],
    given_map: GridMap | None,
    as_given: bool = False,
) -> Reading:
    """How demonstrations are to be read, by the options."""
    from bnirl_ros.demonstrations.discretising import Discretising
    from bnirl_ros.fleet.reading import Reading

    return Reading(
        moves=settings.moves,
        discretising=table_of(Discretising, options.command, options),
        episode_gap=options.episode_gap,
        remappings=remappings,
        grid_map=given_map,
        as_given=as_given,
    )


def told(remark: Remark) -> None:
    """Say what there is to say of a demonstration that was read."""
    if remark.is_warning:
        warn(remark.sentence)
    else:
        say(remark.sentence)


def inferred(demonstration: Demonstration, grid_map: GridMap, settings: Settings) -> Posterior:
    """The posterior, with a progress bar on the way."""
    from bnirl_ros.inference.posterior import infer

    total = settings.sweeps * settings.chains
    with progress_bar("Sampling", total, before="Solving the goals") as progress:
        posterior = infer(demonstration, grid_map, settings, progress)
    if posterior.settings.thin != settings.thin:
        say(
            f"Kept one draw in {posterior.settings.thin} sweeps, so that the draws of "
            f"{len(demonstration)} observations fit into 1 GiB"
        )
    return posterior


def print_rate(posterior: Posterior) -> None:
    """Say how long the sweeps took, and how many effective samples came of that."""
    sampling, rate = posterior.sampling, posterior.ess_per_second
    words = f"{sampling.sweeps:,} sweeps took {sampling.seconds:.3g} s"
    if rate is not None:
        number = format(rate, ",.0f" if rate >= 10.0 else ".2g")
        words += f": {number} effective samples a second, of {posterior.convergence.ess_of}"
    say(words)


def told_of(damage: str | None) -> int:
    """Exit status 0, unless a file was damaged, which is told last."""
    if damage:
        raise InputError(in_spite_of(damage))
    return 0


def in_spite_of(damage: str) -> str:
    """The sentence on damage to a file that was used all the same."""
    return f"{damage}; the results are from what could be read"
