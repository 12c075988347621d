"""The scenarios are the paper's, the demonstrator optimal, and the shipped bags what they say."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import zstandard

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.topics import RawMessage
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.placement import place
from bnirl_ros.errors import InputError
from bnirl_ros.experiments import make_bags, overcooked, turtle
from bnirl_ros.experiments.demonstration_bag import (
    BEGINNING,
    SIZE_LIMIT,
    bag_size,
    first_episodes,
    write_demonstration,
    write_what_fits,
)
from bnirl_ros.experiments.identifiability import mode_subgoals
from bnirl_ros.experiments.printed_sum import shares
from bnirl_ros.experiments.scenarios import (
    PAPER_LOOP,
    SCENARIOS,
    TIE,
    demonstrate,
    shipped_demonstration,
)
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES, STEPS
from bnirl_ros.mdp.goal_values import goal_values

BAGS = Path(__file__).resolve().parents[1] / "bags"
RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "overcooked"
TURTLE = SHARED_BAGS / "turtle_waypoints"

needs_recordings = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the recordings of ../shared/data are not on this machine"
)

# With another version the same messages compress to other bytes.
needs_the_same_zstd = pytest.mark.skipif(
    zstandard.ZSTD_VERSION != (1, 5, 7), reason="the bags were compressed by Zstandard 1.5.7"
)

EPISODES = {
    "paper_loop": 5,
    "overcooked_random3": 16,
    "overcooked_asymmetric_advantages": 18,
    "turtle_waypoints": 1,
}
NAMES = list(EPISODES)
COMMANDS = "turtle_commands"
ALL = [*NAMES, COMMANDS]

# Those made of recordings can be made again only where these are.
NEEDS = {"paper": (), "overcooked": needs_recordings, "turtle": needs_shared_bags}
REMAKABLE = {name: pytest.param(name, marks=NEEDS[name.partition("_")[0]]) for name in ALL}

CSV = """\
episode,t,x,y,action,interact_ok
4,0,1,1,N,0
4,1,1,1,E,0
4,2,2,1,I,1
5,0,2,2,.,0
5,1,2,2,W,0
"""
PLAY = """\
episode,t,x,y,action
4,0,1,1,N
4,1,1,1,E
4,2,2,1,I
4,3,2,1,.
4,4,2,1,E
4,5,2,1,S
4,6,2,2,I
5,0,2,2,N
5,1,2,1,W
6,0,2,1,.
6,1,2,1,E
7,1,2,1,.
7,0,2,1,I
"""
LAYOUT = "XXXX\nX  X\nXX X\nXXXX\n"


@cache
def original(name: str) -> tuple[Demonstration, GridMap]:
    """What a bag was made of."""
    if name in SCENARIOS:
        return shipped_demonstration(SCENARIOS[name]), SCENARIOS[name].grid_map
    if name == "turtle_waypoints":
        return turtle.read_turtle(TURTLE)
    return overcooked.read_overcooked(RECORDINGS, name.removeprefix("overcooked_"))


def make(name: str, out: Path) -> Path:
    """Make a bag again."""
    if name in SCENARIOS:
        return make_bags.make_scenario_bag(SCENARIOS[name], out)
    if name == "turtle_waypoints":
        return make_bags.make_turtle_bag(TURTLE, out)
    if name == COMMANDS:
        return make_bags.make_turtle_commands_bag(TURTLE, out)
    bag, _ = make_bags.make_overcooked_bag(RECORDINGS, name.removeprefix("overcooked_"), out)
    return bag


def recordings(folder: Path, csv: str = CSV, layout: str = LAYOUT) -> Path:
    """A folder with recordings of the layout `tiny`."""
    folder.mkdir(exist_ok=True)
    (folder / "tiny.csv").write_text(csv, encoding="utf-8")
    (folder / "tiny.grid.txt").write_text(layout, encoding="utf-8")
    return folder


def assert_equal(one: Demonstration, other: Demonstration) -> None:
    np.testing.assert_array_equal(one.observations, other.observations)
    np.testing.assert_array_equal(one.last_episode, other.last_episode)
    np.testing.assert_array_equal(one.last_cells, other.last_cells)


def test_the_loop_is_the_papers() -> None:
    world = PAPER_LOOP.world
    assert world.free.shape == (20, 20)
    assert not world.free.all()
    assert (world.success, world.discount, world.moves) == (0.7, 0.99, 8)
    assert PAPER_LOOP.episodes == 5
    cells = np.array([PAPER_LOOP.start, *PAPER_LOOP.subgoals])
    assert (cells + 1).tolist() == [[10, 1], [19, 9], [10, 17], [2, 9], [10, 1]]
    assert PAPER_LOOP.grid_map.is_free(cells).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_demonstrator_pursues_its_subgoals_in_order(seed: int) -> None:
    demonstration = demonstrate(PAPER_LOOP, np.random.default_rng(seed))
    world = PAPER_LOOP.world
    goals = world.states_of(PAPER_LOOP.subgoals)
    values = goal_values(world, goals, np.arange(world.state_count), 1e-10)
    outcomes = world.outcomes()
    assert np.unique(demonstration.episode).tolist() == list(range(PAPER_LOOP.episodes))
    assert demonstration.last_episode.tolist() == list(range(PAPER_LOOP.episodes))
    for episode in range(PAPER_LOOP.episodes):
        chosen = demonstration.episode == episode
        states = world.states_of(demonstration.cells[chosen])
        last = world.states_of(demonstration.last_cells[episode])
        following = np.append(states[1:], last)
        assert (following[:, None] == outcomes[states]).any(axis=1).all()
        assert states[0] == world.states_of(PAPER_LOOP.start)
        current = 0
        for state, action in zip(states, demonstration.action[chosen], strict=True):
            # The last one is reached by the last pose only, which ends the episode.
            current += state == goals[current]
            best = values[state, :, current].max()
            assert values[state, action, current] >= best - TIE
        assert current == len(goals) - 1
        assert last == goals[-1]


def test_the_demonstrator_breaks_ties_by_chance_and_slips() -> None:
    scenario = replace(PAPER_LOOP, episodes=200)
    demonstration = demonstrate(scenario, np.random.default_rng(1))
    world = scenario.world
    states = world.states_of(demonstration.cells)
    following = np.append(states[1:], 0)
    following[np.flatnonzero(np.diff(demonstration.episode, append=-1))] = world.states_of(
        demonstration.last_cells
    )
    as_meant = following == world.outcomes()[states, demonstration.action]
    # A little more than 0.7 may be, for at a wall other actions lead to the same cell.
    assert 0.69 < as_meant.mean() < 0.72

    there = replace(scenario, start=(1, 0), subgoals=((1, 2),), success=1.0)
    for grid, expected in (
        ("...\n...\n...", {"NE", "N", "NW"}),
        ("...\n.#.\n...", {"E", "W"}),
    ):
        observed = demonstrate(replace(there, grid=grid), np.random.default_rng(2))
        starts = (observed.cells == (1, 0)).all(axis=1)
        assert {ACTION_NAMES[action] for action in observed.action[starts]} == expected


def test_demonstrations_come_from_the_seed_alone() -> None:
    assert_equal(shipped_demonstration(PAPER_LOOP), shipped_demonstration(PAPER_LOOP))
    other = demonstrate(PAPER_LOOP, np.random.default_rng(PAPER_LOOP.seed + 1))
    assert len(other) != len(shipped_demonstration(PAPER_LOOP))


def test_the_mode_of_the_shipped_loop_is_its_true_subgoals() -> None:
    assert mode_subgoals(PAPER_LOOP, PAPER_LOOP.seed, Settings()) == set(PAPER_LOOP.subgoals)


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_bag_is_sound_and_small(name: str) -> None:
    recorded = read_demonstration(BAGS / name, {})
    assert recorded.grid_map is not None
    assert (recorded.faults, recorded.warnings, recorded.damage) == ({}, (), None)
    placement = place(recorded.recording, recorded.grid_map)
    assert not placement.faults
    assert len(np.unique(placement.demonstration.episode)) == EPISODES[name]
    assert sum(file.stat().st_size for file in (BAGS / name).iterdir()) < SIZE_LIMIT


@pytest.mark.parametrize("name", NAMES)
def test_the_map_of_a_shipped_bag_is_latched_and_first(name: str) -> None:
    bag = Bag(BAGS / name)
    qos = {topic.name: topic.qos[0] for topic in bag.topics()}
    assert set(qos) == {"/map", "/pose", "/action"}
    assert qos["/map"].durability == "transient_local"
    assert {profile.reliability for profile in qos.values()} == {"reliable"}
    assert qos["/pose"].durability == qos["/action"].durability == "volatile"
    first = next(iter(bag.messages()))
    assert (first.topic, first.log_time) == ("/map", BEGINNING)


@pytest.mark.parametrize("name", [name for name in ALL if name not in SCENARIOS])
def test_recordings_of_others_come_with_their_licence(name: str) -> None:
    licence = overcooked.LICENCE
    notices = {"turtle_waypoints": turtle.NOTICE, COMMANDS: turtle.COMMANDS_NOTICE}
    if name in notices:
        # The recording's licence is that of this package too.
        licence = notices[name] + (BAGS.parent / "LICENSE").read_text(encoding="utf-8")
    assert (BAGS / name / "LICENSE").read_text(encoding="utf-8") == licence


@pytest.mark.parametrize("name", [REMAKABLE[name] for name in NAMES])
def test_a_shipped_bag_holds_what_it_was_made_of(name: str) -> None:
    demonstration, grid_map = original(name)
    recorded = read_demonstration(BAGS / name, {})
    assert recorded.grid_map is not None
    assert_equal(place(recorded.recording, recorded.grid_map).demonstration, demonstration)
    np.testing.assert_array_equal(recorded.grid_map.free, grid_map.free)
    assert recorded.grid_map.origin == grid_map.origin
    assert recorded.grid_map.resolution == grid_map.resolution
    assert recorded.grid_map.frame_id == grid_map.frame_id


def test_the_shipped_commands_are_the_recorded_ones() -> None:
    bag = Bag(BAGS / COMMANDS)
    shipped = list(bag.messages())
    assert (bag.warnings, bag.damage, len(shipped)) == ([], None, 8886)
    (topic,) = bag.topics()
    assert (topic.name, topic.type_name) == (turtle.TOPIC, turtle.TYPE)
    if TURTLE.is_dir():
        recorded = list(Bag(TURTLE).messages())
        assert list(map(content, shipped)) == list(map(content, recorded))


def content(message: RawMessage) -> tuple[str, str, int, bytes]:
    """What a message says, without how it was sent."""
    return message.topic, message.type_name, message.log_time, message.data


@needs_the_same_zstd
@pytest.mark.parametrize("name", REMAKABLE.values())
def test_bags_can_be_made_again_byte_for_byte(name: str, tmp_path: Path) -> None:
    bag = make(name, tmp_path)
    shipped = {path.name: path.read_bytes() for path in (BAGS / name).iterdir()}
    assert {path.name: path.read_bytes() for path in bag.iterdir()} == shipped, "run make bags"


def test_pose_and_action_share_stamps_and_episodes_lie_apart(tmp_path: Path) -> None:
    demonstration = Demonstration(
        episode=np.array([3, 3, 7]),
        cells=np.array([[0, 0], [1, 0], [1, 0]]),
        action=np.array([1, 0, 5]),
        last_episode=np.array([7]),
        last_cells=np.array([[0, 0]]),
    )
    grid_map = GridMap(np.ones((1, 2), dtype=bool))
    write_demonstration(tmp_path / "bag", demonstration, grid_map, 0.15)
    recording = read_demonstration(tmp_path / "bag", {}).recording
    milliseconds = (recording.pose_stamps - BEGINNING) // 1_000_000
    assert milliseconds.tolist() == [0, 150, 10_150, 10_300]
    assert recording.action_stamps.tolist() == recording.pose_stamps[:3].tolist()
    log_times = {raw.log_time for raw in Bag(tmp_path / "bag").messages()}
    assert log_times == set(recording.pose_stamps.tolist())
    placed = place(recording, grid_map).demonstration
    assert placed.episode.tolist() == [0, 0, 1]
    assert (placed.last_episode.tolist(), placed.last_cells.tolist()) == ([1], [[0, 0]])


def test_as_many_whole_episodes_as_fit_are_taken(tmp_path: Path) -> None:
    demonstration, grid_map = original("paper_loop")
    sizes = []
    for count in (3, 4):
        part = first_episodes(demonstration, count)
        write_demonstration(tmp_path / "bag", part, grid_map, 0.5)
        sizes.append(bag_size(tmp_path / "bag"))
    for limit, expected in ((sizes[1] + 1, 4), (sizes[1], 3)):
        taken = write_what_fits(tmp_path / "bag", demonstration, grid_map, 0.5, limit)
        assert taken == expected
        recording = read_demonstration(tmp_path / "bag", {}).recording
        placed = place(recording, grid_map).demonstration
        assert_equal(placed, first_episodes(demonstration, expected))
    with pytest.raises(InputError, match="not one episode fits into 1000 bytes"):
        write_what_fits(tmp_path / "bag", demonstration, grid_map, 0.5, 1000)


def test_recorded_play_becomes_a_demonstration(tmp_path: Path) -> None:
    demonstration, grid_map = overcooked.read_overcooked(recordings(tmp_path, PLAY), "tiny")
    assert grid_map.free.tolist() == [
        [False, False, False, False],
        [False, False, True, False],
        [False, True, True, False],
        [False, False, False, False],
    ]
    # Left out are the steps without an action, the pushes N and E in episode 4 and E in 6, and W
    # in 5, as nothing shows whether it moved the player.
    names = [ACTION_NAMES[action] for action in demonstration.action]
    assert names == ["E", "stay", "S", "stay", "N", "stay"]
    assert demonstration.episode.tolist() == [4, 4, 4, 4, 5, 7]
    assert demonstration.cells.tolist() == [[1, 2], [2, 2], [2, 2], [2, 1], [2, 1], [2, 2]]
    # Episode 4 ends with an observation, and 6 has none.
    assert demonstration.last_episode.tolist() == [5, 7]
    assert demonstration.last_cells.tolist() == [[2, 2], [2, 2]]


def test_paths_hold_every_step(tmp_path: Path) -> None:
    paths = overcooked.read_paths(recordings(tmp_path, PLAY), "tiny")
    assert paths[:, 0].tolist() == [4] * 7 + [5] * 2 + [6] * 2 + [7] * 2
    assert paths[:3, 1:].tolist() == [[1, 2], [1, 2], [2, 2]]


@needs_recordings
@pytest.mark.parametrize("layout", overcooked.LAYOUTS)
def test_recorded_moves_lead_where_they_point(layout: str) -> None:
    demonstration, grid_map = overcooked.read_overcooked(RECORDINGS, layout)
    within = np.diff(demonstration.episode) == 0
    led_to = demonstration.cells[:-1] + STEPS[demonstration.action[:-1]]
    np.testing.assert_array_equal(led_to[within], demonstration.cells[1:][within])
    # Nobody is pushing: moves into furniture are left out.
    moves = demonstration.action[:-1] != ACTION_NAMES.index("stay")
    assert grid_map.is_free(led_to[moves & within]).all()


@pytest.mark.parametrize(
    ("csv", "layout", "says"),
    [
        ("a,b\n1,2\n", LAYOUT, r"tiny.csv, line 1: no column episode, t, x, y, action; "),
        ("", LAYOUT, r"tiny.csv, line 1: no column"),
        ("episode,t,x,y,action\n", LAYOUT, r"tiny.csv: has no rows; "),
        (CSV + "5,2,2,2,J,0\n", LAYOUT, r"tiny.csv, line 7: action is 'J'; "),
        (CSV + "5,2,2\n", LAYOUT, r"tiny.csv, line 7: episode,t,x,y must be whole numbers; "),
        (CSV + "5,2,2,2.5,N,0\n", LAYOUT, r"line 7: episode,t,x,y must be whole numbers; "),
        (CSV + "5,2,0,2,N,0\n", LAYOUT, r"line 7: \(x, y\) = \(0, 2\) is no floor of the layout"),
        (CSV + "5,2,2,9,N,0\n", LAYOUT, r"line 7: \(x, y\) = \(2, 9\) is no floor of the layout"),
        (CSV + "5,3,2,2,N,0\n", LAYOUT, r"tiny.csv: episode 5 breaks off after t = 1; "),
        (CSV.replace(",I,", ",.,").replace(",E,", ",.,"), LAYOUT, "nobody moves or interacts; "),
        (CSV, "XX\nX\n", r"tiny.grid.txt: its lines differ in length; "),
        (CSV, "XX\nXX\n", r"tiny.grid.txt: has no floor; "),
        (CSV, "", r"tiny.grid.txt: has no floor; "),
    ],
)
def test_wrong_recordings_are_named(tmp_path: Path, csv: str, layout: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        overcooked.read_overcooked(recordings(tmp_path, csv, layout), "tiny")


def test_missing_recordings_are_named_and_the_rest_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "nowhere"
    assert make_bags.main(["--overcooked", str(source), "--out", str(tmp_path / "bags")]) == 1
    assert (tmp_path / "bags" / "paper_loop" / "metadata.yaml").is_file()
    error = capsys.readouterr().err
    assert error.startswith(f"make_bags: {source}: there is no such folder; ")
    assert "overcooked-ai 1.1.0" in error
    assert error.count("\n") == 1

    recordings(source)
    with pytest.raises(InputError, match=r"tiny2.grid.txt: cannot be read \(No such file"):
        overcooked.read_overcooked(source, "tiny2")
    (source / "tiny.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"tiny.csv: is no text; "):
        overcooked.read_overcooked(source, "tiny")


@needs_shared_bags
def test_a_recording_of_the_turtle_needs_its_licence(tmp_path: Path) -> None:
    (file,) = TURTLE.glob("*.mcap")
    shutil.copy(file, tmp_path)
    for make_it in (make_bags.make_turtle_bag, make_bags.make_turtle_commands_bag):
        with pytest.raises(InputError, match=r"LICENSE: cannot be read; put the recording's lice"):
            make_it(tmp_path, tmp_path / "bags")
    assert not (tmp_path / "bags").exists()


@needs_recordings
@needs_shared_bags
def test_the_command_leaves_other_files_alone(tmp_path: Path) -> None:
    shutil.copytree(BAGS / "paper_loop", tmp_path / "paper_loop")
    (tmp_path / "paper_loop" / "NOTES").touch()
    sources = ["--overcooked", str(RECORDINGS), "--turtle", str(TURTLE)]
    assert make_bags.main([*sources, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "paper_loop" / "NOTES").is_file()
    assert {path.name for path in tmp_path.iterdir()} == set(ALL)


# The printed sum


def test_the_product_finds_the_loops_subgoals_and_the_printed_sum_does_not() -> None:
    product = shares(seed=0, printed_sum=False, sweeps=40, burn_in=20)
    printed = shares(seed=0, printed_sum=True, sweeps=40, burn_in=20)
    assert min(product.of_subgoal) >= 0.9
    assert max(printed.of_subgoal) <= 0.7
    assert printed.subgoals > 2 * product.subgoals
