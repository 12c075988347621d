"""What a robot publishes, taken in as it comes, becomes what a bag of it becomes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.cdr import decode
from bnirl_ros.bags.raw_demonstration import read_raw_demonstration
from bnirl_ros.bags.reader import Bag
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.live import LiveMotion, News
from bnirl_ros.demonstrations.motion import Discretiser, Visit, record
from bnirl_ros.demonstrations.placement import episode_starts
from bnirl_ros.demonstrations.raw_messages import (
    Command,
    RawPose,
    brought,
    command_of,
    pose_of,
)
from bnirl_ros.demonstrations.recording import Recorder, Recording
from bnirl_ros.demonstrations.velocity import TICK, CommandFollower, FollowedPose, follow
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.turtle import TOPIC
from bnirl_ros.maps import GridMap, load_map
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.views.demonstration import visit_messages
from bnirl_ros.views.messages import Quaternion
from demonstration_support import SECOND
from test_discretiser_frames import transform
from test_discretiser_motion import OPEN, SETTINGS, Track, grids, tracks, walk

FREE = GridMap(np.ones((80, 80), dtype=bool), 0.1, (0.0, 0.0, 0.0), "map")
"""8 m square, finer than the planning map."""

PLAN = Discretising(planning_resolution=1.0, dwell=3.0, longest_silence=8.0, longest_jump=4.0)


def pose(time: float, x: float, y: float, frame_id: str = "map") -> RawPose:
    return RawPose(round(time * SECOND), frame_id, (x, y, 0.0), 0.0)


def recorded(visits: Iterable[Visit], frame_id: str = "map") -> Recording:
    """The visits as whoever has them as messages has them."""
    recorder = Recorder()
    recorder.map_arrived()
    for visit in visits:
        record(recorder, visit, frame_id)
    return recorder.snapshot()


def followed(discretiser: Discretiser, track: Track, intent: float = 0.0) -> list[Visit]:
    """The visits of a track, to whose every pose one is commanded forwards so fast."""
    visits = []
    for time, x, y in track:
        discretiser.hear(intent, 0.0)
        visits += discretiser.follow(round(time * SECOND), x, y)
    return visits


def all_of(news: Iterable[News]) -> list[Visit]:
    return [visit for each in news for visit in each.visits]


commands = st.lists(
    st.tuples(
        st.integers(0, 3_000_000_000)
        | st.sampled_from([16_000_000, SECOND, 2 * SECOND, 5 * SECOND]),
        st.builds(Command, *[st.floats(-2, 2)] * 3),
    ),
    max_size=8,
).map(
    lambda each: list(
        zip(
            np.cumsum([pause for pause, _ in each], dtype=np.int64).tolist(),
            [command for _, command in each],
            strict=True,
        )
    )
)


def follower(hold: float = 1.0, silence: float = 2.0) -> CommandFollower:
    return CommandFollower((1.0, 2.0, 3.0), hold, silence)


@given(heard=commands, moments=st.lists(st.integers(0, 10_000_000_000), max_size=8))
def test_commands_lead_to_the_same_poses_whenever_one_looks(
    heard: list[tuple[int, Command]], moments: list[int]
) -> None:
    live, poses = follower(), []
    waiting = sorted(moments)
    for stamp, command in heard:
        while waiting and waiting[0] <= stamp:
            poses += live.advance(waiting.pop(0))
        poses += live.hear(stamp, command)
    for moment in waiting:
        poses += live.advance(moment)
    whole = follow(heard, follower())
    assert poses + live.finish() == whole
    assert all(before.stamp < after.stamp for before, after in pairwise(whole))
    assert {stamp for stamp, _ in heard} <= {pose.stamp for pose in whole}
    # Nobody knows what happened after a command that was the last one for long.
    gaps = [
        (stamp + SECOND, after)
        for (stamp, _), (after, _) in pairwise(heard)
        if after - stamp > 2 * SECOND
    ]
    for before, after in pairwise(whole):
        is_gap = (before.stamp, after.stamp) in gaps
        assert is_gap or after.stamp - before.stamp <= TICK * SECOND
    for low, high in gaps:
        assert not [pose for pose in whole if low < pose.stamp < high]


def test_late_and_useless_commands_do_not_corrupt_the_way() -> None:
    ahead, turn = Command(1.0, 0.0, 0.0), Command(0.0, 1.0, 0.0)
    late = CommandFollower((0.0, 0.0, 0.0), 1.0, 5.0)
    poses = late.hear(0, ahead) + late.advance(SECOND // 2)
    poses += late.hear(SECOND // 4, turn)  # it was under way while half a second was followed
    assert late.hear(SECOND // 5, ahead) == []
    assert late.hear(SECOND // 4, Command(math.nan, 0.0, 0.0)) == []
    poses += late.hear(SECOND // 4, turn) + late.finish()
    assert poses[-1] == pytest.approx((5 * SECOND // 4, 0.25, 1.0, 0.0))
    assert all(before.stamp < after.stamp for before, after in pairwise(poses))
    assert late.faults == {
        "velocity command that is older than the one before": 1,
        "velocity command that is not finite": 1,
    }
    # Stamps that go far back are those of a recording that begins anew.
    late.hear(20 * SECOND, ahead)
    assert late.hear(0, turn) == [FollowedPose(0, 0.0, 0.0, 0.0)]
    late.restart()
    assert late.advance(9 * SECOND) == []
    assert late.hear(SECOND, turn) == [FollowedPose(SECOND, 0.0, 0.0, 0.0)]
    # No number is so large that it would be an error.
    huge = CommandFollower((0.0, 0.0, 0.0), 1.0)
    assert follow([(each * SECOND, Command(1e308, -1e308, 1e308)) for each in range(4)], huge)


@given(
    track=tracks,
    cut=st.integers(0, 12),
    grid_map=grids,
    other=grids,
    shift=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    turn=st.sampled_from([0.0, 0.7]),
    jumps=st.booleans(),
)
def test_a_new_map_midway_keeps_what_was_seen_where_it_was(
    track: Track,
    cut: int,
    grid_map: GridMap,
    other: GridMap,
    shift: tuple[float, float],
    turn: float,
    jumps: bool,
) -> None:
    later = GridMap(other.free, 1.0, (*shift, turn))
    discretiser = Discretiser(grid_map, SETTINGS)
    visits = followed(discretiser, track[:cut])
    before = len(visits)
    discretiser.use_map(later)
    if jumps:
        discretiser.begin_episode()
    visits += followed(discretiser, track[max(cut - 1, 0) :])
    # Whoever puts the visits on the new map by metres tells the same episodes and steps.
    stamps = np.array([visit.stamp for visit in visits], dtype=np.int64)
    cells = later.cells_of(np.array([visit.position for visit in visits]).reshape(-1, 2))
    for number in range(max(before, 1), len(visits)):
        visit, two = visits[number], slice(number - 1, number + 1)
        assert visit.cell == tuple(cells[number])
        starts = episode_starts(stamps[two], cells[two], SETTINGS.longest_silence)
        assert starts[1] == (visit.led_by is None)
        if visit.led_by:
            assert visit.led_by[0] == stamps[number - 1]
            assert (STEPS[visit.led_by[1]] == np.diff(cells[two], axis=0)).all()
    # It was there, so these cells are open, and of the others none is that was not.
    assert discretiser.grid_map.is_free(cells[later.contains(cells)]).all()
    opened = {(int(x), int(y)) for y, x in np.argwhere(discretiser.grid_map.free & ~later.free)}
    assert opened == set(discretiser.opened)


@given(
    track=tracks,
    cut=st.integers(0, 12),
    back=st.sampled_from([0.0, 0.2, 1.0, 5.0, 30.0]),
    intends=st.booleans(),
)
def test_after_a_jump_of_the_clock_another_episode_begins(
    track: Track, cut: int, back: float, intends: bool
) -> None:
    discretiser = Discretiser(OPEN, SETTINGS)
    visits = followed(discretiser, track[:cut])
    before = len(visits)
    discretiser.begin_episode()
    after = [(time - back, x, y) for time, x, y in track[max(cut - 1, 0) :]]
    visits += followed(discretiser, after, 0.8 if intends else 0.0)
    assert all(visit.led_by is None for visit in visits[before : before + 1])
    # The stamps tell that to anyone who ends episodes where poses are as far apart as here.
    cells = np.array([visit.cell for visit in visits]).reshape(-1, 2)
    stamps = np.array([visit.stamp for visit in visits], dtype=np.int64)
    starts = episode_starts(stamps, cells, SETTINGS.longest_silence)
    assert starts.tolist() == [visit.led_by is None for visit in visits]


def test_a_jump_by_little_is_told_by_the_stamps() -> None:
    discretiser = Discretiser(OPEN, SETTINGS)
    there = walk((0.5, 0.5), (2.5, 0.5))
    visits = followed(discretiser, there)
    # It stands where it was until the clock has caught up, and sets out for the next cell.
    discretiser.begin_episode()
    end = there[-1][0]
    drive = [(end - 0.1, 2.5, 0.5), (end + 1.0, 2.5, 0.5), (end + 2.0, 3.5, 0.5)]
    after = followed(discretiser, drive)
    assert [visit.cell for visit in after] == [(2, 0), (3, 0)]
    assert after[0].led_by is None
    assert after[0].stamp == visits[-1].stamp - 1
    # Or it is held up there. The visit that is stamped so early is no longer ago than any.
    discretiser.begin_episode()
    held = followed(discretiser, [(end + 8.0 + t / 2, 3.5, 0.5) for t in range(12)], 0.8)
    assert [visit.led_by is None for visit in held[:2]] == [True, False]
    assert 0 <= held[1].stamp - held[0].stamp <= 8 * SECOND


def test_who_is_off_the_new_map_begins_an_episode() -> None:
    drive = walk((0.5, 2.5), (2.5, 2.5))
    end = drive[-1][0]
    glance = [(end + 0.1, 7.5, 7.5)]  # for a moment it seemed to be on the map
    for low, seen in ((2.0, drive), (3.0, drive), (2.0, drive + glance), (3.0, drive + glance)):
        discretiser = Discretiser(OPEN, SETTINGS)
        visits = followed(discretiser, seen)
        discretiser.use_map(GridMap(OPEN.free, 1.0, (3.0, low, 0.0)))
        further = [(end + 0.5, 3.5, low + 0.5), (end + 3.0, 4.5, low + 0.5)]
        after = followed(discretiser, further)
        assert [visit.cell for visit in after] == [(0, 0), (1, 0)]
        assert after[0].led_by is None
        assert after[0].stamp < visits[-1].stamp
        assert discretiser.grid_map.free.all()
    # In another frame nothing of before has a place.
    discretiser.use_map(replace(OPEN, frame_id="elsewhere"))
    elsewhere = followed(discretiser, [(end + 3.5, 4.5, 3.5), (end + 4.0, 5.5, 3.5)])
    assert [visit.led_by is None for visit in elsewhere] == [True, False]
    assert elsewhere[0].stamp > after[-1].stamp


def test_a_map_is_taken_again_only_if_it_is_new() -> None:
    live = LiveMotion(PLAN)
    first = live.take_map(FREE)
    assert first.grid_map is live.grid_map
    assert first.grid_map is not None
    assert first.grid_map.free.shape == (8, 8)
    assert live.take_map(replace(FREE, free=FREE.free.copy())) == News()
    visits = all_of(live.take_pose(pose(*at)) for at in walk((0.5, 0.5), (3.5, 0.5)))
    assert [visit.cell for visit in visits] == [(0, 0), (1, 0), (2, 0), (3, 0)]
    # SLAM has seen more on the left and below, not by whole cells: those that there are stay.
    wider = GridMap(np.ones((93, 87), dtype=bool), 0.1, (-0.7, -1.3, 0.0), "map")
    news = live.take_map(wider)
    assert news.grid_map is not None
    assert news.grid_map.origin == pytest.approx((-1.0, -2.0, 0.0))
    further = [(6.0 + time, x, y) for time, x, y in walk((3.5, 0.5), (5.5, 0.5))]
    visits = all_of(live.take_pose(pose(*at)) for at in further)
    assert [visit.cell for visit in visits] == [(5, 2), (6, 2)]
    assert [visit.led_by is None for visit in visits] == [False, False]
    # What the planning map does not show makes no new one.
    seen = wider.free.copy()
    seen[-1, -1] = False
    assert live.take_map(replace(wider, free=seen)) == News()
    # A robot that fits nowhere has the wrong radius, or the wrong map: the one before stays.
    blocked = LiveMotion(replace(PLAN, robot_radius=9.0))
    narrow = replace(FREE, free=np.pad(np.ones((78, 78), dtype=bool), 1))
    (warning,) = blocked.take_map(narrow).warnings
    assert "the map has no place for a robot with a radius of 9 m" in warning
    assert blocked.grid_map is None
    assert blocked.faults == {warning: 1}


def test_what_comes_before_the_first_map_waits() -> None:
    drive = [pose(*at) for at in walk((0.5, 0.5), (2.5, 0.5))]
    late, early = LiveMotion(PLAN), LiveMotion(PLAN)
    assert all(late.take_pose(each) == News() for each in drive)
    assert (late.waiting, late.poses) == (len(drive), 0)
    early.take_map(FREE)
    news = late.take_map(FREE)
    assert list(news.visits) == all_of(early.take_pose(each) for each in drive)
    assert (late.waiting, late.poses, late.visits) == (0, len(drive), 3)
    few = LiveMotion(PLAN, waiting_limit=10)
    for each in drive:
        few.take_pose(each)
    fault = "pose or command before the first map, when the buffer was full"
    assert few.faults == {fault: len(drive) - 10}


def test_cells_that_are_opened_make_a_new_map() -> None:
    free = FREE.free.copy()
    free[:15, 20:30] = False
    live = LiveMotion(replace(PLAN, robot_radius=0.05))
    live.take_map(replace(FREE, free=free))
    news = [live.take_pose(pose(*at)) for at in walk((0.5, 0.5), (3.5, 0.5))]
    changed = [each for each in news if each.grid_map is not None]
    assert len(changed) == live.opened == 1
    assert changed[0].grid_map is live.grid_map
    assert changed[0].visits[-1].cell == (2, 0)
    (warning,) = changed[0].warnings
    assert warning.endswith("was in 1 blocked cells of 1 m, which are open now: (2, 0)")


def test_poses_in_another_frame_have_to_be_brought() -> None:
    (turned,) = transform("map", "odom", 0.0, 1.0, 2.0, math.pi / 2).transforms
    there = brought(pose(3.0, 1.0, 0.5, "odom"), turned)
    assert (there.stamp, there.frame_id) == (3 * SECOND, "map")
    assert (*there.position, there.heading) == pytest.approx((0.5, 3.0, 0.0, math.pi / 2))
    none = replace(turned, transform=replace(turned.transform, rotation=Quaternion(w=0.0)))
    live = LiveMotion(PLAN)
    assert live.frame_id is None
    assert LiveMotion(replace(PLAN, map_frame="hall")).frame_id == "hall"
    live.take_map(FREE)
    assert live.frame_id == "map"
    live.take_pose(pose(0.0, 1.0, 1.0, "odom"))
    live.take_pose(pose(0.0, 1.0, 1.0, "/map"))
    live.take_pose(brought(pose(0.0, 1.0, 1.0, "odom"), none))
    assert live.poses == 2
    assert live.faults == {
        "pose in frame 'odom', which was not brought to the map's, 'map'": 1,
        "pose with a coordinate that is not finite": 1,
    }


def test_without_a_map_the_surroundings_are_open_space() -> None:
    live = LiveMotion(PLAN, open_space=6.0)
    assert live.take_pose(pose(0.0, math.nan, 0.0, "odom")).grid_map is None
    news = live.take_pose(pose(0.0, 10.2, -3.3, "odom"))
    assert news.grid_map is not None
    assert news.grid_map.free.all()
    assert news.grid_map.frame_id == live.frame_id == "odom"
    corners = [(10.2 + dx, -3.3 + dy) for dx in (-3, 3) for dy in (-3, 3)]
    assert news.grid_map.is_free(news.grid_map.cells_of(corners)).all()
    assert live.faults == {"pose with a coordinate that is not finite": 1}
    # A map that comes later is taken.
    assert live.take_map(replace(FREE, frame_id="odom")).grid_map is live.grid_map
    named = LiveMotion(replace(PLAN, map_frame="hall"), open_space=6.0)
    assert named.take_pose(pose(0.0, 1.0, 1.0, "odom")).grid_map is None
    assert named.take_pose(pose(0.0, 1.0, 1.0, "hall")).grid_map is not None
    assert named.take_pose(pose(0.0, 1e300, 1.0, "hall")) == News()
    far = LiveMotion(replace(PLAN, planning_resolution=0.1), open_space=6.0)
    assert far.take_pose(pose(0.0, 1.7e308, 1.0)) == News()
    assert sum(far.faults.values()) == 1
    with pytest.raises(InputError, match=r"open space: the map has .* cells, more than"):
        LiveMotion(PLAN, open_space=1e5)


def test_a_clock_that_jumps_back_restarts_the_commands() -> None:
    settings = replace(PLAN, start="0.5,0.5,0", command_hold=5.0)
    live = LiveMotion(settings)
    live.take_map(FREE)

    def drive(start: int) -> list[Visit]:
        commands = [live.take_command((start + each) * SECOND, ahead) for each in range(4)]
        return all_of([*commands, *(live.advance((start + each) * SECOND) for each in (5, 7))])

    ahead = Command(0.5, 0.0, 0.0)
    cells = [(0, 0), (1, 0), (2, 0), (3, 0)]
    assert [visit.cell for visit in drive(0)] == cells
    live.clock_jumped_back()
    assert [visit.cell for visit in drive(6)] == cells
    with pytest.raises(InputError, match="give the pose x,y,heading from which they are"):
        LiveMotion(PLAN).take_command(0, Command(1.0, 0.0, 0.0))


def test_intent_is_heard_between_poses() -> None:
    live = LiveMotion(PLAN)
    for at in walk((0.5, 0.5), (1.5, 0.5)):
        live.take_pose(pose(*at))
    for tick in range(1, 35):
        live.take_intent(Command(0.0, 0.3, 0.0))
        live.take_pose(pose(2.0 + tick / 10, 1.5, 0.5))
    visits = live.take_map(FREE).visits
    assert [visit.led_by and visit.led_by[1] for visit in visits] == [None, 1, 3]
    messages = visit_messages(visits[1], "map")
    assert [type(message).__name__ for message in messages] == ["Vector3Stamped", "PoseStamped"]


def source_of(bag: str, topic: str) -> list[tuple[int, object]]:
    """The messages of a topic, each with its log time [ns]."""
    opened = Bag(SHARED_BAGS / bag)
    (type_name,) = [each.type_name for each in opened.topics() if each.name == topic]
    return [(raw.log_time, decode(type_name, raw.data)) for raw in opened.messages([topic])]


def same(visits: Iterable[Visit], offline: Recording) -> None:
    live = recorded(visits, *offline.frames)
    np.testing.assert_array_equal(live.pose_stamps, offline.pose_stamps)
    np.testing.assert_allclose(live.positions, offline.positions, atol=1e-9)
    np.testing.assert_array_equal(live.action_stamps, offline.action_stamps)
    np.testing.assert_array_equal(live.actions, offline.actions)


@needs_shared_bags
def test_a_turtlebot_is_followed_live_as_offline() -> None:
    depot = load_map(SHARED_BAGS.parent / "maps" / "depot.yaml")
    settings = Discretising(source="/amcl_pose")
    offline, _ = read_raw_demonstration(SHARED_BAGS / "nav2_turtlebot", settings, depot)
    poses = [pose_of(message) for _, message in source_of("nav2_turtlebot", "/amcl_pose")]
    assert len(poses) > 100
    for arrivals in ({0}, {40}, {0, 60}):
        live, visits = LiveMotion(settings), []
        for number, each in enumerate(poses):
            if number in arrivals:
                visits += live.take_map(depot).visits
            visits += live.take_pose(each).visits
        same(visits, offline.recording)
        assert live.grid_map is not None
        assert offline.grid_map is not None
        assert live.grid_map.is_same_as(offline.grid_map)
        assert live.faults == offline.faults


@needs_shared_bags
def test_a_turtles_commands_are_followed_live_as_offline() -> None:
    settings = Discretising(start="3.9,5.4,0")
    offline, _ = read_raw_demonstration(SHARED_BAGS / "turtle_waypoints", settings)
    live, visits = LiveMotion(settings, open_space=30.0), []
    for number, (log_time, message) in enumerate(source_of("turtle_waypoints", TOPIC)):
        if number % 3:
            visits += live.advance(log_time).visits
        visits += live.take_command(log_time, command_of(message)).visits
    visits += live.advance(log_time + SECOND).visits
    same(visits, offline.recording)
