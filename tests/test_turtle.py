"""The turtle is driven again as its commands say, and its drive becomes a demonstration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.qos import RELIABLE
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.motion import fill_jumps
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.demonstrations.velocity import TICK
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.turtle import (
    SIDE,
    TOPIC,
    TYPE,
    WAYPOINTS,
    drive,
    read_commands,
    read_turtle,
)
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.views.messages import Twist, Vector3

RECORDING = SHARED_BAGS / "turtle_waypoints"
SHIPPED = Path(__file__).resolve().parents[1] / "bags" / "turtle_waypoints"

MIDDLE = (5.0, 5.0, 0.0)


def driven(
    times: list[float],
    commands: list[tuple[float, float, float]],
    start: tuple[float, float, float] = MIDDLE,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """`drive` of lists."""
    return drive(np.array(times), np.array(commands), start)


def record(folder: Path, commands: list[tuple[float, float, float]], topic: str = TOPIC) -> Path:
    """A recording with a command for each second."""
    with BagWriter(folder) as writer:
        writer.add_topic(topic, TYPE, RELIABLE)
        for second, (forwards, left, rate) in enumerate(commands):
            message = Twist(linear=Vector3(x=forwards, y=left), angular=Vector3(z=rate))
            writer.write(topic, message, second * 1_000_000_000)
    return folder


def test_a_straight_drive_goes_where_the_robot_is_headed() -> None:
    times, positions = driven(
        [3.0, 3.5], [(2.0, 0.0, 0.0), (0.0, -1.0, 0.0)], (5.0, 5.0, np.pi / 6)
    )
    assert times[0] == 3.0
    assert times[-1] == pytest.approx(4.5)
    assert np.diff(times).max() == pytest.approx(TICK)
    middle = np.array([5.0 + np.sqrt(3) / 2, 5.5])
    np.testing.assert_allclose(positions[np.searchsorted(times, 3.5 - 1e-9)], middle)
    # To the right of a robot that is headed 30 degrees to the left.
    np.testing.assert_allclose(positions[-1], middle + np.array([0.5, -np.sqrt(3) / 2]))


def test_a_drive_along_an_arc_is_exact() -> None:
    times, positions = driven(
        [0.0, 1.0, 1.5], [(1.5, 0.0, np.pi), (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)]
    )
    radius = 1.5 / np.pi
    angle = np.pi * np.minimum(times, 1.0)
    arc = np.column_stack([5.0 + radius * np.sin(angle), 5.0 + radius * (1.0 - np.cos(angle))])
    before = times <= 1.5 + 1e-9
    np.testing.assert_allclose(positions[before], arc[before])
    np.testing.assert_allclose(positions[-1], (3.0, 5.0 + 2 * radius))


def test_a_command_holds_for_a_second_at_most() -> None:
    commands = [(1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.0, np.pi / 2)]
    times, positions = driven([0.0, 4.0, 4.5], commands)
    np.testing.assert_allclose(np.interp([0.5, 1.0, 3.9], times, positions[:, 0]), [5.5, 6.0, 6.0])
    assert times[-1] == pytest.approx(5.5)
    np.testing.assert_allclose(positions[-1], (7.0 + 2 / np.pi, 5.0 + 2 / np.pi))


def test_the_robot_slides_along_the_edges_of_its_square() -> None:
    times, positions = driven([0.0], [(3.0, 0.0, 0.0)], (10.0, 5.0, np.pi / 4))
    along = 3.0 * times / np.sqrt(2)
    np.testing.assert_allclose(positions[:, 0], np.minimum(10.0 + along, SIDE))
    np.testing.assert_allclose(positions[:, 1], 5.0 + along)


def test_jumps_are_filled_along_the_line() -> None:
    cells = np.array([[0, 0], [0, 0], [3, 1], [3, 1], [3, -1], [2, -2], [2, -2]])
    filled = [[0, 0], [1, 0], [2, 1], [3, 1], [3, 0], [3, -1], [2, -2]]
    assert fill_jumps(cells).tolist() == filled
    assert fill_jumps(cells[:1]).tolist() == [[0, 0]]


def test_changes_of_cell_become_observations(tmp_path: Path) -> None:
    bag = record(tmp_path / "bag", [(0.0, 0.0, 0.0), (1.0, 0.0, np.pi / 2), (0.0, 0.0, 1.0)])
    demonstration, grid_map = read_turtle(bag)
    # A quarter of a circle from (3.9, 5.4) to (4.54, 6.04).
    assert demonstration.cells.tolist() == [[7, 10], [8, 10], [8, 11], [9, 11]]
    names = [ACTION_NAMES[action] for action in demonstration.action]
    assert names == ["E", "N", "E", "N"]
    assert demonstration.episode.tolist() == [0, 0, 0, 0]
    assert demonstration.last_episode.tolist() == [0]
    assert demonstration.last_cells.tolist() == [[9, 12]]
    assert grid_map.free.shape == (23, 23)
    assert grid_map.free.all()
    assert (grid_map.resolution, grid_map.origin, grid_map.frame_id) == (0.5, (0, 0, 0), "map")
    # The far edge belongs to the square.
    _, in_one = read_turtle(record(tmp_path / "far", [(20.0, 0.0, 0.0)]), SIDE)
    assert in_one.free.shape == (2, 2)


@pytest.mark.parametrize(
    ("commands", "topic", "says"),
    [
        ([(1.0, 0.0, 0.0)], "/cmd_vel", r"bag: has no topic /turtlesim1/turtle1/cmd_vel "),
        ([], TOPIC, r"bag: has no commands, or not all are numbers; "),
        ([(np.nan, 0.0, 0.0)], TOPIC, r"bag: has no commands, or not all are numbers; "),
        ([(0.0, 0.0, 1.0)], TOPIC, r"bag: the robot never leaves a cell of 0.5 m; "),
    ],
)
def test_wrong_recordings_are_named(
    tmp_path: Path, commands: list[tuple[float, float, float]], topic: str, says: str
) -> None:
    with pytest.raises(InputError, match=says):
        read_turtle(record(tmp_path / "bag", commands, topic))


def test_damaged_and_missing_recordings_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: does not exist; "):
        read_turtle(tmp_path / "nowhere")
    (file,) = record(tmp_path / "bag", [(1.0, 0.0, 0.0)] * 99).glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"is damaged .*; name the whole recording"):
        read_turtle(tmp_path / "bag")


@needs_shared_bags
def test_the_recorded_drive_passes_the_waypoints_in_the_authors_order() -> None:
    times, positions = drive(*read_commands(RECORDING))
    away = np.linalg.norm(positions[:, None] - WAYPOINTS, axis=2)
    first_lap = away[times < 56.0]
    nearest = first_lap.argmin(axis=0)
    np.testing.assert_allclose(times[nearest], [0.0, 16.0, 26.2, 33.6, 44.5, 50.1], atol=0.1)
    distances = first_lap[nearest, np.arange(len(WAYPOINTS))]
    np.testing.assert_allclose(distances, [0.0, 0.003, 0.279, 0.296, 0.265, 0.454], atol=0.001)
    # It halts at the first one again, and breaks off in its second lap on the way to the fifth.
    np.testing.assert_allclose(away[(times > 59.4) & (times < 61.5), 0], 0.283, atol=0.001)
    assert (away[times > 61.6].min(axis=0) < 1.0).tolist() == [True] * 4 + [False] * 2


@needs_shared_bags
def test_the_shipped_bag_is_the_recorded_drive() -> None:
    demonstration, grid_map = read_turtle(RECORDING)
    recorded = read_demonstration(SHIPPED, {})
    assert recorded.grid_map is not None
    placed = place(recorded.recording, recorded.grid_map).demonstration
    np.testing.assert_array_equal(placed.observations, demonstration.observations)
    np.testing.assert_array_equal(placed.last_cells, demonstration.last_cells)
    np.testing.assert_array_equal(recorded.grid_map.free, grid_map.free)
    assert recorded.grid_map.resolution == grid_map.resolution
