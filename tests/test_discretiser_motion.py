"""Motion in metres becomes visits of cells, and actions that lead from one to the next."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.motion import Discretiser, Visit, fill_jumps, record
from bnirl_ros.demonstrations.placement import Placement, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap, parse_text_grid
from bnirl_ros.mdp.actions import ACTION_NAMES, ACTION_SETS, STEPS
from bnirl_ros.mdp.grid_world import GridWorld

SECOND = 1_000_000_000

OPEN = GridMap(np.ones((8, 8), dtype=bool), 1.0)

SETTINGS = Discretising(planning_resolution=1.0, dwell=3.0, longest_silence=8.0, longest_jump=4.0)

Track = list[tuple[float, float, float]]
"""Time [s] and position [m]."""

tracks = st.lists(
    # Never on a cell's edge, nor as far apart as any limit, so that rounding turns nothing over.
    st.tuples(
        st.sampled_from([0.25, 0.5, 1.0, 4.0, 9.0, -100.0]),
        *[st.integers(0, 8 * 8 - 1).map(lambda place: (place + 0.5) * 0.97 / 8)] * 2,
    ),
    max_size=12,
).map(
    lambda steps: [
        (float(time), x, y)
        for time, (_, x, y) in zip(np.cumsum([step[0] for step in steps]), steps, strict=True)
    ]
)

grids = arrays(np.bool_, (8, 8), elements=st.sampled_from([True] * 4 + [False])).map(
    lambda free: GridMap(free, 1.0)
)


def visits_of(
    track: Track, grid_map: GridMap = OPEN, settings: Discretising = SETTINGS, moves: int = 8
) -> tuple[list[Visit], Discretiser]:
    discretiser = Discretiser(grid_map, settings, moves)
    visits = []
    for time, x, y in track:
        visits += discretiser.follow(round(time * SECOND), x, y)
    return visits, discretiser


def placed(visits: list[Visit], grid_map: GridMap, moves: int = 8) -> Placement:
    recorder = Recorder(0)
    recorder.map_arrived()
    for visit in visits:
        record(recorder, visit, grid_map.frame_id)
    return place(recorder.snapshot(), grid_map, moves, SETTINGS.longest_silence)


def walk(*corners: tuple[float, float], step: float = 0.05, speed: float = 0.5) -> Track:
    """A drive along straight lines."""
    track: Track = [(0.0, *corners[0])]
    for end in corners[1:]:
        time, x, y = track[-1]
        length = math.hypot(end[0] - x, end[1] - y)
        parts = max(round(length / step), 1)
        track += [
            (
                time + length / speed * part / parts,
                x + (end[0] - x) * part / parts,
                y + (end[1] - y) * part / parts,
            )
            for part in range(1, parts + 1)
        ]
    return track


def standing(track: Track, seconds: float) -> Track:
    """The drive, and standing at its end."""
    time, x, y = track[-1]
    return [*track, *((time + each / 4, x, y) for each in range(1, round(seconds * 4) + 1))]


def names(visits: list[Visit]) -> str:
    return " ".join(ACTION_NAMES[visit.led_by[1]] for visit in visits if visit.led_by)


@given(track=tracks, grid_map=grids, moves=st.sampled_from([4, 8]))
def test_actions_lead_from_each_visit_to_the_next(
    track: Track, grid_map: GridMap, moves: int
) -> None:
    visits, discretiser = visits_of(track, grid_map, moves=moves)
    world = GridWorld(discretiser.grid_map.free, moves) if visits else None
    for before, after in pairwise(visits):
        if after.led_by is None:
            continue
        stamp, action = after.led_by
        assert stamp == before.stamp
        assert action in ACTION_SETS[moves]
        assert after.cell == tuple(np.add(before.cell, STEPS[action]))
        assert 0 <= after.stamp - before.stamp <= 8 * SECOND
        # Not blocked, and past no blocked corner.
        x, y = before.cell
        assert world is not None
        assert world.open_moves[y, x] >> ACTION_SETS[moves].index(action) & 1
    # Whoever has the visits as messages tells the same episodes apart, and misses nothing.
    placement = placed(visits, discretiser.grid_map, moves)
    assert len(placement.demonstration) == sum(visit.led_by is not None for visit in visits)
    starts = [visit.led_by is None for visit in visits] + [True]
    seen = [start for start, after in pairwise(starts) if not after]
    assert placement.demonstration.starts.tolist() == seen
    alone = sum(start and after for start, after in pairwise(starts))
    assert placement.faults == ({"pose without an action of its stamp": alone} if alone else {})


@given(track=tracks, grid_map=grids)
def test_visited_cells_are_open(track: Track, grid_map: GridMap) -> None:
    visits, discretiser = visits_of(track, grid_map)
    was_free = grid_map.free
    assert all(discretiser.grid_map.is_free([visit.cell])[0] for visit in visits)
    opened = {(int(x), int(y)) for y, x in np.argwhere(discretiser.grid_map.free & ~was_free)}
    assert opened == set(discretiser.opened)
    assert len(opened) == len(discretiser.opened)
    assert (discretiser.grid_map.free | ~was_free).all()  # none is closed


@given(
    track=tracks,
    shift=st.tuples(*[st.floats(-50, 50)] * 2),
    turn=st.floats(-math.pi, math.pi),
    resolution=st.sampled_from([0.25, 1.0, 3.0]),
)
def test_the_maps_place_in_its_frame_does_not_matter(
    track: Track, shift: tuple[float, float], turn: float, resolution: float
) -> None:
    there = GridMap(OPEN.free, resolution, (*shift, turn), "elsewhere")
    settings = replace(SETTINGS, longest_jump=4.0 * resolution)
    cosine, sine = math.cos(turn), math.sin(turn)
    moved = [
        (
            time,
            shift[0] + resolution * (cosine * x - sine * y),
            shift[1] + resolution * (sine * x + cosine * y),
        )
        for time, x, y in track
    ]
    visits, here = visits_of(moved, there, settings)[0], visits_of(track)[0]
    assert [(visit.stamp, visit.cell, visit.led_by) for visit in visits] == [
        (visit.stamp, visit.cell, visit.led_by) for visit in here
    ]
    positions = [visit.position for visit in visits]
    assert there.cells_of(positions).tolist() == [list(visit.cell) for visit in visits]


@given(arrays(np.int64, st.tuples(st.integers(1, 6), st.just(2)), elements=st.integers(-9, 9)))
def test_jumps_follow_the_line(cells: npt.NDArray[np.int64]) -> None:
    filled = fill_jumps(cells)
    assert (np.abs(np.diff(filled, axis=0)).max(axis=1, initial=0) <= 1).all()
    at = 0
    for start, end in pairwise(cells):
        length = np.abs(end - start).max()
        for ordinal in range(1, length + 1):
            on_line = start + (end - start) * ordinal / length
            assert (np.abs(filled[at + ordinal] - on_line) <= 0.5).all()
        at += length
    assert at == len(filled) - 1


def test_a_jump_is_filled_in_with_its_time() -> None:
    visits, _ = visits_of([(0.0, 0.5, 0.5), (3.0, 3.5, 1.4)])
    assert [visit.cell for visit in visits] == [(0, 0), (1, 0), (2, 1), (3, 1)]
    assert [visit.stamp for visit in visits] == [0, SECOND, 2 * SECOND, 3 * SECOND]
    assert names(visits) == "E NE E"
    assert names(visits_of([(0.0, 0.5, 0.5), (3.0, 3.5, 1.4)], moves=4)[0]) == "E E N E"


def test_a_jump_over_blocked_cells_begins_an_episode() -> None:
    grid_map = parse_text_grid(".#..\n.#..\n", "test")
    track = [(0.0, 0.5, 0.5), (1.0, 0.5, 1.5), (2.0, 2.5, 1.5), (3.0, 3.5, 1.5)]
    visits, discretiser = visits_of(track, grid_map)
    assert [visit.cell for visit in visits] == [(0, 0), (0, 1), (2, 1), (3, 1)]
    assert [visit.led_by is None for visit in visits] == [True, False, True, False]
    assert discretiser.opened == []
    assert sum(discretiser.faults.values()) == 1


def test_a_diagonal_past_a_blocked_corner_goes_round_it() -> None:
    grid_map = parse_text_grid("#.\n..\n", "test")
    track = [(0.0, 0.5, 0.5), (1.0, 1.4, 1.5)]
    visits, discretiser = visits_of(track, grid_map)
    assert names(visits) == "E N"
    assert discretiser.opened == []
    # Between two, the one nearer to its way is opened: it was there.
    visits, discretiser = visits_of(
        [(0.0, 0.8, 0.5), (1.0, 1.4, 1.9)], parse_text_grid("#.\n.#\n", "test")
    )
    assert names(visits) == "E N"
    assert discretiser.opened == [(1, 0)]


def test_gaps_in_time_and_space_begin_episodes() -> None:
    drive = walk((0.5, 0.5), (2.5, 0.5))
    later = [(time + drive[-1][0] + 8.1, x, y) for time, x, y in walk((2.5, 0.5), (4.5, 0.5))]
    visits, _ = visits_of(drive + later)
    assert [visit.led_by is None for visit in visits] == [True, False, False] * 2
    far = [(time + drive[-1][0] + 0.1, x, y) for time, x, y in walk((2.5, 5.5), (4.5, 5.5))]
    visits, _ = visits_of(drive + far)
    assert [visit.led_by is None for visit in visits] == [True, False, False] * 2
    # Elsewhere for a moment, and back to drive on.
    end = drive[-1][0]
    glance = [*drive, (end + 0.1, 2.5, 7.5), (end + 0.2, 2.5, 0.5)]
    glance += [(end + 0.2 + time, x, y) for time, x, y in walk((2.5, 0.5), (4.5, 0.5))]
    visits, _ = visits_of(glance)
    assert [visit.led_by is None for visit in visits] == [True, False, False, False, False]
    # Played again, or one message overtaken by another.
    visits, _ = visits_of(drive + drive)
    assert [visit.led_by is None for visit in visits] == [True, False, False] * 2
    overtaken = drive.copy()
    overtaken[20], overtaken[21] = drive[21], drive[20]
    visits, discretiser = visits_of(overtaken)
    assert visits == visits_of(drive)[0]
    assert discretiser.faults == {"pose that is older than the one before": 1}


@pytest.mark.parametrize(("seconds", "stays"), [(2.0, 0), (3.5, 1), (7.0, 2), (31.0, 10)])
def test_standing_longer_than_the_dwell_time_is_a_stay(seconds: float, stays: int) -> None:
    track = standing(walk((0.5, 0.5), (2.4, 0.5)), seconds)
    visits, _ = visits_of(track)
    assert names(visits).split() == ["E", "E"] + ["stay"] * stays
    # A robot that creeps, or turns round on the spot of its cell, does not stand.
    assert names(visits_of(walk((0.5, 0.5), (2.5, 0.5), speed=0.2))[0]) == "E E"


def test_standing_before_the_first_move_is_none() -> None:
    track = standing([(0.0, 0.5, 0.5)], 20.0)
    assert visits_of(track)[0] == []
    drive = [(20.0 + time, x, y) for time, x, y in walk((0.5, 0.5), (2.5, 0.5))]
    visits, _ = visits_of(track + drive)
    assert names(visits) == "E E"
    assert visits[0].stamp == pytest.approx(20 * SECOND, abs=1.1 * SECOND)


def test_trembling_on_an_edge_is_no_motion_but_standing_beyond_it_is() -> None:
    drive = walk((0.5, 0.5), (1.98, 0.5))
    end = drive[-1][0]
    trembling = [(end + each / 4, 2.0 + 0.04 * (-1) ** each, 0.5) for each in range(1, 40)]
    assert [visit.cell[0] for visit in visits_of(drive + trembling)[0]][:2] == [0, 1]
    assert set(names(visits_of(drive + trembling)[0]).split()) == {"E", "stay"}
    assert names(visits_of(drive + trembling)[0]).count("E") == 1
    beyond = standing([*drive, (end + 0.1, 2.04, 0.5)], 2.0)
    assert names(visits_of(beyond)[0]) == "E E"


def test_a_slow_crossing_of_a_cell_does_not_end_the_episode() -> None:
    circle = [
        (each * 0.25, 1.5 + 0.45 * math.cos(each / 5), 0.5 + 0.45 * math.sin(each / 5))
        for each in range(200)
    ]
    time = circle[-1][0]
    track = [(-1.0, 0.6, 0.5), *circle, (time + 1, 2.5, 0.5)]
    visits, _ = visits_of(track)
    assert sum(visit.led_by is None for visit in visits) == 1
    assert max(np.diff([visit.stamp for visit in visits])) <= 8 * SECOND


@pytest.mark.parametrize("moves", [4, 8])
@pytest.mark.parametrize(
    ("heading", "turn", "command", "action"),
    [
        (0.0, 0.0, (0.3, 0.0), "E"),
        (math.pi / 2, 0.0, (0.3, 0.0), "N"),
        (math.pi / 2, 0.0, (0.0, 0.3), "W"),
        (math.pi / 2, math.pi / 2, (0.3, 0.0), "E"),  # the map's own axes count
        (math.pi, 0.0, (-0.3, 0.01), "E"),
        (0.0, 0.0, (0.05, 0.0), "stay"),  # too slow to have got anywhere
        (0.0, 0.0, (0.0, 0.0), "stay"),
    ],
)
def test_intent_counts_where_the_robot_is_held_up(
    heading: float, turn: float, command: tuple[float, float], action: str, moves: int
) -> None:
    grid_map = GridMap(OPEN.free, 1.0, (0.0, 0.0, turn))
    (at,) = grid_map.centres_of([(3, 3)]).tolist()
    (start,) = grid_map.centres_of([(2, 3)]).tolist()
    discretiser = Discretiser(grid_map, SETTINGS, moves)
    visits = discretiser.follow(0, *start, heading) + discretiser.follow(SECOND, *at, heading)
    for tick in range(1, 35):
        discretiser.hear(*command)
        visits += discretiser.follow(SECOND + tick * SECOND // 10, *at, heading)
    assert names(visits) == f"E {action}"
    assert visits[-1].cell == (3, 3)


def test_a_command_does_not_hold_for_ever() -> None:
    discretiser = Discretiser(OPEN, replace(SETTINGS, command_hold=1.0))
    discretiser.follow(0, 2.5, 3.5)
    visits = discretiser.follow(SECOND, 3.5, 3.5)
    discretiser.hear(0.4, 0.0)  # for one second: 0.4 m, less than half a cell
    for tick in range(1, 35):
        visits += discretiser.follow(SECOND + tick * SECOND // 10, 3.5, 3.5)
    assert names(visits) == "E stay"


def test_what_cannot_be_used_is_counted() -> None:
    discretiser = Discretiser(OPEN, SETTINGS)
    assert discretiser.follow(0, math.nan, 1.0) == []
    assert discretiser.follow(0, 1.0, 1.0, math.inf) == []
    assert discretiser.follow(0, 8.5, 1.0) == []
    assert discretiser.follow(0, 1e300, 1.0) == []
    discretiser.hear(math.nan, 0.0)
    assert discretiser.faults == {
        "pose with a coordinate that is not finite": 2,
        "pose outside the map": 2,
        "velocity command that is not finite": 1,
    }


@pytest.mark.parametrize(
    ("given_settings", "says"),
    [
        ({"dwell": 10.0}, r"dwell must be below longest_silence, 10 s, not 10"),
        ({"dwell": 0.0}, r"dwell must be above 0, not 0"),
        ({"robot_radius": -0.1}, r"robot_radius must be at least 0, not -0.1"),
        ({"start": "1,2"}, r"start must be x,y,heading in m, m and rad, not '1,2'"),
        ({"start": "1,2,nan"}, r"start must be x,y,heading"),
        ({"planning_resolution": "wide"}, r"planning_resolution must be of type float"),
    ],
)
def test_wrong_settings_are_named(given_settings: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Discretising(**given_settings)  # type: ignore[arg-type]


def test_a_start_is_read() -> None:
    assert Discretising(start="3.9, 5.4,-1").start_pose == (3.9, 5.4, -1.0)
