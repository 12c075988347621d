"""`bnirl waypoints`: from subgoals.json to waypoints.yaml and waypoints.geojson."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from bnirl_ros.cli.terminal import say, warn
from bnirl_ros.errors import InputError


def add(commands: Any) -> None:
    """The subcommand and its options."""
    parser = commands.add_parser(
        "waypoints", help="write the subgoals as waypoints for Nav2, and as GeoJSON"
    )
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
        warn(
            f"{written[0]}: is in the frame {visits.frame_id}; Nav2's RViz panel, which reads no "
            f"frame, would take it to be in {PANEL_FRAME}"
        )
    say(f"Waypoints in the frame {visits.frame_id}: {len(visits.subgoals)}")
    say(f"Written: {', '.join(str(file) for file in written)}")
    return 0
