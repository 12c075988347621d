"""Waypoints as files: `bnirl waypoints`, what it writes, and the way back from a file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from bnirl_ros import cli
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.errors import InputError
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Subgoal, Summary, summarise
from bnirl_ros.maps import GridMap, load_features, with_features
from bnirl_ros.maps.datum import Datum
from bnirl_ros.views.messages import Point, Pose, Quaternion
from bnirl_ros.views.results import subgoals_document
from bnirl_ros.views.waypoint_files import read_waypoints, waypoints_geojson, waypoints_yaml
from bnirl_ros.views.waypoints import Visits, Waypoints, path_of, waypoint_path, waypoints_of
from demonstration_support import CORNERS, MAP, map_of_grid, walk, write_bag

STAMP = 12_345_678_901
SETTINGS = Settings(sweeps=60, burn_in=20, chains=2)
TURNED = replace(MAP, resolution=0.3, origin=(-7.1, 2.3, 0.6))
"""A map whose cells have no round places in the frame."""

Infer = Callable[..., tuple[Path, Summary, GridMap]]


@pytest.fixture
def inferred(tmp_path: Path) -> Infer:
    """Infer from a walk; returns the subgoals.json, the summary and the map."""

    def of_walk(
        rounds: int = 1, features: Path | None = None, **changed: Any
    ) -> tuple[Path, Summary, GridMap]:
        bag = write_bag(tmp_path / "walk", [map_of_grid(TURNED), *walk(rounds, grid_map=TURNED)])
        recorded = read_demonstration(bag, {})
        assert recorded.grid_map is not None
        grid_map = recorded.grid_map
        if features:
            grid_map = with_features(grid_map, load_features(features))
        settings = replace(SETTINGS, **changed)
        demonstration = place(recorded.recording, grid_map).demonstration
        summary = summarise(infer(demonstration, grid_map, settings), grid_map)
        path = tmp_path / "subgoals.json"
        path.write_text(json.dumps(subgoals_document(summary, grid_map, settings)))
        return path, summary, grid_map

    return of_walk


def subgoal(rank: int, x: float, y: float, **fields: Any) -> Subgoal:
    return Subgoal(rank, (0, 0), (x, y), 0.75, 3, (rank,), **fields)


L_SHAPED = Visits("map", (subgoal(2, 0.0, 0.0), subgoal(1, 3.0, 0.0), subgoal(3, 3.0, 4.0)))


def yaw_of(pose: Pose) -> float:
    assert (pose.orientation.x, pose.orientation.y) == (0.0, 0.0)
    return 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)


# The poses


@pytest.mark.parametrize(
    ("go_round", "last"), [(False, math.pi / 2), (True, math.atan2(-4.0, -3.0))]
)
def test_each_pose_heads_for_the_next_and_the_last_on_or_for_the_first(
    go_round: bool, last: float
) -> None:
    poses = waypoints_of(replace(L_SHAPED, go_round=go_round)).poses
    assert [(pose.position.x, pose.position.y) for pose in poses] == [(0, 0), (3, 0), (3, 4)]
    assert [yaw_of(pose) for pose in poses] == pytest.approx([0.0, math.pi / 2, last])


@pytest.mark.parametrize("model", ["sequential", "paper"])
@pytest.mark.parametrize("rounds", [1, 3])
def test_the_file_has_the_poses_of_the_topic(inferred: Infer, model: str, rounds: int) -> None:
    path, summary, grid_map = inferred(rounds, model=model)
    assert len(summary.visit_sequence) >= len(CORNERS)
    assert (summary.repetitions > 1) == (model == "sequential" and rounds > 1)
    assert cli.main(["waypoints", str(path)]) == 0
    waypoints = read_waypoints(path.parent / "waypoints.yaml")
    assert path_of(waypoints, STAMP) == waypoint_path(summary, grid_map, STAMP)


def test_feature_subgoals_are_waypoints_in_the_middle_of_their_cells(
    inferred: Infer, tmp_path: Path
) -> None:
    rooms = np.add.outer(2 * (np.arange(7) > 3), np.arange(7) > 3)  # one in each quarter
    np.savetxt(tmp_path / "rooms.txt", rooms[::-1], fmt="%d")
    path, summary, grid_map = inferred(2, tmp_path / "rooms.txt")
    assert all(subgoal.feature for subgoal in summary.subgoals)
    assert len(summary.visit_sequence) >= 2
    assert cli.main(["waypoints", str(path)]) == 0
    waypoints = read_waypoints(tmp_path / "waypoints.yaml")
    assert path_of(waypoints, STAMP) == waypoint_path(summary, grid_map, STAMP)


# The YAML file


def test_the_yaml_is_what_navs_panel_saves_and_tells_the_frame() -> None:
    half = math.sqrt(0.5)
    content = yaml.safe_load(waypoints_yaml(waypoints_of(L_SHAPED)))
    assert list(content) == ["frame_id", "waypoints"]
    assert content["frame_id"] == "map"
    assert list(content["waypoints"]) == ["waypoint0", "waypoint1", "waypoint2"]
    assert content["waypoints"]["waypoint0"] == {
        "pose": [0.0, 0.0, 0.0],
        "orientation": [1.0, 0.0, 0.0, 0.0],
    }
    assert content["waypoints"]["waypoint2"]["pose"] == [3.0, 4.0, 0.0]
    assert content["waypoints"]["waypoint2"]["orientation"] == pytest.approx([half, 0, 0, half])


def test_the_yaml_is_read_back_to_the_last_digit_and_written_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    places = rng.normal(size=(20, 3)) * 10.0 ** rng.integers(-20, 6, (20, 1))
    turns = rng.normal(size=(20, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    poses = tuple(
        Pose(Point(*place), Quaternion(*turn))
        for place, turn in zip(places.tolist(), turns.tolist(), strict=True)
    )
    for frame_id in ("map", "robot_1/map", "1.5", "no"):
        text = waypoints_yaml(Waypoints(frame_id, poses))
        (tmp_path / "waypoints.yaml").write_text(text)
        again = read_waypoints(tmp_path / "waypoints.yaml")
        assert again == Waypoints(frame_id, poses)
        assert waypoints_yaml(again) == text


def test_a_file_of_the_panel_itself_is_read_in_its_order(tmp_path: Path) -> None:
    # As yaml-cpp writes it: no frame, and numbers that YAML 1.1 would take for text.
    (tmp_path / "saved.yaml").write_text(
        "waypoints:\n"
        "  waypoint0:\n"
        "    pose:\n      - 1.5\n      - -2\n      - 0\n"
        "    orientation:\n      - 0.70710678\n      - 0\n      - 0\n      - -0.70710678\n"
        + "".join(
            f"  waypoint{number}:\n    pose: [{number}, 1e-16, 0]\n    orientation: [1, 0, 0, 0]\n"
            for number in range(1, 12)
        )
    )
    waypoints = read_waypoints(tmp_path / "saved.yaml")
    assert waypoints.frame_id == "map"
    first, *others = waypoints.poses
    assert first == Pose(Point(1.5, -2.0, 0.0), Quaternion(0.0, 0.0, -0.70710678, 0.70710678))
    assert [pose.position for pose in others] == [Point(n, 1e-16, 0.0) for n in range(1, 12)]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("[", "this is not valid YAML at line 2"),
        ("a word", "this YAML holds no keys"),
        ("frame_id: map", "has no waypoints under the key 'waypoints'"),
        ("waypoints: {}", "has no waypoints under the key 'waypoints'"),
        ("waypoints: [1, 2]", "has no waypoints under the key 'waypoints'"),
        ("frame_id: 5\nwaypoints: {}", "'frame_id' is 5; it must be the name of a frame"),
        ("waypoints: {a: [1, 2, 0]}", "a: 'pose' is None; it must be finite numbers, [x, y, z]"),
        ("waypoints: {a: {pose: [1, 2]}}", "a: 'pose' is [1, 2]; it must be finite numbers"),
        ("waypoints: {a: {pose: [1, 2, x]}}", "a: 'pose' is [1, 2, 'x']; it must be finite"),
        ("waypoints: {a: {pose: [1, .nan, 0]}}", "a: 'pose' is [1, nan, 0]; it must be finite"),
        (
            "waypoints: {a: {pose: [1, 2, 0], orientation: [0, 0, 1]}}",
            "a: 'orientation' is [0, 0, 1]; it must be finite numbers, [w, x, y, z]",
        ),
        (
            "waypoints: {a: {pose: [1, 2, 0], orientation: [0, 0, 0, 0]}}",
            "a: 'orientation' is [0.0, 0.0, 0.0, 0.0]; it must be of length 1",
        ),
    ],
)
def test_what_is_no_waypoint_file_is_refused_with_a_sentence(
    tmp_path: Path, content: str, sentence: str
) -> None:
    path = tmp_path / "waypoints.yaml"
    path.write_text(content)
    with pytest.raises(InputError) as refused:
        read_waypoints(path)
    assert str(refused.value).startswith(f"{path}: {sentence}")
    assert "\n" not in str(refused.value)


def test_a_waypoint_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: the file cannot be read \(No such file"):
        read_waypoints(tmp_path / "none.yaml")


# GeoJSON


def check_geojson(document: dict[str, Any]) -> None:
    """What RFC 7946 demands of a collection of Points and LineStrings."""
    assert document["type"] == "FeatureCollection"
    # A collection must not have these (section 7.1).
    assert not {"coordinates", "geometries", "geometry", "properties"} & set(document)
    for feature in document["features"]:
        assert feature["type"] == "Feature"
        assert isinstance(feature["properties"], dict)
        assert set(feature["geometry"]) == {"type", "coordinates"}
        places = feature["geometry"]["coordinates"]
        if feature["geometry"]["type"] == "Point":
            places = [places]
        else:
            assert feature["geometry"]["type"] == "LineString"
            assert len(places) >= 2
        assert all(len(place) == 2 for place in places)
        assert all(math.isfinite(number) for place in places for number in place)


def test_geojson_without_a_datum_is_in_metres_of_the_frame(inferred: Infer) -> None:
    path, summary, grid_map = inferred(3)
    assert cli.main(["waypoints", str(path)]) == 0
    document = json.loads((path.parent / "waypoints.geojson").read_text())
    check_geojson(document)
    assert (document["frame_id"], document["datum"]) == ("map", None)
    *points, way = document["features"]
    poses = [each.pose for each in waypoint_path(summary, grid_map, STAMP).poses]
    places = [[pose.position.x, pose.position.y] for pose in poses]
    assert [point["geometry"]["coordinates"] for point in points] == places
    assert way["geometry"]["coordinates"] == [*places, places[0]]
    assert way["properties"] == {"goes_round": True}
    told = [point["properties"] for point in points]
    # Half a turn to the left is half a turn to the right.
    assert [math.cos(each["heading"]) for each in told] == pytest.approx(
        [math.cos(yaw_of(pose)) for pose in poses]
    )
    assert [math.sin(each["heading"]) for each in told] == pytest.approx(
        [math.sin(yaw_of(pose)) for pose in poses]
    )
    of_rank = {each.rank: each for each in summary.subgoals}
    for order, each in enumerate(told, start=1):
        found = of_rank[each["rank"]]
        assert each["order"] == order
        assert each["probability"] == found.probability
        assert each["pursuits"] == found.pursuits
        assert each["visit_order"] == list(found.visit_order)


def test_geojson_of_one_waypoint_has_no_way_and_of_a_room_its_name() -> None:
    alone = Visits("map", (subgoal(1, 3.0, 4.0, name="kitchen"),))
    document = waypoints_geojson(alone)
    check_geojson(document)
    (point,) = document["features"]
    assert point["properties"]["name"] == "kitchen"
    assert "pursuits" not in point["properties"]
    assert point["properties"]["heading"] == 0.0
    way = waypoints_geojson(L_SHAPED)["features"][-1]
    assert way["geometry"]["coordinates"] == [[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]


def test_geojson_with_a_datum_is_in_degrees_and_heads_from_east() -> None:
    # The x axis of the map points to the south, on the southern hemisphere.
    datum = Datum(-33.0, 151.0, -math.pi / 2)
    document = waypoints_geojson(L_SHAPED, datum)
    check_geojson(document)
    assert document["datum"] == {"latitude": -33.0, "longitude": 151.0, "yaw": -math.pi / 2}
    first, south, east, _ = document["features"]
    assert first["geometry"]["coordinates"] == pytest.approx([151.0, -33.0])
    longitude, latitude = south["geometry"]["coordinates"]
    assert (longitude, latitude) == (pytest.approx(151.0), pytest.approx(-33.0 - 3 / 110_905))
    assert east["geometry"]["coordinates"][0] > 151.0
    assert first["properties"]["heading"] == pytest.approx(-math.pi / 2)
    assert south["properties"]["heading"] == pytest.approx(0.0)


# The earth


def in_space(latitude: float, longitude: float, height: float) -> np.ndarray:
    """Earth-centred coordinates [m] of a place on WGS 84, by their definition."""
    a, b = 6_378_137.0, 6_356_752.314245
    phi, lam = math.radians(latitude), math.radians(longitude)
    normal = a**2 / math.hypot(a * math.cos(phi), b * math.sin(phi))
    return np.array(
        [
            (normal + height) * math.cos(phi) * math.cos(lam),
            (normal + height) * math.cos(phi) * math.sin(lam),
            (normal * b**2 / a**2 + height) * math.sin(phi),
        ]
    )


@pytest.mark.parametrize("latitude", [0.0, 48.1, -77.8, 89.999])
@pytest.mark.parametrize("longitude", [0.0, 11.6, -179.9999])
def test_places_on_the_map_are_where_the_tangent_plane_has_them(
    latitude: float, longitude: float
) -> None:
    yaw = 0.7
    rng = np.random.default_rng(1)
    positions = rng.uniform(-2000.0, 2000.0, (50, 2))
    found = Datum(latitude, longitude, yaw).on_earth(positions)
    origin = in_space(latitude, longitude, 0.0)
    up = in_space(latitude, longitude, 1.0) - origin
    lam = math.radians(longitude)
    east = np.array([-math.sin(lam), math.cos(lam), 0.0])
    north = np.cross(up, east)
    for (x, y), (lon, lat) in zip(positions, found, strict=True):
        assert abs(lon) <= 180.0
        ground = in_space(lat, lon, 0.0)
        above = in_space(lat, lon, 1.0) - ground
        expected = origin + (math.cos(yaw) * x - math.sin(yaw) * y) * east
        expected = expected + (math.sin(yaw) * x + math.cos(yaw) * y) * north
        # Straight above the place found, less than a metre high.
        off = expected - ground
        assert 0.0 <= off @ above + 1e-6 < 1.0
        assert np.linalg.norm(off - (off @ above) * above) < 1e-5


def test_a_degree_has_the_length_that_tables_give() -> None:
    # WGS 84 at 45 degrees: 111,131.8 m along the meridian, 78,846.8 m along the parallel.
    ((longitude, latitude),) = Datum(45.0, 10.0, 0.0).on_earth([[78.8468, 111.1318]]).tolist()
    assert longitude - 10.0 == pytest.approx(0.001, abs=1e-7)
    assert latitude - 45.0 == pytest.approx(0.001, abs=1e-8)


# The command


def test_the_files_go_where_they_are_wanted(
    inferred: Infer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, summary, _ = inferred()
    out = tmp_path / "a" / "b"
    assert cli.main(["waypoints", str(path), "--out", str(out)]) == 0
    assert {each.name for each in out.iterdir()} == {"waypoints.yaml", "waypoints.geojson"}
    assert not (tmp_path / "waypoints.yaml").exists()
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out == (
        f"Waypoints in the frame map: {len(summary.visit_sequence)}\n"
        f"Written: {out / 'waypoints.yaml'}, {out / 'waypoints.geojson'}\n"
    )


def test_the_datum_reaches_the_file(inferred: Infer, tmp_path: Path) -> None:
    path, *_ = inferred()
    assert cli.main(["waypoints", str(path), "--datum", "-33.9", "151.2", "0.5"]) == 0
    document = json.loads((tmp_path / "waypoints.geojson").read_text())
    assert document["datum"] == {"latitude": -33.9, "longitude": 151.2, "yaw": 0.5}
    longitude, latitude = document["features"][0]["geometry"]["coordinates"]
    assert (longitude, latitude) == (
        pytest.approx(151.2, abs=1e-3),
        pytest.approx(-33.9, abs=1e-3),
    )


def test_another_frame_than_the_panels_is_told(
    inferred: Infer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, *_ = inferred()
    path.write_text(json.dumps({**json.loads(path.read_text()), "frame_id": "odom"}))
    assert cli.main(["waypoints", str(path)]) == 0
    assert read_waypoints(tmp_path / "waypoints.yaml").frame_id == "odom"
    assert capsys.readouterr().err == (
        f"bnirl: {tmp_path / 'waypoints.yaml'}: is in the frame odom; Nav2's RViz panel, which "
        "reads no frame, would take it to be in map\n"
    )


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line with which the command ends."""
    assert cli.main(["waypoints", *map(str, arguments)]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    return said.err


def test_what_is_no_subgoals_json_is_refused(
    inferred: Infer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, *_ = inferred()
    good = json.loads(path.read_text())
    first, *others = good["subgoals"]
    changed: list[tuple[str, str]] = [
        ("", "this is not valid JSON; give the subgoals.json"),
        ("\xff", "this is not valid JSON"),
        ("[" * 100_000, "this is not valid JSON"),
        ("[1]", "has no format number"),
        ("{}", "has no format number"),
        (json.dumps({**good, "format": 2}), "has the format 2 where only 1 is known; infer"),
        *(
            (json.dumps({**good, **change}), words)
            for change, words in (
                ({"subgoals": [], "visit_sequence": []}, "tells of no subgoal that was visited"),
                ({"visit_sequence": []}, "tells of no subgoal that was visited; infer from"),
                ({"visit_sequence": [99]}, "'visit_sequence' has a rank that no subgoal has"),
                ({"visit_sequence": [1, 2, 1]}, "'visit_sequence' has a rank twice"),
                ({"visit_sequence": None}, "is not as bnirl infer writes it"),
                ({"frame_id": None}, "'frame_id' is no name"),
                ({"subgoals": None}, "is not as bnirl infer writes it"),
                ({"subgoals": [[], *others]}, "is not as bnirl infer writes it"),
                ({"subgoals": [{"rank": 1}, *others]}, "('cell' is missing); infer again"),
                (
                    {"subgoals": [{**first, "position": [1.0, math.nan]}, *others]},
                    "the subgoal of rank 1 has a number that is not finite",
                ),
                ({"subgoals": [{**first, "position": [1.0]}, *others]}, "infer again"),
                ({"subgoals": [{**first, "position": ["a", "b"]}, *others]}, "infer again"),
                ({"subgoals": [{**first, "probability": None}, *others]}, "infer again"),
            )
        ),
    ]
    for text, words in changed:
        path.write_text(text, encoding="latin-1")
        line = refused(capsys, path)
        assert line.startswith(f"bnirl: {path}: "), line
        assert words in line
    del good["visit_sequence"]
    path.write_text(json.dumps(good))
    assert "('visit_sequence' is missing); infer again" in refused(capsys, path)
    assert "none.json: cannot be read (No such file" in refused(capsys, tmp_path / "none.json")
    assert "cannot be read (Is a directory)" in refused(capsys, tmp_path)
    assert not (tmp_path / "waypoints.yaml").exists()


def test_a_folder_that_cannot_be_written_to_is_told(
    inferred: Infer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, *_ = inferred()
    (tmp_path / "file").touch()
    line = refused(capsys, path, "--out", tmp_path / "file")
    assert f"{tmp_path / 'file'}: the results cannot be written there" in line


@pytest.mark.parametrize(
    ("datum", "words"),
    [
        (["91", "0", "0"], "argument --datum: the latitude must be from -90 to 90, not 91"),
        (["0", "-181", "0"], "argument --datum: the longitude must be from -180 to 180, not -181"),
        (["0", "0", "inf"], "argument --datum: the yaw must be a finite number, not inf"),
        (["nan", "0", "0"], "argument --datum: the latitude must be from -90 to 90, not nan"),
        (["0", "0"], "argument --datum: expected 3 arguments"),
        (["0", "0", "north"], "argument --datum: invalid float value: 'north'"),
    ],
)
def test_wrong_datums_end_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], datum: list[str], words: str
) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        cli.main(["waypoints", str(tmp_path / "subgoals.json"), "--datum", *datum])
    assert capsys.readouterr().err.splitlines()[-1] == f"bnirl waypoints: error: {words}"
