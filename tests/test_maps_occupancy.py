"""What counts as free, what no map can be, and the way between cells and metres."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap, map_from_occupancy, occupancy_of, yaw_of

ORIGIN = (0.0, 0.0, 0.0)


def grid_map(data: list[int], width: int, height: int, **changes: object) -> GridMap:
    arguments = {"resolution": 1.0, "origin": ORIGIN, "frame_id": "map", "source": "/map"}
    return map_from_occupancy(data, width, height, **(arguments | changes))  # type: ignore[arg-type]


def test_below_50_is_free_and_anything_else_is_blocked():
    values = [0, 1, 49, 50, 51, 100, -1, -128, 127]
    free = grid_map(values, len(values), 1).free
    assert free.tolist() == [[True, True, True, False, False, False, False, False, False]]


def test_the_first_row_of_the_data_is_the_lowest_y():
    free = grid_map([0, 100, 100, 100, 100, 0], 2, 3).free
    assert free.tolist() == [[True, False], [False, False], [False, True]]


def test_occupancy_of_undoes_map_from_occupancy():
    data = [0, 100, 100, 0, 0, 100]
    occupancy = occupancy_of(grid_map(data, 3, 2))
    assert occupancy.dtype == np.int8
    assert occupancy.tolist() == data


@pytest.mark.parametrize(
    ("data", "width", "height", "changes", "says"),
    [
        ([100, -1], 2, 1, {}, "no cell of the map is free"),
        ([0, 0, 0], 2, 2, {}, "says 2 x 2 cells but has 3 values"),
        ([], 0, 4, {}, "0 x 4 cells"),
        ([], 4, 0, {}, "4 x 0 cells"),
        ([0], 2**32 - 1, 2**32 - 1, {}, "more than the 50000000"),
        ([0], 1, 1, {"resolution": 0.0}, "resolution is 0.0 m"),
        ([0], 1, 1, {"resolution": -0.05}, "resolution is -0.05 m"),
        ([0], 1, 1, {"resolution": math.nan}, "resolution is nan m"),
        ([0], 1, 1, {"resolution": math.inf}, "resolution is inf m"),
        ([0], 1, 1, {"origin": (0.0, math.nan, 0.0)}, r"origin \(x, y, yaw\) is \(0.0, nan"),
        ([0], 1, 1, {"origin": (0.0, 0.0, math.inf)}, "must be finite"),
    ],
)
def test_what_no_map_can_be_is_refused_in_one_sentence(data, width, height, changes, says):
    with pytest.raises(InputError, match=says) as caught:
        grid_map(data, width, height, **changes)
    sentence = str(caught.value)
    assert sentence.startswith("/map: ")
    assert not sentence.endswith(".")
    assert "\n" not in sentence


@given(yaw=st.floats(-math.pi, math.pi), length=st.floats(0.1, 10.0))
def test_yaw_of_a_quaternion_of_any_length(yaw, length):
    half = yaw / 2
    found = yaw_of(0.0, 0.0, length * math.sin(half), length * math.cos(half), "/map")
    assert math.cos(found - yaw) == pytest.approx(1.0)


def test_a_quaternion_left_at_zero_is_no_rotation():
    assert yaw_of(0.0, 0.0, 0.0, 0.0, "/map") == 0.0


def test_yaw_is_what_the_x_axis_does_when_the_map_is_tilted_too():
    # Roll by a, then yaw by b: the x axis still points along b.
    a, b = 0.7, 2.1
    x, y = math.sin(a / 2) * math.cos(b / 2), math.sin(a / 2) * math.sin(b / 2)
    z, w = math.cos(a / 2) * math.sin(b / 2), math.cos(a / 2) * math.cos(b / 2)
    assert yaw_of(x, y, z, w, "/map") == pytest.approx(b)


def test_a_quaternion_that_is_not_finite_is_refused():
    with pytest.raises(InputError, match=r"^/map: the orientation .*nan.* finite numbers$"):
        yaw_of(0.0, 0.0, math.nan, 1.0, "/map")


@st.composite
def placed_maps(draw: st.DrawFn) -> GridMap:
    finite = st.floats(-1e4, 1e4)
    origin = (draw(finite), draw(finite), draw(st.floats(-2 * math.pi, 2 * math.pi)))
    return GridMap(np.ones((7, 11), dtype=bool), draw(st.floats(0.01, 10.0)), origin)


@given(placed=placed_maps(), cell=st.tuples(st.integers(-50, 50), st.integers(-50, 50)))
def test_the_centre_of_a_cell_lies_in_the_cell(placed, cell):
    assert placed.cells_of(placed.centres_of([cell])).tolist() == [list(cell)]


@given(
    placed=placed_maps(),
    cell=st.tuples(st.integers(-50, 50), st.integers(-50, 50)),
    within=st.tuples(st.floats(-0.49, 0.49), st.floats(-0.49, 0.49)),
)
def test_every_place_within_a_cell_is_that_cell(placed, cell, within):
    place = placed.centres_of([np.add(cell, within)])
    assert placed.cells_of(place).tolist() == [list(cell)]
    distance = np.linalg.norm(place - placed.centres_of([cell]))
    assert distance <= placed.resolution * math.sqrt(0.5) + 1e-9


def test_a_quarter_turn_points_the_x_axis_of_the_map_up():
    placed = GridMap(np.ones((2, 3), dtype=bool), 0.5, (10.0, 20.0, math.pi / 2))
    assert placed.centres_of([[2, 0]]) == pytest.approx(np.array([[9.75, 21.25]]))
