"""Every view against its contract, on one small posterior over a turned map."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from bnirl_ros.inference.convergence import Convergence
from bnirl_ros.inference.intent import Intent
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Parameter, Pursuit, Subgoal, Summary, nothing_found
from bnirl_ros.maps import GridMap, map_from_occupancy, yaw_of
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.views.belief import belief_grid, map_message
from bnirl_ros.views.colours import UNEXPLAINED, colour_of
from bnirl_ros.views.demonstration import action_message, pose_message
from bnirl_ros.views.intent import current_subgoal, intent_markers, no_intent
from bnirl_ros.views.markers import assignment_markers, subgoal_markers
from bnirl_ros.views.messages import Marker, MarkerArray, Pose
from bnirl_ros.views.plot import draw_summary
from bnirl_ros.views.results import subgoals_document, subgoals_in
from bnirl_ros.views.tables import convergence, report, subgoal_table
from bnirl_ros.views.waypoints import headings, waypoint_path
from bnirl_ros.views.ways import MOST_NUMBERED, MOST_WAYS, route_of

ROOT = Path(__file__).resolve().parent.parent

STAMP = 12_345_678_901
YAW = math.pi / 2
STAY, EAST, NORTH_EAST = (ACTION_NAMES.index(name) for name in ("stay", "E", "NE"))


@pytest.fixture
def grid_map() -> GridMap:
    """5 x 3 cells of 0.5 m, turned by a quarter: x of the map points along y of the frame."""
    free = np.ones((3, 5), dtype=bool)
    free[1, 1] = False
    return GridMap(free, 0.5, (10.0, 20.0, YAW), "odom")


@pytest.fixture
def summary(grid_map: GridMap) -> Summary:
    """Three subgoals visited in the order 2, 1, 3; five observations, one of them repeated."""
    cells = {1: (4, 2), 2: (0, 0), 3: (4, 0)}
    probability = {1: 1.0, 2: 0.994, 3: 0.5}
    visits = {1: (2,), 2: (1, 3), 3: (4,)}
    rank_of = np.array([1, 1, 1, 2, 3])
    belief = np.zeros(grid_map.free.shape)
    for rank, (x, y) in cells.items():
        belief[y, x] = probability[rank]
    return Summary(
        subgoals=tuple(
            Subgoal(
                rank,
                cells[rank],
                tuple(grid_map.centres_of([cells[rank]])[0].tolist()),
                probability[rank],
                int((rank_of == rank).sum()),
                visits[rank],
            )
            for rank in cells
        ),
        visit_sequence=(2, 1, 3),
        observations=np.array(
            [
                [0, 2, 1, NORTH_EAST],
                [0, 2, 1, NORTH_EAST],
                [0, 3, 2, EAST],
                [0, 0, 0, STAY],
                [1, 3, 0, EAST],
            ]
        ),
        rank_of=rank_of,
        cell_probability=belief,
        convergence=Convergence(1.0, 100.0, "the log joint", "alpha", chains=4, draws=800),
        sampling=None,
    )


@pytest.fixture
def sequence(summary: Summary) -> Summary:
    """The same, of a model that knows pursuits: one observation of five is a slip."""
    return dataclasses.replace(
        summary,
        subgoals=tuple(
            dataclasses.replace(subgoal, pursuits=pursuits)
            for subgoal, pursuits in zip(summary.subgoals, (1.96, 1.0, 0.5), strict=True)
        ),
        rank_of=np.array([1, 0, 1, 2, 3]),
        pursuits=(
            Pursuit(episode=0, rank=1, first=0, last=2, arrived=True),
            Pursuit(episode=0, rank=2, first=3, last=3, arrived=False),
            Pursuit(episode=1, rank=3, first=4, last=4, arrived=True),
        ),
        unexplained=0.1875,
        parameters=(
            Parameter("alpha", 3.25, (2.875, 4.0), inferred=True),
            Parameter("eta", 1.0, (1.0, 1.0), inferred=False),
            Parameter("slip", 0.03125, (0.0125, 0.0625), inferred=True),
        ),
    )


def numbers(value: object) -> Iterator[float]:
    """Every float within a message."""
    if dataclasses.is_dataclass(value):
        for each in dataclasses.fields(value):
            yield from numbers(getattr(value, each.name))
    elif isinstance(value, list):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, float):
        yield value


def all_unexplained(summary: Summary) -> Summary:
    return dataclasses.replace(
        summary,
        subgoals=(),
        visit_sequence=(),
        rank_of=np.zeros_like(summary.rank_of),
        pursuits=(),
        unexplained=1.0,
    )


def pursuing(summary: Summary, episodes: Mapping[int, Sequence[int]]) -> Summary:
    """The same with pursuits of these ranks in each episode."""
    pursuits = tuple(
        Pursuit(episode, rank, first=0, last=0, arrived=True)
        for episode, ranks in episodes.items()
        for rank in ranks
    )
    first = [[episode, 0, 0, STAY] for episode in episodes]  # so that each has an observation
    return dataclasses.replace(
        summary,
        pursuits=pursuits,
        observations=np.array([*first, *summary.observations.tolist()]),
        rank_of=np.array([*(1 for _ in first), *summary.rank_of]),
    )


def yaw_in(pose: Pose) -> float:
    turn = pose.orientation
    return yaw_of(turn.x, turn.y, turn.z, turn.w, "pose")


@pytest.mark.parametrize("view", [subgoal_markers, assignment_markers])
def test_markers_are_a_complete_set_that_rviz_accepts(view, summary, grid_map):
    array: MarkerArray = view(summary, grid_map, STAMP)
    first, *others = array.markers
    assert (first.action, first.ns, first.header.frame_id) == (Marker.DELETEALL, "", "odom")
    keys = [(marker.ns, marker.id) for marker in others]
    assert len(set(keys)) == len(keys)
    assert {marker.id for marker in others} == {1, 2, 3}
    for marker in others:
        assert marker.action == Marker.ADD
        assert marker.header.frame_id == "odom"
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (12, 345_678_901)
        assert (marker.lifetime.sec, marker.lifetime.nanosec) == (0, 0)
        colour = marker.color
        assert all(0 <= part <= 1 for part in (colour.r, colour.g, colour.b))
        assert colour.a == 1
        turn = marker.pose.orientation
        assert math.hypot(turn.x, turn.y, turn.z, turn.w) == pytest.approx(1.0)
    assert all(math.isfinite(number) for number in numbers(array))


def test_each_subgoal_has_a_sphere_a_heading_and_a_label(summary, grid_map):
    by_key = {(m.ns, m.id): m for m in subgoal_markers(summary, grid_map, STAMP).markers[1:]}
    assert len(by_key) == 9
    for subgoal in summary.subgoals:
        sphere, heading, label = (
            by_key[name, subgoal.rank] for name in ("subgoal", "heading", "label")
        )
        assert (sphere.type, heading.type, label.type) == (
            Marker.SPHERE,
            Marker.ARROW,
            Marker.TEXT_VIEW_FACING,
        )
        for marker in (sphere, heading, label):
            position = marker.pose.position
            assert (position.x, position.y) == pytest.approx(subgoal.position)
        assert sphere.scale.x == sphere.scale.y == sphere.scale.z > 0
        assert heading.scale.x > sphere.scale.x / 2  # or it would be hidden inside the sphere
        assert label.pose.position.z == pytest.approx(sphere.scale.z / 2 + 0.2)
        assert label.scale.z > 0
    assert [by_key["label", rank].text for rank in (1, 2, 3)] == [
        "wp_1 1.00",
        "wp_2 0.99",
        "wp_3 0.50",
    ]


def test_markers_stay_visible_on_a_fine_map_and_grow_with_coarse_cells(summary, grid_map):
    sizes = [
        subgoal_markers(summary, dataclasses.replace(grid_map, resolution=resolution), STAMP)
        .markers[1]
        .scale.x
        for resolution in (0.01, 0.05, 1.0, 2.0)
    ]
    assert sizes[0] == sizes[1] == pytest.approx(0.06)
    assert sizes[2:] == pytest.approx([0.6, 1.2])


def test_a_subgoal_heads_for_the_next_one_and_the_last_keeps_its_direction(summary, grid_map):
    # On the map: from (0, 0) to (4, 2), then down to (4, 0); the map is turned by a quarter.
    expected = {2: YAW + math.atan2(2, 4), 1: YAW - math.pi / 2, 3: YAW - math.pi / 2}
    assert headings(summary) == pytest.approx(expected)
    arrows = {
        m.id: m for m in subgoal_markers(summary, grid_map, STAMP).markers if m.ns == "heading"
    }
    for rank, yaw in expected.items():
        assert yaw_in(arrows[rank].pose) == pytest.approx(yaw)


def test_the_last_subgoal_of_a_loop_heads_for_the_first(summary):
    # From (4, 0) on the map back to (0, 0).
    loop = dataclasses.replace(summary, repetitions=2)
    assert headings(loop) == pytest.approx({**headings(summary), 3: YAW - math.pi})


def test_a_subgoal_alone_heads_along_x(summary):
    alone = dataclasses.replace(summary, subgoals=summary.subgoals[:1], visit_sequence=(1,))
    assert headings(alone) == {1: 0.0}


def test_assignments_are_lines_over_distinct_pairs_in_the_map_frame(summary, grid_map):
    of_rank = {m.id: m for m in assignment_markers(summary, grid_map, STAMP).markers[1:]}
    for rank, marker in of_rank.items():
        assert (marker.type, marker.ns) == (Marker.LINE_LIST, "assignment")
        assert len(marker.points) % 2 == 0
        assert marker.scale.x > 0
        assert (marker.color.r, marker.color.g, marker.color.b) == colour_of(rank)
        assert yaw_in(marker.pose) == 0.0  # the points themselves are turned
    # Three observations of rank 1, two of them the same: two lines.
    ends = np.array([(point.x, point.y) for point in of_rank[1].points])
    starts = grid_map.centres_of([[2, 1], [3, 2]])
    assert ends[::2] == pytest.approx(starts)
    # North-east and east on the map are north-west and north in a frame seen from above.
    assert ends[1::2] - ends[::2] == pytest.approx(np.array([[-0.2, 0.2], [0.0, 0.2]]))


def test_unexplained_assignments_are_grey_lines_of_their_own(summary, grid_map):
    slips = dataclasses.replace(summary, rank_of=np.array([0, 0, 1, 0, 3]))
    of_rank = {m.id: m for m in assignment_markers(slips, grid_map, STAMP).markers[1:]}
    assert set(of_rank) == {0, 1, 2, 3}
    grey = of_rank[0]
    assert (grey.type, grey.ns) == (Marker.LINE_LIST, "assignment")
    assert (grey.color.r, grey.color.g, grey.color.b) == UNEXPLAINED
    assert len(grey.points) == 2 + 4  # a move, and the cross of staying
    assert of_rank[2].points == []
    nothing = assignment_markers(all_unexplained(summary), grid_map, STAMP)
    assert [marker.id for marker in nothing.markers[1:]] == [0]


def test_staying_is_a_cross_around_the_centre_of_its_cell(summary, grid_map):
    of_rank = {m.id: m for m in assignment_markers(summary, grid_map, STAMP).markers[1:]}
    ends = np.array([(point.x, point.y) for point in of_rank[2].points])
    assert len(ends) == 4
    assert ends.mean(axis=0) == pytest.approx(grid_map.centres_of([[0, 0]])[0])
    assert grid_map.cells_of(ends).tolist() == [[0, 0]] * 4
    first, second = ends[1] - ends[0], ends[3] - ends[2]
    assert first @ second == pytest.approx(0.0)
    assert np.linalg.norm(first) > 0


def test_waypoints_are_the_subgoals_in_the_order_visited(summary, grid_map):
    path = waypoint_path(summary, grid_map, STAMP)
    assert path.header.frame_id == "odom"
    assert path.header.stamp.sec == 12
    position_of = {subgoal.rank: subgoal.position for subgoal in summary.subgoals}
    places = [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]
    assert places == [pytest.approx(position_of[rank]) for rank in (2, 1, 3)]
    yaws = [yaw_in(pose.pose) for pose in path.poses]
    assert yaws == pytest.approx([YAW + math.atan2(2, 4), 0.0, 0.0])
    assert all(pose.header == path.header for pose in path.poses)


@pytest.fixture
def intent(summary, grid_map) -> Intent:
    """Of a demonstrator who is at subgoal 2 and most probably goes for 3."""
    return Intent(grid_map, summary, np.array([0.004, 0.25, 0.6]), cell=(0, 0), pose=7)


def test_the_current_subgoal_is_the_most_probable_one_with_its_waypoints_heading(intent, summary):
    told = current_subgoal(intent, STAMP)
    assert (told.header.frame_id, told.header.stamp.sec) == ("odom", 12)
    waypoint = waypoint_path(summary, intent.grid_map, STAMP).poses[-1]
    assert told == waypoint
    nothing = dataclasses.replace(
        intent, summary=all_unexplained(summary), probability=np.empty(0)
    )
    assert current_subgoal(nothing, STAMP) is None
    assert [marker.text for marker in intent_markers(nothing, STAMP).markers[1:]] == [
        "another 1.00"
    ]


def test_the_intent_is_arrows_as_opaque_as_it_is_probable(intent, summary, grid_map):
    first, *others = intent_markers(intent, STAMP).markers
    assert (first.action, first.ns, first.header.frame_id) == (Marker.DELETEALL, "", "odom")
    by_key = {(marker.ns, marker.id): marker for marker in others}
    # Subgoal 1 is too improbable to be shown, and an arrow to where one is has no direction.
    assert list(by_key) == [
        ("intent_label", 0),
        ("intent_label", 2),
        ("intent", 3),
        ("intent_label", 3),
    ]
    assert len(by_key) == len(others)
    assert all(marker.header.stamp.nanosec == 345_678_901 for marker in others)
    assert all(math.isfinite(number) for marker in others for number in numbers(marker))
    arrow = by_key["intent", 3]
    start, end = grid_map.centres_of([intent.cell])[0], summary.subgoals[2].position
    assert [(point.x, point.y) for point in arrow.points] == [
        pytest.approx(start),
        pytest.approx(end),
    ]
    assert arrow.type == Marker.ARROW
    assert arrow.color.a == pytest.approx(0.6)
    assert (arrow.color.r, arrow.color.g, arrow.color.b) == colour_of(3)
    thin = intent_markers(
        dataclasses.replace(intent, probability=np.array([0.0, 0.25, 0.3])), STAMP
    )
    (other,) = (marker for marker in thin.markers if marker.ns == "intent")
    assert 0 < other.scale.x < arrow.scale.x
    labels = [by_key["intent_label", rank] for rank in (0, 2, 3)]
    assert [label.text for label in labels] == ["another 0.15", "2 0.25", "3 0.60"]
    assert [(label.pose.position.x, label.pose.position.y) for label in labels] == [
        pytest.approx(start),
        pytest.approx(start),
        pytest.approx((start + end) / 2),
    ]
    assert [marker.action for marker in no_intent(grid_map, STAMP).markers] == [Marker.DELETEALL]


def found_at(message: object, path: str) -> list[Any]:
    """What Foxglove finds in a message, at a path such as `markers[:]{ns=="a"}{id==1}.color.a`."""
    found = [message]
    for name, each, conditions in re.findall(r"(\w+)(\[:\])?((?:\{[^}]+\})*)", path):
        found = [getattr(part, name) for part in found]
        if each:
            found = [part for parts in found for part in parts]
        for key, value in re.findall(r"\{(\w+)==([^}]+)\}", conditions):
            found = [part for part in found if getattr(part, key) == json.loads(value)]
    return found


def test_foxglove_plots_how_probable_each_subgoal_is(intent):
    layout = json.loads((ROOT / "foxglove" / "subgoals.json").read_text(encoding="utf-8"))
    series = layout["configById"]["Plot!intent"]["paths"]
    topics, paths = zip(*(each["value"].split(".", 1) for each in series), strict=True)
    assert {*topics} == {"/intent"}
    markers = intent_markers(intent, STAMP)
    plotted = [found_at(markers, path) for path in paths]
    assert plotted == [[], [], [pytest.approx(0.6)], *[[]] * (len(paths) - 3)]


def test_belief_is_the_probability_in_percent(summary, grid_map):
    grid = belief_grid(summary, grid_map, STAMP)
    assert grid.data.dtype == np.int8
    assert grid.data.reshape(3, 5).tolist() == [
        [99, 0, 0, 0, 50],
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, 100],
    ]
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (5, 3, 0.5)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (10.0, 20.0)
    assert yaw_in(grid.info.origin) == pytest.approx(YAW)


def test_belief_over_another_map_is_refused(summary):
    with pytest.raises(ValueError, match="belief over"):
        belief_grid(summary, GridMap(np.ones((5, 3), dtype=bool)), STAMP)


def test_the_map_message_means_the_map(grid_map):
    message = map_message(grid_map, STAMP)
    origin = message.info.origin
    again = map_from_occupancy(
        message.data,
        message.info.width,
        message.info.height,
        message.info.resolution,
        (origin.position.x, origin.position.y, yaw_in(origin)),
        message.header.frame_id,
        "map",
    )
    assert np.array_equal(again.free, grid_map.free)
    assert again.origin == pytest.approx(grid_map.origin)
    assert (again.resolution, again.frame_id) == (0.5, "odom")


def test_a_pose_is_the_centre_of_its_cell(grid_map):
    message = pose_message(grid_map, (3, 1), STAMP)
    place = (message.pose.position.x, message.pose.position.y)
    assert place == pytest.approx((10.0 - 0.75, 20.0 + 1.75))
    assert grid_map.cells_of([place]).tolist() == [[3, 1]]
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("odom", 345_678_901)


@pytest.mark.parametrize(
    ("action", "step"), [(STAY, (0, 0)), (EAST, (1, 0)), (NORTH_EAST, (1, 1)), (6, (-1, -1))]
)
def test_an_action_is_its_step_in_map_axes(action, step):
    message = action_message(action, STAMP, "odom")
    assert (message.vector.x, message.vector.y, message.vector.z) == (*step, 0.0)
    assert all(isinstance(number, float) for number in (message.vector.x, message.vector.y))
    assert (message.header.frame_id, message.header.stamp.sec) == ("odom", 12)


def test_the_table_says_what_the_summary_says(summary):
    assert subgoal_table(summary.subgoals, summary.visit_sequence).splitlines() == [
        "rank    cell      place [m]  probability  observations  order",
        "   1  (4, 2)  (8.75, 22.25)         1.00             3      2",
        "   2  (0, 0)  (9.75, 20.25)         0.99             1      1",
        "   3  (4, 0)  (9.75, 22.25)         0.50             1      3",
    ]


def test_the_report_of_the_papers_model_is_its_table_and_the_chains(summary):
    table = subgoal_table(summary.subgoals, summary.visit_sequence)
    assert report(summary) == f"{table}\n{convergence(summary)}"


def test_the_report_tells_pursuits_slips_loop_and_parameters(sequence):
    assert report(dataclasses.replace(sequence, repetitions=3)).splitlines() == [
        "rank    cell      place [m]  probability  observations  pursuits  order",
        "   1  (4, 2)  (8.75, 22.25)         1.00             3       2.0      2",
        "   2  (0, 0)  (9.75, 20.25)         0.99             1       1.0      1",
        "   3  (4, 0)  (9.75, 22.25)         0.50             1       0.5      3",
        "the visits go round 3 times",
        "unexplained: 18.8 % of the observations",
        "parameter  median     90 % interval",
        "    alpha    3.25         2.88 to 4",
        "      eta       1             fixed",
        "     slip  0.0312  0.0125 to 0.0625",
        convergence(sequence),
    ]
    for repetitions in (0, 1):
        once = dataclasses.replace(sequence, repetitions=repetitions)
        assert "go round" not in report(once)


def test_the_report_without_a_subgoal(sequence, grid_map):
    lines = report(all_unexplained(sequence)).splitlines()
    assert lines[:2] == [
        "rank  cell  place [m]  probability  observations  order",
        "unexplained: 100 % of the observations",
    ]
    assert len(report(nothing_found(grid_map)).splitlines()) == 2


CONTRACT = ["format", "frame_id", "resolution", "model", "subgoals", "visit_sequence"]
CONTRACT_OF_SUBGOAL = ["rank", "cell", "position", "probability", "observations", "visit_order"]


def test_the_document_of_the_papers_model_keeps_to_the_contract(summary, grid_map):
    document = subgoals_document(summary, grid_map, Settings(alpha=7.0, eta=2.0))
    assert list(document) == [*CONTRACT, "diagnostics"]
    assert list(document["subgoals"][0]) == CONTRACT_OF_SUBGOAL
    assert (document["model"]["alpha"], document["model"]["eta"]) == (7.0, 2.0)
    assert subgoals_in(json.loads(json.dumps(document))) == summary.subgoals


def test_the_document_tells_pursuits_slips_and_parameters(sequence, grid_map):
    written = json.dumps(subgoals_document(sequence, grid_map, Settings(alpha=7.0, eta=2.0)))
    document = json.loads(written)
    added = ["repetitions", "episodes", "unexplained", "parameters"]
    assert list(document) == [*CONTRACT, *added, "diagnostics"]
    assert list(document["subgoals"][0]) == [*CONTRACT_OF_SUBGOAL, "pursuits"]
    assert subgoals_in(document) == sequence.subgoals
    assert document["repetitions"] == 0
    assert document["unexplained"] == 0.1875
    assert document["episodes"] == [
        {
            "episode": 0,
            "pursuits": [
                {"rank": 1, "first": 0, "last": 2, "arrived": True},
                {"rank": 2, "first": 3, "last": 3, "arrived": False},
            ],
        },
        {"episode": 1, "pursuits": [{"rank": 3, "first": 4, "last": 4, "arrived": True}]},
    ]
    assert document["parameters"] == {
        "alpha": {"median": 3.25, "interval": [2.875, 4.0], "inferred": True},
        "eta": {"median": 1.0, "interval": [1.0, 1.0], "inferred": False},
        "slip": {"median": 0.03125, "interval": [0.0125, 0.0625], "inferred": True},
    }
    assert (document["model"]["alpha"], document["model"]["eta"]) == (3.25, 1.0)


def test_the_document_of_slips_alone_lists_episodes_without_pursuits(sequence, grid_map):
    document = subgoals_document(all_unexplained(sequence), grid_map, Settings())
    assert document["subgoals"] == []
    assert document["episodes"] == [{"episode": n, "pursuits": []} for n in (0, 1)]
    assert document["unexplained"] == 1.0
    assert "episodes" not in subgoals_document(nothing_found(grid_map), grid_map, Settings())


def ways(summary: Summary) -> dict[tuple[int, int], tuple[int, tuple[int, ...]]]:
    """How often each way was gone, and its numbers, by the ranks that it leads from and to."""
    return {
        (way.here.rank, way.there.rank): (way.times, way.numbers) for way in route_of(summary).ways
    }


def test_without_pursuits_the_route_is_the_order_of_the_first_visits(summary):
    assert ways(summary) == {(2, 1): (1, (2,)), (1, 3): (1, (3,))}
    assert route_of(summary).order == "order in which they were first visited"
    assert not route_of(summary).wide


def test_a_route_numbers_the_pursuits_of_an_episode_and_counts_those_of_all(summary):
    episodes = {0: (3,), 1: (3, 1), 2: (1, 2, 1, 2, 3), 3: (), 4: (1, 2, 1, 2, 3)}
    pursued = pursuing(summary, episodes)
    assert ways(pursued) == {
        (1, 2): (4, (2, 4)),
        (2, 1): (2, (3,)),
        (2, 3): (2, (5,)),
        (3, 1): (1, ()),
    }
    route = route_of(pursued)
    assert (route.order, route.most, route.wide) == ("order of the pursuits in episode 2", 4, True)


def test_the_numbers_of_a_loop_are_those_of_the_visits(summary):
    loop = pursuing(summary, {0: (2, 1, 3, 2, 1, 3, 2, 1)})
    loop = dataclasses.replace(loop, repetitions=3)
    assert ways(loop) == {(2, 1): (3, (2,)), (1, 3): (2, (3,)), (3, 2): (2, (1,))}
    assert route_of(loop).order == "order of the pursuits, 3 times round"


def test_no_way_leads_through_a_single_pursuit_or_none(sequence):
    single = pursuing(sequence, {0: (1,), 1: (2,)})
    again = pursuing(dataclasses.replace(sequence, visit_sequence=(1,)), {0: (1,), 1: (1,)})
    for nowhere in (single, dataclasses.replace(again, repetitions=2), all_unexplained(sequence)):
        assert route_of(nowhere).ways == ()
        assert route_of(nowhere).most == 1


# Matrices on linear RGB of Machado, Oliveira & Fernandes (2009), severity 1.
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}


def perceived(colours: list[tuple[float, float, float]], vision: str) -> np.ndarray:
    """OKLab coordinates (Ottosson 2020) of sRGB colours as a kind of vision sees them."""
    srgb = np.array(colours)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ VISION[vision].T, 0, 1)
    cones = np.cbrt(
        seen
        @ np.array(
            [
                [0.4122214708, 0.2119034982, 0.0883024619],
                [0.5363325363, 0.6806995451, 0.2817188376],
                [0.0514459929, 0.1073969566, 0.6299787005],
            ]
        )
    )
    return cones @ np.array(
        [
            [0.2104542553, 1.9779984951, 0.0259040371],
            [0.7936177850, -2.4285922050, 0.7827717662],
            [-0.0040720468, 0.4505937099, -0.8086757660],
        ]
    )


@pytest.mark.parametrize("vision", VISION)
def test_twelve_ranks_and_the_unexplained_can_be_told_apart(vision):
    # About 0.02 in OKLab is just noticeable side by side; the first six, the usual case, keep
    # far more.
    lab = perceived([colour_of(rank) for rank in [*range(1, 13), 0]], vision)
    apart = np.linalg.norm(lab[:, np.newaxis] - lab, axis=2)
    others = apart[~np.eye(len(lab), dtype=bool)]
    assert others.min() > 0.06
    six = apart[:6, :6][~np.eye(6, dtype=bool)]
    assert six.min() > 0.1


def test_the_colours_after_the_palette_are_its_variations_and_stay_in_range():
    assert colour_of(0) == UNEXPLAINED
    colours = [colour_of(rank) for rank in range(1, 37)]
    assert len(set(colours)) == 36
    assert colour_of(37) == colour_of(1)
    assert all(0 <= part <= 1 for colour in colours for part in colour)


def colours_in(path: Path) -> set[tuple[int, int, int]]:
    with Image.open(path) as image:
        counted = image.convert("RGB").getcolors(maxcolors=image.width * image.height)
    return {colour for _, colour in counted}


def as_bytes(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


def drawn_texts(summary: Summary, grid_map: GridMap, path: Path) -> list[str]:
    """Everything that is written in a picture, which it draws."""
    written = []
    draw = Text.draw
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", lambda self, *rest: (written.append(self), draw(self, *rest)))
        draw_summary(summary, grid_map, path)
    return [text.get_text() for text in written]


def test_the_picture_holds_every_subgoal_in_its_colour(tmp_path, summary, grid_map):
    path = tmp_path / "subgoals.png"
    draw_summary(summary, grid_map, path, title="A title")
    found = colours_in(path)
    assert all(as_bytes(colour_of(rank)) in found for rank in (1, 2, 3))
    assert as_bytes(colour_of(4)) not in found
    assert as_bytes(UNEXPLAINED) not in found


def test_the_picture_shows_unexplained_observations_in_grey(tmp_path, summary, grid_map):
    slip = dataclasses.replace(summary, rank_of=np.array([1, 1, 0, 2, 3]))
    draw_summary(slip, grid_map, tmp_path / "subgoals.png")
    assert as_bytes(UNEXPLAINED) in colours_in(tmp_path / "subgoals.png")


@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (200, 1), (300, 600)])
@pytest.mark.parametrize("pursued", [(), (1, 2, 1, 3)])
def test_the_picture_suits_any_map(tmp_path, summary, shape, pursued):
    summary = pursuing(summary, {0: pursued} if pursued else {})
    rows, columns = shape
    grid_map = GridMap(np.ones(shape, dtype=bool))
    subgoals = tuple(
        dataclasses.replace(each, cell=(each.rank % columns, each.rank % rows))
        for each in summary.subgoals
    )
    observations = summary.observations % (10, columns, rows, 9)
    draw_summary(
        dataclasses.replace(summary, subgoals=subgoals, observations=observations),
        grid_map,
        tmp_path / "subgoals.png",
    )
    width, height = Image.open(tmp_path / "subgoals.png").size
    assert 600 < width < 1850
    assert 200 < height < 1800


def test_the_picture_without_a_subgoal_or_an_observation(tmp_path, summary, grid_map):
    nothing = dataclasses.replace(
        summary,
        subgoals=(),
        visit_sequence=(),
        observations=np.zeros((0, 4), dtype=np.int64),
        rank_of=np.zeros(0, dtype=np.int64),
    )
    draw_summary(nothing, grid_map, tmp_path / "subgoals.png")
    assert as_bytes(colour_of(2)) not in colours_in(tmp_path / "subgoals.png")


@pytest.mark.parametrize("change", [all_unexplained, lambda each: each])
def test_the_picture_tells_the_share_of_the_unexplained(tmp_path, sequence, grid_map, change):
    shown = change(sequence)
    texts = drawn_texts(shown, grid_map, tmp_path / "subgoals.png")
    assert as_bytes(UNEXPLAINED) in colours_in(tmp_path / "subgoals.png")
    assert f"explained by no subgoal: {100 * shown.unexplained:.3g} %" in texts
    assert ("pursuits" in texts) == bool(shown.subgoals)


def test_the_picture_numbers_pursuits_on_the_ways_between_their_subgoals(
    tmp_path, summary, grid_map
):
    back_and_forth = pursuing(summary, {0: (1, 2, 1, 2, 1, 2, 1, 2, 3)})
    texts = drawn_texts(back_and_forth, grid_map, tmp_path / "subgoals.png")
    assert {"2, 4, 6, …", "3, 5, 7", "9", "order of the pursuits in episode 0"} <= set(texts)
    assert "the wider, the more often" in texts
    once = drawn_texts(pursuing(summary, {0: (1, 2)}), grid_map, tmp_path / "subgoals.png")
    assert "the wider, the more often" not in once


def test_the_picture_of_hundreds_of_pursuits(tmp_path, summary, grid_map):
    cells = [(x, y) for y in range(3) for x in range(5) if grid_map.free[y, x]]
    subgoals = tuple(
        dataclasses.replace(summary.subgoals[0], rank=rank, cell=cell, pursuits=30.0)
        for rank, cell in enumerate(cells, start=1)
    )
    rng = np.random.default_rng(0)
    steps = rng.integers(1, len(cells), 400)
    wandering = pursuing(
        dataclasses.replace(summary, subgoals=subgoals),
        {0: [int(each) + 1 for each in np.cumsum(steps) % len(cells)]},
    )
    route = route_of(wandering)
    assert len(route.ways) == MOST_WAYS
    texts = drawn_texts(wandering, grid_map, tmp_path / "subgoals.png")
    assert f"order of the first {MOST_NUMBERED} pursuits in episode 0" in texts


def test_the_same_summary_gives_the_same_picture(tmp_path, summary, grid_map):
    for name in ("a.png", "b.png"):
        draw_summary(summary, grid_map, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_views_load_no_plotting_until_a_picture_is_drawn():
    program = (
        "import json, sys, bnirl_ros.views.plot, bnirl_ros.views.markers, bnirl_ros.maps;"
        "slow = ('matplotlib', 'PIL', 'rclpy');"
        "print(json.dumps([name for name in slow if name in sys.modules]))"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert json.loads(ran.stdout) == []
