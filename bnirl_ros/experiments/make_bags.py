"""Make the bags that come with the package: `python -m bnirl_ros.experiments.make_bags`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from bnirl_ros.errors import InputError
from bnirl_ros.experiments import overcooked, turtle
from bnirl_ros.experiments.demonstration_bag import (
    bag_size,
    write_demonstration,
    write_what_fits,
)
from bnirl_ros.experiments.scenarios import PAPER_LOOP, Scenario, shipped_demonstration

SIMULATED_STEP = 0.5
"""Time between two actions of a simulated demonstrator [s]; the paper knows no seconds."""

SIMULATED = (PAPER_LOOP,)
"""Scenarios whose demonstration is made a bag."""

LAYOUTS = ("random3", "asymmetric_advantages")
"""Layouts of Overcooked-AI whose human play is made a bag."""

LICENCE_FILE = "LICENSE"


def make_scenario_bag(scenario: Scenario, out: Path) -> Path:
    """Write the bag of a scenario into the folder `out`; returns the bag."""
    bag = out / scenario.name
    demonstration = shipped_demonstration(scenario)
    write_demonstration(bag, demonstration, scenario.grid_map, SIMULATED_STEP)
    return bag


def make_overcooked_bag(source: Path, layout: str, out: Path) -> tuple[Path, int]:
    """Write the bag of a layout, and its licence, into the folder `out`.

    Args:
        source: folder with the recordings, see `overcooked.read_overcooked`.
        layout: its name there.
        out: where the bag `overcooked_<layout>` goes.

    Returns:
        The bag, and how many episodes fitted into it.

    Raises:
        InputError: the recordings are missing or wrong.
    """
    demonstration, grid_map = overcooked.read_overcooked(source, layout)
    bag = out / f"overcooked_{layout}"
    episodes = write_what_fits(bag, demonstration, grid_map, overcooked.STEP)
    (bag / LICENCE_FILE).write_text(overcooked.LICENCE, encoding="utf-8")
    return bag, episodes


def make_turtle_bag(source: Path, out: Path) -> Path:
    """Write the bag `turtle_waypoints`, and its licence, into the folder `out`; returns the bag.

    Args:
        source: folder with the recording and its `LICENSE`, see `turtle.read_turtle`.
        out: where the bag goes.

    Raises:
        InputError: the recording or its licence is missing or wrong.
    """
    demonstration, grid_map = turtle.read_turtle(source)
    licence = _licence_of_turtle(source)
    bag = out / "turtle_waypoints"
    write_demonstration(bag, demonstration, grid_map, turtle.STEP)
    (bag / LICENCE_FILE).write_text(turtle.NOTICE + licence, encoding="utf-8")
    return bag


def make_turtle_commands_bag(source: Path, out: Path) -> Path:
    """Write the bag `turtle_commands`, the recorded commands themselves, as `make_turtle_bag`."""
    licence = _licence_of_turtle(source)
    bag = out / "turtle_commands"
    turtle.copy_commands(source, bag)
    (bag / LICENCE_FILE).write_text(turtle.COMMANDS_NOTICE + licence, encoding="utf-8")
    return bag


def _licence_of_turtle(source: Path) -> str:
    """The licence of the recording, which has to be there."""
    licence = source / LICENCE_FILE
    try:
        return licence.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise InputError(
            f"{licence}: cannot be read; put the recording's licence there, it has to go with the "
            "bag"
        ) from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 for missing or wrong recordings."""
    parser = argparse.ArgumentParser(
        prog="make_bags", description="Make the bags that come with the package."
    )
    overcooked.add_option(parser)
    parser.add_argument(
        "--turtle",
        type=Path,
        metavar="FOLDER",
        default=Path("../shared/data/bags/turtle_waypoints"),
        help="recording of a driven turtlesim robot to convert (%(default)s)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("bags"), help="folder for the bags (%(default)s)"
    )
    options = parser.parse_args(arguments)
    try:
        for scenario in SIMULATED:
            bag = make_scenario_bag(scenario, options.out)
            print(f"{bag}: {scenario.episodes} episodes, {bag_size(bag)} bytes")
        for layout in LAYOUTS:
            bag, episodes = make_overcooked_bag(options.overcooked, layout, options.out)
            print(f"{bag}: {episodes} episodes, {bag_size(bag)} bytes")
        for make in (make_turtle_bag, make_turtle_commands_bag):
            bag = make(options.turtle, options.out)
            print(f"{bag}: 1 episode, {bag_size(bag)} bytes")
    except InputError as error:
        print(f"make_bags: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
