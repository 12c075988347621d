"""A recording is a bag like rosbag2's, and whatever ends it leaves one that can be read."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader

from bnirl_ros.bags.qos import LATCHED, QosProfile
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.recording import RecordingBag
from bnirl_ros.errors import InputError

TYPE = "geometry_msgs/msg/PoseStamped"
NOISE = 10_000  # [bytes] of each message


def noise(number: int) -> bytes:
    """What cannot be compressed."""
    return number.to_bytes(4, "little") + np.random.default_rng(number).bytes(NOISE)


def numbers(path: Path) -> list[int]:
    return [int.from_bytes(each.data[:4], "little") for each in Bag(path).messages()]


def record(bag: RecordingBag, count: int, first: int = 0) -> None:
    for number in range(first, first + count):
        bag.write_encoded("/pose", noise(number), number)


def test_all_but_the_last_chunk_is_there_while_it_is_written(tmp_path: Path) -> None:
    now = 0.0
    folder = tmp_path / "bag"
    with RecordingBag(folder, clock=lambda: now) as bag:
        bag.add_topic("/pose", TYPE, QosProfile(), LATCHED)
        record(bag, 250)
        written = numbers(folder)  # as it is for whoever reads it now, or after a SIGKILL
        assert written == list(range(len(written)))
        assert 200 <= len(written) < 250
        bag.flush_if_due()
        assert numbers(folder) == written
        now += 60.0
        bag.flush_if_due()
        assert numbers(folder) == list(range(250))
        record(bag, 10, first=250)
    assert numbers(folder) == list(range(260))
    assert (Bag(folder).damage, Bag(folder).warnings) == (None, [])
    assert sorted(each.name for each in folder.iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    (topic,) = Bag(folder).topics()
    assert topic.qos == (QosProfile(), LATCHED)
    with Reader(folder) as reader:
        assert reader.message_count == 260
    with pytest.raises(InputError, match="exists already"), RecordingBag(folder):
        pass


def test_an_error_leaves_what_was_recorded_until_then(tmp_path: Path) -> None:
    def fail() -> None:
        with RecordingBag(tmp_path / "bag") as bag:
            bag.add_topic("/pose", TYPE, QosProfile())
            record(bag, 5)
            raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        fail()
    assert numbers(tmp_path / "bag") == list(range(5))
    assert Bag(tmp_path / "bag").warnings == []


PROGRAM = """
import sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from test_recording import TYPE, QosProfile, RecordingBag, record
from bnirl_ros.errors import InputError

try:
    with RecordingBag(Path(sys.argv[1])) as bag:
        bag.add_topic("/pose", TYPE, QosProfile())
        record(bag, 10_000)
except InputError as error:
    sys.exit(str(error))
"""


def recorded_by_another(folder: Path, limit: int | None = None) -> str:
    """What a process says that records until it can't; `limit`: to the size of its files."""

    def restrict() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        preexec_fn=restrict,
    )
    assert done.returncode == 1, done
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_where_files_cannot_grow_all_whole_chunks_are_kept(tmp_path: Path) -> None:
    said = recorded_by_another(tmp_path / "bag", limit=5 * 2**20 + 12_345)
    assert "bag: cannot be written any further (File too large); what was recorded" in said
    bag = Bag(tmp_path / "bag")
    found = numbers(tmp_path / "bag")
    assert found == list(range(len(found)))
    assert len(found) * NOISE > 4 * 2**20
    list(bag.messages())
    assert bag.damage is None


def test_a_full_disk_leaves_a_whole_bag(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("a small disk can be made by root only")
    try:
        assert "(No space left on device)" in recorded_by_another(disk / "bag")
        bag = Bag(disk / "bag")
        found = numbers(disk / "bag")
        assert found == list(range(len(found)))
        assert len(found) * NOISE > 7 * 2**20
        assert (bag.damage, bag.warnings) == (None, [])
        information = yaml.safe_load((disk / "bag" / "metadata.yaml").read_text())
        assert information["rosbag2_bagfile_information"]["message_count"] == len(found)
    finally:
        subprocess.run(["umount", str(disk)], check=True)
