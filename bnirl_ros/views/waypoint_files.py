"""Waypoints as files: as Nav2's RViz panel saves and loads them, and as GeoJSON.

The YAML file is that of the panel's buttons to save and to load waypoints, and tells the frame,
too, which the panel leaves out:

    frame_id: map
    waypoints:
      waypoint0:
        pose: [x, y, z]            # [m]
        orientation: [w, x, y, z]
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bnirl_ros.errors import InputError
from bnirl_ros.maps.datum import Datum
from bnirl_ros.maps.map_file import as_number, read_keys
from bnirl_ros.views.messages import Point, Pose, Quaternion
from bnirl_ros.views.results import write_whole
from bnirl_ros.views.waypoints import Visits, Waypoints, waypoints_of

PANEL_FRAME = "map"
"""The frame in which Nav2's RViz panel takes all waypoints of a file to be."""

_REMEDY = "save it with bnirl waypoints or Nav2's RViz panel"


def write_waypoints(folder: Path, visits: Visits, datum: Datum | None = None) -> list[Path]:
    """Write waypoints.yaml and waypoints.geojson, each whole or not at all; returns their paths.

    Args:
        folder: made where it is not there.
        visits: at least one.
        datum: where the map frame lies on the earth; None: GeoJSON in metres of the map frame.

    Raises:
        InputError: the folder cannot be written to.
    """
    texts = {
        "waypoints.yaml": waypoints_yaml(waypoints_of(visits)),
        "waypoints.geojson": json.dumps(waypoints_geojson(visits, datum), indent=2) + "\n",
    }

    def writer(text: str) -> Any:
        return lambda path: path.write_text(text, encoding="utf-8")

    return write_whole(folder, {name: writer(text) for name, text in texts.items()})


def waypoints_yaml(waypoints: Waypoints) -> str:
    """The content of waypoints.yaml; no digit of a number is lost."""
    import yaml

    content = {
        "frame_id": waypoints.frame_id,
        "waypoints": {
            f"waypoint{number}": {
                "pose": [pose.position.x, pose.position.y, pose.position.z],
                "orientation": [
                    pose.orientation.w,
                    pose.orientation.x,
                    pose.orientation.y,
                    pose.orientation.z,
                ],
            }
            for number, pose in enumerate(waypoints.poses)
        },
    }
    # None: lists of numbers on one line, everything else on lines of its own.
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=math.inf)
    return text


def read_waypoints(file: Path) -> Waypoints:
    """The waypoints in a file of `bnirl waypoints` or of Nav2's RViz panel, in their order there.

    Where the file tells no frame they are in that of the panel.

    Raises:
        InputError: the file cannot be read, or holds no waypoints; names what is wrong.
    """
    content = read_keys(file, _REMEDY, "waypoints are under the key 'waypoints'")
    frame_id = content.get("frame_id", PANEL_FRAME)
    if not isinstance(frame_id, str) or not frame_id:
        raise InputError(f"{file}: 'frame_id' is {frame_id!r}; it must be the name of a frame")
    entries = content.get("waypoints")
    if not isinstance(entries, Mapping) or not entries:
        raise InputError(f"{file}: has no waypoints under the key 'waypoints'; {_REMEDY}")
    return Waypoints(
        frame_id, tuple(_pose_in(entry, f"{file}: {name}") for name, entry in entries.items())
    )


def _pose_in(entry: Any, source: str) -> Pose:
    """The pose that an entry of the file tells; `source` is for the error's sentence."""
    x, y, z = _numbers_in(entry, "pose", "[x, y, z]", source)
    turn = _numbers_in(entry, "orientation", "[w, x, y, z]", source)
    if abs(math.hypot(*turn) - 1.0) > 1e-3:
        raise InputError(f"{source}: 'orientation' is {turn}; it must be of length 1")
    w, turn_x, turn_y, turn_z = turn
    return Pose(Point(x, y, z), Quaternion(turn_x, turn_y, turn_z, w))


def _numbers_in(entry: Any, key: str, form: str, source: str) -> list[float]:
    """As many finite numbers as the form has."""
    value = entry.get(key) if isinstance(entry, Mapping) else None
    numbers = [as_number(item) for item in value] if isinstance(value, list) else []
    if len(numbers) != len(form.split(",")) or any(math.isnan(number) for number in numbers):
        raise InputError(f"{source}: {key!r} is {value!r}; it must be finite numbers, {form}")
    return numbers


def waypoints_geojson(visits: Visits, datum: Datum | None = None) -> dict[str, Any]:
    """The content of waypoints.geojson: a Point for each waypoint, and their way as LineString.

    The way leads back to the first waypoint where the visits go round; one waypoint has none.
    RFC 7946 wants longitude and latitude, and its section 4 admits other coordinates by prior
    arrangement: without a datum they are metres in the map frame, and `datum` is null. `heading`
    [rad] is counter-clockwise from the first coordinate's axis: x of the frame, or east.

    Args:
        visits: the subgoals in the order visited.
        datum: where the map frame lies on the earth.
    """
    positions = np.array([subgoal.position for subgoal in visits.subgoals]).reshape(-1, 2)
    coordinates = positions if datum is None else datum.on_earth(positions)
    yaw = 0.0 if datum is None else datum.yaw
    places: list[list[float]] = coordinates.tolist()
    points = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": place},
            "properties": {
                "order": order,
                "rank": subgoal.rank,
                **({"name": subgoal.name} if subgoal.name else {}),
                "probability": subgoal.probability,
                **({} if subgoal.pursuits is None else {"pursuits": subgoal.pursuits}),
                "visit_order": list(subgoal.visit_order),
                "heading": math.remainder(heading + yaw, 2.0 * math.pi),
            },
        }
        for order, (subgoal, heading, place) in enumerate(
            zip(visits.subgoals, visits.headings, places, strict=True), start=1
        )
    ]
    way = {
        "type": "Feature",
        "geometry": {
            "type": "LineString",
            "coordinates": places + places[:1] * visits.go_round,
        },
        "properties": {"goes_round": visits.go_round},
    }
    return {
        "type": "FeatureCollection",
        "frame_id": visits.frame_id,
        "datum": None
        if datum is None
        else {"latitude": datum.latitude, "longitude": datum.longitude, "yaw": datum.yaw},
        "features": [*points, *([way] if len(places) > 1 else [])],
    }
