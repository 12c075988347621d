"""What a node takes in outlives its process, whatever ends that."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader

from bnirl_ros.bags.cdr import decode, encode
from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.reader import Bag
from bnirl_ros.demonstrations.recording import Recorder, Recording
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.journal_cuts import cut_everywhere
from bnirl_ros.journal.bag import Journal, open_journal
from bnirl_ros.journal.keeper import Keeper
from bnirl_ros.journal.messages import encoded_actions, encoded_poses
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.messages import PoseStamped, Vector3Stamped

SECOND = 1_000_000_000
MAP = GridMap(np.ones((3, 4), dtype=bool), resolution=0.5)
FIELDS = ("pose_stamps", "positions", "action_stamps", "actions")


def walked(count: int, first: int = 0, recorder: Recorder | None = None) -> Recorder:
    """A recorder that took in so many poses with their actions."""
    recorder = Recorder() if recorder is None else recorder
    recorder.map_arrived()
    for number in range(first, first + count):
        recorder.add_pose(number * SECOND, "map", number * 0.5, -number / 3)
        recorder.add_action(number * SECOND, float(number % 3 - 1), 1.0)
    return recorder


def assert_same(one: Recording, other: Recording) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    frames = [[each.frames[frame] for frame in each.pose_frames] for each in (one, other)]
    assert frames[0] == frames[1]


def opened(folder: Path, **options: Any) -> Journal:
    return open_journal(folder, **options).journal


def cut_off(journal: Journal) -> Path:
    """Its folder, once its process has ended without a word."""
    copy = Path(f"{journal.folder.parent}_copy", journal.folder.name)
    shutil.copytree(journal.folder, copy)
    return copy


# Messages


@given(
    st.lists(
        st.tuples(
            st.integers(-(2**31) * SECOND, 2**31 * SECOND - 1),
            st.floats(allow_nan=False, allow_infinity=False),
            st.floats(allow_nan=False, allow_infinity=False),
            st.sampled_from(["map", "", "odom", "a long frame with ünïcode"]),
        ),
        max_size=5,
    )
)
def test_poses_are_encoded_as_one_by_one(poses: list[tuple[int, float, float, str]]) -> None:
    recorder = Recorder()
    for stamp, x, y, frame in poses:
        recorder.add_pose(stamp, frame, x, y)
    data = encoded_poses(recorder.snapshot())
    for (stamp, x, y, frame), each in zip(poses, data, strict=True):
        message: Any = decode(PoseStamped.TYPE, each)
        assert message.header.stamp.sec * SECOND + message.header.stamp.nanosec == stamp
        assert (message.pose.position.x, message.pose.position.y) == (x, y)
        assert (message.header.frame_id, message.pose.orientation.w) == (frame, 1.0)
        assert message.pose.position.z == message.pose.orientation.z == 0.0


def test_actions_are_encoded_as_their_steps() -> None:
    recorder = Recorder()
    recorder.add_pose(0, "odom", 0.0, 0.0)
    steps = [(dx, dy) for dx in (-1.0, 0.0, 1.0) for dy in (-1.0, 0.0, 1.0)]
    for number, (dx, dy) in enumerate(steps):
        recorder.add_action(number - 5, dx, dy)
    data = encoded_actions(recorder.snapshot())
    assert len(data) == len(ACTION_NAMES)
    for number, (each, (dx, dy)) in enumerate(zip(data, steps, strict=True)):
        message: Any = decode(Vector3Stamped.TYPE, each)
        assert (message.vector.x, message.vector.y, message.vector.z) == (dx, dy, 0.0)
        assert message.header.stamp.sec * SECOND + message.header.stamp.nanosec == number - 5
        assert message.header.frame_id == "odom"


# The bag


def test_what_was_appended_is_on_the_disk(tmp_path: Path) -> None:
    recorder = walked(20)
    journal = opened(tmp_path)
    journal.append(recorder.drain(), encode(map_message(MAP, 0)), now=100 * SECOND)
    walked(5, first=20, recorder=recorder)
    journal.append(recorder.drain(), now=101 * SECOND)
    read = read_demonstration(cut_off(journal))
    assert_same(read.recording, recorder.snapshot())
    assert read.grid_map is not None
    assert read.grid_map.is_same_as(MAP)


def test_a_finished_journal_is_a_demonstration_bag_of_rosbag2(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    journal.append(walked(7).drain(), encode(map_message(MAP, 0)))
    journal.close()
    bag = Bag(journal.folder)
    assert len(list(bag.messages())) == 15
    assert (bag.damage, bag.warnings) == (None, [])
    with Reader(journal.folder) as reader:
        assert {topic: each.msgcount for topic, each in reader.topics.items()} == {
            "/pose": 7,
            "/action": 7,
            "/map": 1,
        }


def test_log_times_are_spread_and_go_forward_though_the_clock_goes_back(tmp_path: Path) -> None:
    recorder = walked(4)
    journal = opened(tmp_path)
    journal.append(recorder.drain(), now=100 * SECOND)
    walked(4, first=4, recorder=recorder)
    journal.append(recorder.drain(), now=101 * SECOND)
    walked(4, first=8, recorder=recorder)
    journal.append(recorder.drain(), now=50 * SECOND)
    journal.close()
    times = [each.log_time for each in Bag(journal.folder).messages(["/pose"])]
    assert (np.diff(times) > 0).all()
    assert np.diff(times[3:8]).tolist() == [SECOND // 4] * 4
    assert_same(read_demonstration(journal.folder).recording, recorder.snapshot())


def test_an_empty_journal_leaves_nothing(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    journal.append(Recorder().drain(), encode(map_message(MAP, 0)))
    journal.close()
    assert list(tmp_path.iterdir()) == []


def test_journals_are_numbered_and_finished_ones_are_left_alone(tmp_path: Path) -> None:
    for number in (1, 2):
        found = open_journal(tmp_path)
        assert found.recovered is None
        assert found.journal.folder.name.startswith(f"000{number}_")
        found.journal.append(walked(3).drain())
        found.journal.close()


def test_a_journal_that_is_written_is_left_alone(tmp_path: Path) -> None:
    first = opened(tmp_path)
    first.append(walked(3).drain())
    other = open_journal(tmp_path)  # of a node with the same name
    assert other.recovered is None
    assert other.journal.folder != first.folder
    first.close()
    other.journal.close()


# Faults


def test_cut_at_any_byte_it_keeps_all_that_was_on_the_disk_there(tmp_path: Path) -> None:
    cuts = cut_everywhere(tmp_path, appends=6, every=61)
    assert cuts.tried > 50
    assert cuts.wrong == ()


def test_what_was_cut_off_is_gone_on_with(tmp_path: Path) -> None:
    recorder = walked(10)
    journal = opened(tmp_path / "journals")
    journal.append(recorder.drain(), encode(map_message(MAP, 0)), now=100 * SECOND)
    kept = recorder.snapshot()
    journal.append(walked(10, first=10).drain(), now=101 * SECOND)
    folder = cut_off(journal)
    file = next(folder.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-400])

    found = open_journal(folder.parent)
    assert found.recovered is not None
    assert "is damaged at byte" in found.damage
    assert_same(found.recovered.recording, kept)
    recorder = Recorder()
    recorder.restore(found.recovered.recording)
    walked(5, first=10, recorder=recorder)
    found.journal.append(recorder.drain(), now=50 * SECOND)
    again = open_journal(cut_off(found.journal).parent).recovered  # cut off once more
    assert again is not None
    assert_same(again.recording, recorder.snapshot())

    found.journal.close()
    assert found.journal.folder == folder
    read = read_demonstration(folder)
    assert_same(read.recording, recorder.snapshot())
    assert read.grid_map is not None
    assert open_journal(folder.parent).journal.folder.name.startswith("0002_")


def test_parts_that_are_whole_make_a_bag_for_rosbag2(tmp_path: Path) -> None:
    journal = opened(tmp_path / "journals")
    journal.append(walked(10).drain(), now=100 * SECOND)
    folder = tmp_path / "journals" / journal.folder.name
    journal._finish()  # as when the process ends just before metadata.yaml is written
    (folder / "metadata.yaml").unlink()
    journal._spool.let_go()
    copy = cut_off(journal)
    found = open_journal(copy.parent)
    found.journal.append(walked(5, first=10).drain(), now=101 * SECOND)
    found.journal.close()
    with Reader(copy) as reader:
        assert reader.message_count == 30
        assert len(list(reader.messages())) == 30
    assert_same(read_demonstration(copy).recording, walked(15).snapshot())


FULL_DISK = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_journal import walked
from bnirl_ros.errors import InputError
from bnirl_ros.journal.bag import open_journal

def limit(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

recorder = walked(10)
journal = open_journal(Path(sys.argv[1])).journal
file = next(journal.folder.glob("*.mcap"))
journal.append(recorder.drain())
limit(file.stat().st_size + 100)
for number in range(3):
    before = file.stat().st_size
    walked(100, 10 + 100 * number, recorder)
    try:
        journal.append(recorder.drain())
    except InputError as error:
        print(error)
    assert file.stat().st_size == before
limit(resource.RLIM_INFINITY)
journal.append(recorder.drain())
journal.close()
"""


def test_what_a_full_disk_has_no_room_for_is_written_when_it_has(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    sentences = done.stdout.splitlines()
    assert len(sentences) == 3
    assert "the journal cannot be written (File too large); make room there" in sentences[0]
    (folder,) = tmp_path.iterdir()
    assert_same(read_demonstration(folder).recording, walked(310).snapshot())


def test_a_folder_that_cannot_be_written_to_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"no journal can be written there .*journal_folder"):
        open_journal(tmp_path / "file" / "below")


# The thread


def test_a_keeper_gives_back_what_it_kept(tmp_path: Path) -> None:
    recorder = Recorder(waiting_limit=5)
    recorder.map_arrived()
    keeper = Keeper(tmp_path, recorder, interval=3600.0)
    keeper.map_arrived(encode(map_message(MAP, 0)))
    walked(10, recorder=recorder)
    keeper._write()
    assert keeper.error == ""
    assert keeper.journal is not None
    copy = tmp_path / "copy"
    shutil.copytree(keeper.journal, copy / keeper.journal.name)
    keeper.close()

    again = Recorder(waiting_limit=5)  # no limit for what had been taken in
    second = Keeper(copy, again, interval=3600.0)
    assert second.recovered is not None
    assert_same(again.snapshot(), recorder.snapshot())
    assert len(again.drain().pose_stamps) == 0  # it is kept already
    second.close()


def test_a_reset_finishes_the_journal_and_begins_another_with_the_map(tmp_path: Path) -> None:
    recorder = Recorder()
    keeper = Keeper(tmp_path, recorder, interval=3600.0)
    keeper.map_arrived(encode(map_message(MAP, 0)))
    walked(10, recorder=recorder)
    keeper.begin_anew()
    recorder.clear()
    walked(3, recorder=recorder)
    keeper.close()
    first, second = (read_demonstration(each) for each in sorted(tmp_path.iterdir()))
    assert len(first.recording.actions) == 10
    assert len(second.recording.actions) == 3
    assert first.grid_map is not None
    assert second.grid_map is not None


def test_a_checkpoint_that_cannot_be_used_is_told_and_the_rest_recovered(tmp_path: Path) -> None:
    recorder = Recorder()
    keeper = Keeper(tmp_path / "first", recorder, interval=3600.0)
    walked(10, recorder=recorder)
    keeper._write()
    keeper.keep_checkpoint(b"bnirl_ros checkpoint 999 " + b"0" * 64 + b"\n")
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    keeper.close()
    second = Keeper(tmp_path / "second", Recorder(), interval=3600.0)
    assert second.checkpoint is None
    end, warning = second.warnings
    assert "is damaged at byte" in end  # as a file is that nobody finished
    assert "has the format 999 where this version of bnirl_ros knows 1 alone" in warning
    assert second.recovered is not None
    second.close()
    assert not list((tmp_path / "second").glob("*/checkpoint"))
