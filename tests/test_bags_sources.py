"""Bags that are read where they cannot be reached at once: pipes, compression, large chunks."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tracemalloc
from pathlib import Path
from threading import Thread

import pytest
import zstandard

from bnirl_ros.bags import reader
from bnirl_ros.bags.reader import Bag
from test_bags_reader import LAYOUTS, damaged, numbers, write_mcap


def compressed(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def first_chunk(data: bytes) -> int:
    """Where the first chunk begins: after the eight first bytes and the header."""
    return 8 + 9 + int.from_bytes(data[9:17], "little")


def metadata(*files: str) -> str:
    """What rosbag2 writes beside files that it compressed as a whole."""
    names = "".join(f"    - {name}\n" for name in files)
    return (
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n"
        "  message_count: 6\n  compression_format: zstd\n  compression_mode: FILE\n"
        f"  relative_file_paths:\n{names}"
    )


# Pipes


def test_a_pipe_is_read_once_and_served_to_all(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap", list(range(3000)))
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    data = (tmp_path / "bag.mcap").read_bytes()
    feeder = Thread(target=pipe.write_bytes, args=[data])
    feeder.start()
    first = Bag(pipe)
    feeder.join()
    assert numbers(first.messages()) == list(range(3000))
    assert numbers(Bag(pipe).messages()) == list(range(3000))
    assert first.damage is None


@pytest.mark.parametrize("name", ["-", "/dev/stdin"])
@pytest.mark.parametrize("size", [None, 20_000])
def test_standard_input_is_read(tmp_path: Path, name: str, size: int | None) -> None:
    write_mcap(tmp_path / "bag.mcap", list(range(3000)), chunk_size=5000)
    data = (tmp_path / "bag.mcap").read_bytes()[:size]
    code = (
        "from bnirl_ros.bags.reader import Bag\n"
        f"for bag in Bag({name!r}), Bag({name!r}):\n"
        "    print(sum(1 for _ in bag.messages()), bag.damage is None)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=data, capture_output=True, check=True
    )
    first, second = done.stdout.decode().splitlines()
    assert first == second
    count, sound = first.split()
    assert (count == "3000") == (sound == "True") == (size is None)
    assert int(count) > 100


# Files compressed as a whole


def test_a_compressed_file_is_read_and_leaves_nothing_behind(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)))
    packed = tmp_path / "bag.mcap.zstd"
    packed.write_bytes(compressed((tmp_path / "whole.mcap").read_bytes()))
    bag = Bag(packed)
    assert numbers(bag.messages()) == list(range(300))
    assert bag.damage is None
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bag.mcap.zstd", "whole.mcap"]


def test_a_folder_of_compressed_files_is_read(tmp_path: Path) -> None:
    for number, times in enumerate([[0, 20, 40], [10, 30, 50]]):
        write_mcap(tmp_path / "plain", times)
        packed = compressed((tmp_path / "plain").read_bytes())
        (tmp_path / f"bag_{number}.mcap.zstd").write_bytes(packed)
    assert [each.log_time for each in Bag(tmp_path).messages()] == [0, 10, 20, 30, 40, 50]
    (tmp_path / "metadata.yaml").write_text(metadata("bag_0.mcap.zstd", "bag_1.mcap.zstd"))
    bag = Bag(tmp_path)
    assert [each.log_time for each in bag.messages()] == [0, 10, 20, 30, 40, 50]
    assert (bag.warnings, bag.damage) == ([], None)
    # Somebody unpacked one of them: it is not read twice.
    (tmp_path / "plain").rename(tmp_path / "bag_1.mcap")
    assert [file.name for file in Bag(tmp_path).files] == ["bag_0.mcap.zstd", "bag_1.mcap.zstd"]
    (tmp_path / "bag_1.mcap.zstd").unlink()
    bag = Bag(tmp_path)
    assert [file.name for file in bag.files] == ["bag_0.mcap.zstd", "bag_1.mcap"]
    assert (bag.warnings, sum(1 for _ in bag.messages())) == ([], 6)
    (tmp_path / "metadata.yaml").unlink()
    assert [file.name for file in Bag(tmp_path).files] == ["bag_0.mcap.zstd", "bag_1.mcap"]


@pytest.mark.parametrize("how", ["cut off", "altered"])
def test_a_damaged_compressed_file_gives_what_comes_before(tmp_path: Path, how: str) -> None:
    chosen = random.Random(5)
    times = sorted(chosen.randrange(10**9) for _ in range(5000))
    write_mcap(tmp_path / "whole.mcap", times, **LAYOUTS["no chunks"])
    packed = bytearray(compressed((tmp_path / "whole.mcap").read_bytes()))
    half = len(packed) // 2
    packed[half:] = packed[half:] * (how == "altered")
    packed[half : half + 2000] = bytes(len(packed[half : half + 2000]))
    bag = damaged(tmp_path, bytes(packed))
    found = numbers(bag.messages())
    assert found == list(range(len(found)))
    assert 1000 < len(found) < 5000
    assert bag.damage is not None
    assert f"{len(found)} messages could be read" in bag.damage


def test_messages_that_were_compressed_one_by_one_are_unpacked(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "bag.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("text", "cdr", schema)
        for number in range(3):
            data = b"\0\1\0\0" + bytes([number] * 20)
            writer.add_message(channel, number, compressed(data), number)
        writer.add_message(channel, 3, compressed(bytes(1000))[:-4], 3)
        writer.finish()
    bag = Bag(tmp_path / "bag.mcap")
    found = [message.data for message in bag.messages()]
    assert found[:3] == [b"\0\1\0\0" + bytes([number] * 20) for number in range(3)]
    assert len(found) == 4


# Sizes


def test_a_bomb_takes_no_memory(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", [1, 2, 3], chunk_size=1)
    whole = (tmp_path / "whole.mcap").read_bytes()
    zeros = zstandard.ZstdCompressor().compressobj()
    packed = b"".join(zeros.compress(bytes(2**20)) for _ in range(80)) + zeros.flush()
    size = 2**40
    head = bytes(16) + size.to_bytes(8, "little") + bytes(4) + b"\x04\0\0\0zstd"
    content = head + len(packed).to_bytes(8, "little") + packed
    bomb = b"\x06" + len(content).to_bytes(8, "little") + content
    place = first_chunk(whole)
    tracemalloc.start()
    bag = damaged(tmp_path, whole[:place] + bomb + whole[place:])
    assert numbers(bag.messages()) == [0, 1, 2]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert bag.damage is not None
    assert f"claims to unpack to {size} bytes, more than" in bag.damage
    assert peak < 30_000_000


@pytest.mark.parametrize("opcode", [3, 4, 5, 11])
def test_a_record_that_claims_absurd_sizes_is_not_read(tmp_path: Path, opcode: int) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), **LAYOUTS["no chunks"])
    whole = (tmp_path / "whole.mcap").read_bytes()
    place = whole.index((150).to_bytes(4, "little") * 25) - 22 - 9
    for size in (2**20, 2**28, 2**40, 2**63):
        absurd = bytes([opcode]) + size.to_bytes(8, "little")
        bag = damaged(tmp_path, whole[:place] + absurd + whole[place:])
        assert numbers(bag.messages()) == list(range(300))
        assert bag.damage is not None
        assert f"damaged at byte {place} (a record claims {size} bytes" in bag.damage


def test_a_wrong_length_costs_only_its_own_record(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), **LAYOUTS["no chunks"])
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    length = whole.index((150).to_bytes(4, "little") * 25) - 22 - 8
    for wrong in (30, 121, 123, 1000, 5000):
        whole[length : length + 8] = wrong.to_bytes(8, "little")
        found = numbers(damaged(tmp_path, bytes(whole)).messages())
        assert set(range(300)) - set(found) <= {150}
        assert len(found) <= 300


@pytest.mark.parametrize("name", ["small chunks", "lz4", "uncompressed"])
@pytest.mark.parametrize("change", [-50, 50, 2**12, 2**40])
def test_a_chunk_whose_length_is_wrong_is_read(tmp_path: Path, name: str, change: int) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), **LAYOUTS[name])
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    place = first_chunk(whole)
    length = int.from_bytes(whole[place + 1 : place + 9], "little")
    whole[place + 1 : place + 9] = (length + change).to_bytes(8, "little")
    bag = damaged(tmp_path, bytes(whole))
    assert numbers(bag.messages()) == list(range(300))
    assert bag.damage is not None
    assert f"at byte {place} " in bag.damage


@pytest.mark.parametrize("name", ["all", "lz4", "uncompressed"])
def test_a_large_chunk_is_read_by_parts(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "IN_MEMORY", 10_000)
    monkeypatch.setattr(reader, "_RUN_SIZE", 3000)
    chosen = random.Random(7)
    times = [chosen.randrange(1000) for _ in range(400)]
    options = {**LAYOUTS[name], "chunk_size": 2**20}
    write_mcap(tmp_path / "bag.mcap", times, **options)
    bag = Bag(tmp_path / "bag.mcap")
    expected = sorted(range(400), key=lambda number: times[number])
    assert [times[number] for number in numbers(bag.messages())] == sorted(times)
    assert sorted(numbers(bag.messages(["topic1"]))) == list(range(1, 400, 2))
    assert {times[each] for each in numbers(bag.messages(since=300, until=700))} == {
        times[each] for each in expected if 300 <= times[each] <= 700
    }
    assert bag.damage is None
    write_mcap(tmp_path / "bag.mcap", times, **options, repeat_channels=False)
    assert sum(topic.messages for topic in Bag(tmp_path / "bag.mcap").topics()) == 400
    cut = damaged(tmp_path, (tmp_path / "bag.mcap").read_bytes()[:12_000])
    found = numbers(cut.messages())
    assert (0 < len(found) < 400) == (name == "uncompressed")
    assert [times[number] for number in found] == sorted(times[number] for number in found)
    assert cut.damage is not None or name == "all"


# What a summary and a beginning say


def test_a_summary_that_was_altered_is_not_believed(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), chunk_size=5000)
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    whole[whole.rindex(b"topic1")] = ord("T")
    bag = damaged(tmp_path, bytes(whole))
    assert {topic.name for topic in bag.topics()} == {"topic0", "topic1"}
    assert numbers(bag.messages(["topic1"])) == list(range(1, 300, 2))
    assert bag.damage is not None
    assert "the summary's checksum is wrong" in bag.damage


def test_a_file_whose_first_bytes_are_altered_is_read(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)))
    whole = (tmp_path / "whole.mcap").read_bytes()
    bag = damaged(tmp_path, b"X" + whole[1:])
    assert numbers(bag.messages()) == list(range(300))
    assert bag.damage is not None
    assert "at byte 0 (the file does not begin as MCAP files do)" in bag.damage
    assert bag.expected == 300
