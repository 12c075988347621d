"""Recording, pairing, episodes, placement: the same demonstration live and offline."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bnirl_ros.demonstrations.pairing import pair_by_stamp
from bnirl_ros.demonstrations.placement import episode_starts, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.maps.grid_map import GridMap

SECOND = 1_000_000_000
MAP = GridMap(np.ones((5, 5), dtype=bool))
EAST = (1.0, 0.0)


def walked_east(recorder: Recorder, start: int, y: float = 0.5, last_pose: bool = True) -> None:
    """Four cells to the east, an action in each, and the pose where the last one led."""
    for step in range(5 if last_pose else 4):
        recorder.add_pose(start + step * SECOND, "map", step + 0.5, y)
        if step < 4:
            recorder.add_action(start + step * SECOND, *EAST)


def test_a_walk_is_an_episode_with_its_last_pose() -> None:
    recorder = Recorder()
    walked_east(recorder, 0)
    placement = place(recorder.snapshot(), MAP)
    demonstration = placement.demonstration
    assert demonstration.observations.tolist() == [[0, x, 0, 1] for x in range(4)]
    assert demonstration.last_cells.tolist() == [[4, 0]]
    assert not placement.faults


def test_episodes_end_at_gaps_jumps_back_and_jumps_in_space() -> None:
    stamps = np.array([0, 1, 3, 6, 5, 6, 7], dtype=np.int64) * SECOND
    cells = np.array([[0, 0], [1, 1], [1, 1], [1, 1], [1, 1], [1, 2], [3, 2]])
    starts = episode_starts(stamps, cells, 2.0)
    assert starts.tolist() == [True, False, False, True, True, False, True]


def test_both_walks_count_with_last_poses_and_numbers_from_zero() -> None:
    recorder = Recorder()
    recorder.add_pose(0, "map", 2.5, 2.5)  # a pose alone is no episode
    walked_east(recorder, 100 * SECOND)
    walked_east(recorder, 200 * SECOND, y=1.5, last_pose=False)
    placement = place(recorder.snapshot(), MAP)
    assert placement.demonstration.episode.tolist() == [0] * 4 + [1] * 4
    assert placement.demonstration.last_episode.tolist() == [0]
    assert placement.faults == {"pose without an action of its stamp": 1}


@given(st.randoms(use_true_random=False))
def test_interleaving_of_the_topics_does_not_matter(random: object) -> None:
    messages = [("pose", k) for k in range(20)] + [("action", k) for k in range(20)]
    picks = [random.random() for _ in messages]  # type: ignore[attr-defined]
    # keep each topic's own order, mix the two in any way
    order = sorted(range(40), key=lambda index: (picks[index],))
    poses = iter([m for m in messages if m[0] == "pose"])
    actions = iter([m for m in messages if m[0] == "action"])
    mixed = [next(poses) if messages[index][0] == "pose" else next(actions) for index in order]
    recorder = Recorder()
    for kind, k in mixed:
        stamp = (k % 10) * SECOND  # the bag was played twice
        if kind == "pose":
            recorder.add_pose(stamp, "map", 0.5 + k % 5, 0.5)
        else:
            recorder.add_action(stamp, float(k % 3 - 1), float(k // 10))
    demonstration = place(recorder.snapshot(), MAP).demonstration
    steps = [(k % 3 - 1, k // 10) for k in range(20)]
    expected = [[(-1, 0), (0, 0), (1, 0), (-1, 1), (0, 1), (1, 1)].index(s) for s in steps]
    names = [5, 0, 1, 4, 3, 2]  # W stay E NW N NE
    assert demonstration.action.tolist() == [names[index] for index in expected]


any_stamps = st.lists(st.integers(0, 6), max_size=12)
in_order = st.sets(st.integers(0, 6)).map(sorted)


@given(
    *[
        (any_stamps | in_order).map(lambda stamps: np.array(stamps, dtype=np.int64))
        for _ in range(2)
    ]
)
def test_pairs_have_equal_stamps_and_are_as_many_as_can_be(
    stamps: np.ndarray, others: np.ndarray
) -> None:
    first, second = pair_by_stamp(stamps, others)
    assert (stamps[first] == others[second]).all()
    assert len(set(first.tolist())) == len(set(second.tolist())) == len(first)
    assert first.tolist() == sorted(first.tolist())
    most = sum(min(np.sum(stamps == v), np.sum(others == v)) for v in range(7))
    assert len(first) == most


def test_a_lost_message_never_shifts_the_pairs() -> None:
    recorder = Recorder()
    for step in range(5):
        if step != 2:
            recorder.add_action(step * SECOND, float(step % 2), 0.0)
        recorder.add_pose(step * SECOND, "map", step + 0.5, 0.5)
    recorder.add_action(77 * SECOND, 0.0, 0.0)
    placement = place(recorder.snapshot(), MAP)
    assert placement.demonstration.action.tolist() == [0, 1, 1, 0]
    assert placement.demonstration.cells[:, 0].tolist() == [0, 1, 3, 4]
    assert placement.faults == {
        "pose without an action of its stamp": 1,
        "action without a pose of its stamp": 1,
    }


def test_what_cannot_be_used_is_refused_and_counted() -> None:
    recorder = Recorder()
    walked_east(recorder, 0)
    assert recorder.add_pose(0, "map", float("nan"), 0.0)
    assert recorder.add_pose(0, "map", 0.0, float("-inf"))
    assert recorder.add_action(0, 0.5, 0.0)
    assert recorder.add_action(0, 2.0, 0.0)
    assert recorder.add_action(0, float("nan"), 0.0)
    assert recorder.faults == {
        "pose with a coordinate that is not finite": 2,
        "action that is no unit step": 3,
    }
    recorder.add_pose(50 * SECOND, "odom", 0.5, 0.5)
    recorder.add_pose(51 * SECOND, "map", 9.5, 0.5)
    recorder.add_pose(52 * SECOND, "map", 0.5, 0.5)
    for stamp in (50, 51, 52):
        recorder.add_action(stamp * SECOND, 1.0, 1.0)
    free = MAP.free.copy()
    free[0, 0] = False
    placement = place(recorder.snapshot(), GridMap(free), moves=4)
    assert placement.demonstration.cells.tolist() == [[1, 0], [2, 0], [3, 0]]
    assert placement.faults == {
        "pose in another frame than the map": 1,
        "action without a pose of its stamp": 1,
        "pose outside the map": 1,
        "pose in a blocked cell": 2,
        "action that is none of the 4 moves": 2,
    }


def test_a_new_map_puts_the_same_metres_on_other_cells() -> None:
    recorder = Recorder()
    walked_east(recorder, 0)
    moved = GridMap(np.ones((8, 8), dtype=bool), origin=(-2.0, -1.0, 0.0))
    demonstration = place(recorder.snapshot(), moved).demonstration
    assert demonstration.cells.tolist() == [[x + 2, 1] for x in range(4)]
    finer = GridMap(np.ones((20, 20), dtype=bool), resolution=0.25)
    placement = place(recorder.snapshot(), finer)  # the cells are no neighbours any more
    assert len(np.unique(placement.demonstration.episode)) == 4


def test_messages_before_the_map_wait_in_a_bounded_buffer() -> None:
    recorder = Recorder(waiting_limit=3)
    walked_east(recorder, 0)
    assert sum(recorder.faults.values()) == 2 + 1
    assert len(recorder) == 6
    recorder.map_arrived()
    assert recorder.add_pose(9 * SECOND, "map", 0.5, 0.5) is None


def test_nothing_recorded_is_an_empty_demonstration() -> None:
    placement = place(Recorder().snapshot(), MAP)
    assert len(placement.demonstration) == 0
    assert not placement.faults


def test_clear_forgets_everything() -> None:
    recorder = Recorder()
    walked_east(recorder, 0)
    recorder.add_action(0, 7.0, 0.0)
    recorder.clear()
    assert len(recorder) == 0
    assert not recorder.faults
    assert len(place(recorder.snapshot(), MAP).demonstration) == 0


# Forgetting


@given(
    limit=st.integers(1, 30),
    order=st.lists(st.sampled_from(["both", "pose", "action", "action first"]), max_size=120),
    period=st.integers(5, 200),
)
def test_of_too_much_the_oldest_is_forgotten_and_the_rest_is_as_if_it_was_all(
    limit: int, order: list[str], period: int
) -> None:
    """Stamps go back once in a while, as in a replay that loops."""
    bounded, whole = Recorder(limit=limit), Recorder()
    drained: list[int] = []
    for number, what in enumerate(order):
        stamp = number % period
        parts = {"both": "pa", "pose": "p", "action": "a", "action first": "ap"}[what]
        for recorder in (bounded, whole):
            for part in parts:
                if part == "p":
                    recorder.add_pose(stamp, "map", float(number), 0.0)
                else:
                    recorder.add_action(stamp, 1.0, 0.0)
        if number % 3 == 0:
            drained += bounded.drain().positions[:, 0].astype(int).tolist()
    left, all_of_it = bounded.snapshot(), whole.snapshot()
    poses, actions = left.forgotten
    assert len(bounded) == len(whole) == left.messages == all_of_it.messages
    assert max(len(left.pose_stamps), len(left.actions)) <= limit
    np.testing.assert_array_equal(left.positions, all_of_it.positions[poses:])
    np.testing.assert_array_equal(left.action_stamps, all_of_it.action_stamps[actions:])
    assert sum(bounded.faults.values()) == poses + actions
    # What is drained in time is drained whole, forgotten or not.
    drained += bounded.drain().positions[:, 0].astype(int).tolist()
    if limit >= 6:
        assert drained == all_of_it.positions[:, 0].astype(int).tolist()


def test_poses_that_are_kept_keep_their_actions_and_their_numbers() -> None:
    bounded, whole = Recorder(limit=100), Recorder()
    for recorder in (bounded, whole):
        for number in range(350):
            stamp = number * 500_000_000
            recorder.add_pose(stamp, "map", 0.5 + number % 2, 0.5)
            if number % 10:
                recorder.add_action(stamp, 1.0 - 2.0 * (number % 2), 0.0)
    grid_map = GridMap(np.ones((1, 2), dtype=bool))
    some, everything = (place(each.snapshot(), grid_map) for each in (bounded, whole))
    assert 70 < len(some.poses) <= 100
    assert some.messages == everything.messages
    known = np.isin(everything.poses, some.poses)
    np.testing.assert_array_equal(everything.poses[known], some.poses)
    np.testing.assert_array_equal(everything.demonstration.cells[known], some.demonstration.cells)
    np.testing.assert_array_equal(
        everything.demonstration.action[known], some.demonstration.action
    )
    assert known[np.argmax(known) :].all()
    assert some.faults["action without a pose of its stamp"] == 0
