"""Reading: every valid bag whole, every damaged one as far as it goes, and one clear sentence."""

import random
import re
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.topics import RawMessage
from bnirl_ros.errors import InputError


def count_by_topic(messages: Iterator[RawMessage]) -> Counter[str]:
    return Counter(message.topic for message in messages)


def write_mcap(path: Path, times: list[int], topics: int = 2, **options: object) -> None:
    """A file with messages at these times, on topics in turn; each holds its number."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [
            writer.register_channel(f"topic{number}", "cdr", schema) for number in range(topics)
        ]
        for number, time in enumerate(times):
            data = number.to_bytes(4, "little") * 25
            writer.add_message(channels[number % topics], time, data, time)
        writer.finish()


def numbers(messages: Iterator[RawMessage]) -> list[int]:
    return [int.from_bytes(message.data[:4], "little") for message in messages]


# What others recorded


@needs_shared_bags
@pytest.mark.parametrize(
    "path",
    sorted(SHARED_BAGS.rglob("*.mcap")),
    ids=lambda path: str(path.relative_to(SHARED_BAGS)),
)
def test_recorded_files_are_read_whole(path: Path) -> None:
    expected: Counter[str] = Counter()
    topic_of: dict[int, str] = {}
    with path.open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, Channel):
                topic_of[record.id] = record.topic
            elif isinstance(record, Message):
                expected[topic_of[record.channel_id]] += 1
    bag = Bag(path)
    messages = list(bag.messages())
    assert count_by_topic(iter(messages)) == expected
    assert {topic.name: topic.messages for topic in bag.topics()} == {
        name: expected[name] for name in topic_of.values()
    }
    times = [message.log_time for message in messages]
    assert times == sorted(times)
    assert bag.damage is None


@needs_shared_bags
def test_recorded_folders_are_read_whole() -> None:
    bag = Bag(SHARED_BAGS / "rosbag2" / "py__wbag")
    assert [path.name for path in bag.files] == [f"wbag_{number}.mcap" for number in range(5)]
    assert sum(1 for _ in bag.messages()) == sum(topic.messages for topic in bag.topics()) == 6074
    assert bag.warnings == []


@needs_shared_bags
def test_metadata_that_names_a_missing_file_are_passed_over() -> None:
    bag = Bag(SHARED_BAGS / "turtle_waypoints")
    assert [topic.messages for topic in bag.topics()] == [8886]
    (warning,) = bag.warnings
    assert "names rosbag2_2025_09_30-22_35_34_0.mcap, which is not there" in warning
    assert sum(1 for _ in bag.messages()) == 8886


@needs_shared_bags
def test_qos_types_and_encodings_of_recorded_topics() -> None:
    topics = {topic.name: topic for topic in Bag(SHARED_BAGS / "nav2_turtlebot").topics()}
    assert topics["/amcl_pose"].qos[0].durability == "transient_local"
    assert [each.depth for each in topics["/tf"].qos] == [10, 100, 100]  # one for each publisher
    assert topics["/odom"].type_hash.startswith("RIHS01_3cc97dc7")
    (old,) = Bag(SHARED_BAGS / "rosbag2" / "transport__test_bag_for_seek").topics()
    assert (old.type_name, old.qos) == ("test_msgs/msg/BasicTypes", ())
    wrong = Bag(SHARED_BAGS / "rosbag2" / "tests__wrong_rmw_test").topics()
    assert {topic.encoding for topic in wrong} == {"wrong_format"}


# Every valid layout

LAYOUTS: dict[str, dict[str, object]] = {
    "all": {},
    "small chunks": {"chunk_size": 500},
    "lz4": {"compression": CompressionType.LZ4, "chunk_size": 5000},
    "uncompressed": {"compression": CompressionType.NONE},
    "no chunks": {"use_chunking": False},
    "no repeated schemas": {"repeat_schemas": False},
    "no repeated channels": {"repeat_channels": False},
    "no statistics": {"use_statistics": False, "chunk_size": 500},
    "no index": {"index_types": IndexType.NONE, "chunk_size": 500},
    "no summary": {
        "repeat_schemas": False,
        "repeat_channels": False,
        "use_statistics": False,
        "index_types": IndexType.NONE,
        "use_summary_offsets": False,
    },
    "no chunks, no summary": {
        "use_chunking": False,
        "repeat_schemas": False,
        "repeat_channels": False,
        "use_statistics": False,
        "index_types": IndexType.NONE,
        "use_summary_offsets": False,
    },
}


@pytest.mark.parametrize("options", LAYOUTS.values(), ids=LAYOUTS)
def test_every_valid_layout_is_read_in_order_of_time(
    tmp_path: Path, options: dict[str, object]
) -> None:
    chosen = random.Random(7)
    times = [chosen.randrange(1000) for _ in range(400)]
    write_mcap(tmp_path / "bag.mcap", times, **options)
    bag = Bag(tmp_path / "bag.mcap")
    assert {topic.name: topic.messages for topic in bag.topics()} == {"topic0": 200, "topic1": 200}
    assert {topic.type_name for topic in bag.topics()} == {"std_msgs/msg/String"}
    expected = sorted(range(400), key=lambda number: times[number])
    assert numbers(bag.messages()) == expected
    assert numbers(bag.messages(["topic1"])) == [number for number in expected if number % 2]
    assert numbers(bag.messages([])) == []
    some = [number for number in expected if 300 <= times[number] <= 700]
    assert numbers(bag.messages(since=300, until=700)) == some
    assert bag.span == (min(times), max(times))
    assert bag.damage is None


def test_files_of_a_bag_are_merged_by_time(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", [0, 20, 40], chunk_size=1)
    write_mcap(tmp_path / "b.mcap", [10, 30, 50], chunk_size=1)
    bag = Bag(tmp_path)
    assert [message.log_time for message in bag.messages()] == [0, 10, 20, 30, 40, 50]
    assert "no metadata.yaml" in bag.warnings[0]


def test_memory_holds_only_chunks_whose_times_overlap(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap", list(range(40_000)), chunk_size=50_000)
    tracemalloc.start()
    count = sum(1 for _ in Bag(tmp_path / "bag.mcap").messages())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 40_000
    assert peak < 1_500_000  # the messages alone are 4 MB


def test_only_the_wanted_time_is_read(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), chunk_size=5000)
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    first = whole.index(b"zstd")
    whole[first + 40 : first + 60] = bytes(20)
    bag = damaged(tmp_path, bytes(whole))
    assert numbers(bag.messages(since=250)) == list(range(250, 300))
    assert bag.damage is None  # the damage lies before
    assert numbers(bag.messages(until=250))[-1] == 250
    assert bag.damage is not None


@pytest.mark.parametrize(
    "text",
    ["", "- [", "a: &a [*a]", "[1, 2]", "rosbag2_bagfile_information:\n  relative_file_paths: 3"],
)
def test_metadata_that_say_nothing_are_passed_over(tmp_path: Path, text: str) -> None:
    write_mcap(tmp_path / "bag.mcap", [1, 2, 3])
    (tmp_path / "metadata.yaml").write_text(text)
    bag = Bag(tmp_path)
    assert numbers(bag.messages()) == [0, 1, 2]
    assert "does not say which files" in bag.warnings[0]


# Damage


def damaged(tmp_path: Path, data: bytes) -> Bag:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    return Bag(path)


@pytest.mark.parametrize("name", ["all", "small chunks", "lz4", "uncompressed", "no chunks"])
def test_a_file_cut_off_gives_all_before_the_cut(tmp_path: Path, name: str) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), **LAYOUTS[name])
    whole = (tmp_path / "whole.mcap").read_bytes()
    recovered = []
    for size in range(8, len(whole), max(1, len(whole) // 60)):
        bag = damaged(tmp_path, whole[:size])
        found = numbers(bag.messages())
        assert found == list(range(len(found)))
        assert bag.damage is not None
        assert bag.damage.startswith(f"{tmp_path / 'damaged.mcap'}: is damaged")
        # The last cuts leave the summary, which tells how many there were.
        assert re.search(rf"; {len(found)} (of 300 )?messages could be read$", bag.damage)
        assert sum(topic.messages for topic in bag.topics()) == len(found)
        recovered.append(len(found))
    assert recovered == sorted(recovered)
    assert recovered[-1] == 300


def test_a_cut_in_an_uncompressed_chunk_loses_only_what_is_cut(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), compression=CompressionType.NONE)
    whole = (tmp_path / "whole.mcap").read_bytes()
    last = whole.index((200).to_bytes(4, "little") * 25)
    assert numbers(damaged(tmp_path, whole[:last]).messages()) == list(range(200))


def test_a_damaged_chunk_does_not_cost_the_next(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), chunk_size=5000)
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    second = whole.index(b"zstd", whole.index(b"zstd") + 4)
    whole[second + 40 : second + 60] = bytes(20)
    bag = damaged(tmp_path, bytes(whole))
    found = numbers(bag.messages())
    assert 200 < len(found) < 300
    assert (found[0], found[-1]) == (0, 299)
    assert bag.damage is not None
    assert "damaged at byte" in bag.damage


def test_altered_messages_are_told(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), compression=CompressionType.NONE)
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    whole[whole.index((200).to_bytes(4, "little") * 25)] = 255
    bag = damaged(tmp_path, bytes(whole))
    assert sum(1 for _ in bag.messages()) == 300
    assert bag.damage is not None
    assert "checksum is wrong" in bag.damage


def test_absurd_sizes_that_a_chunk_claims_are_not_believed(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)))
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    size = whole.index(b"zstd") - 16
    whole[size : size + 8] = (2**40).to_bytes(8, "little")
    bag = damaged(tmp_path, bytes(whole))
    assert numbers(bag.messages()) == list(range(300))  # only the claim is damaged
    assert bag.damage is not None
    assert "claims to unpack to 1099511627776 bytes" in bag.damage


def test_a_chunk_that_claims_more_data_than_it_has_is_read(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)))
    whole = bytearray((tmp_path / "whole.mcap").read_bytes())
    size = whole.index(b"zstd") + 4
    whole[size + 7] = 255  # more than any stream can have
    bag = damaged(tmp_path, bytes(whole))
    assert numbers(bag.messages()) == list(range(300))
    assert bag.damage is not None
    assert "a chunk breaks off" in bag.damage


def test_a_message_too_short_does_not_cost_the_next(tmp_path: Path) -> None:
    write_mcap(tmp_path / "whole.mcap", list(range(300)), **LAYOUTS["no chunks"])
    whole = (tmp_path / "whole.mcap").read_bytes()
    place = whole.index((150).to_bytes(4, "little") * 25) - 22 - 9
    short = b"\x05" + (21).to_bytes(8, "little") + bytes(21)
    bag = damaged(tmp_path, whole[:place] + short + whole[place:])
    assert numbers(bag.messages()) == list(range(300))
    assert bag.damage is not None
    assert (
        f"damaged at byte {place} (a record claims 21 bytes, which none of its kind has)"
        in bag.damage
    )


def test_a_byte_too_many_before_a_torn_index_is_damage_and_no_more(tmp_path: Path) -> None:
    """It looks like the beginning of a chunk, in a file that was cut off in a later index."""
    write_mcap(tmp_path / "sound.mcap", [1, 2, 3], topics=3)
    data = (tmp_path / "sound.mcap").read_bytes()
    places = {}
    place = 8
    while data[place] != Opcode.DATA_END:
        places.setdefault(data[place], place)
        place += 9 + int.from_bytes(data[place + 1 : place + 9], "little")
    first, end = places[Opcode.MESSAGE_INDEX], place
    bag = damaged(tmp_path, data[:first] + b"\x06" + data[first : end - 10])
    assert numbers(bag.messages()) == [0, 1, 2]
    assert f"at byte {first}" in (bag.damage or "")


def test_random_damage_never_raises(tmp_path: Path) -> None:
    generator = random.Random(3)
    for name in ("all", "small chunks", "lz4", "no chunks"):
        write_mcap(tmp_path / "whole.mcap", list(range(100)), **LAYOUTS[name])
        whole = (tmp_path / "whole.mcap").read_bytes()
        for _ in range(100):
            data = bytearray(whole)
            for _ in range(generator.choice([1, 20])):
                data[generator.randrange(8, len(data))] = generator.randrange(256)
            bag = damaged(tmp_path, bytes(data))
            bag.topics()
            assert sum(1 for _ in bag.messages()) <= 110
            assert bag.damage is None or bag.damage.endswith("messages could be read")


def test_a_bad_file_of_a_split_bag_does_not_cost_the_others(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag_0.mcap", [0, 1])
    (tmp_path / "bag_1.mcap").touch()
    bag = Bag(tmp_path)
    assert numbers(bag.messages()) == [0, 1]
    assert bag.damage == f"{tmp_path / 'bag_1.mcap'}: is empty; record it again"


# No bag at all


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "is empty; record it again"),
        (b"episode,x,y,action\n", "is no MCAP file; name a rosbag2 folder"),
        (
            b"\x28\xb5\x2f\xfd1234",
            "compressed as a whole, but the file cannot be unpacked to its end",
        ),
        (b"SQLite format 3\0rest", "convert it with `ros2 bag convert` or `rosbags-convert`"),
        (b"#ROSBAG V2.0\nrest", "is a bag of ROS 1; convert it with `rosbags-convert`"),
    ],
)
def test_what_is_no_mcap_file_is_said_in_words(
    tmp_path: Path, content: bytes, problem: str
) -> None:
    path = tmp_path / "demo.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        Bag(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert not str(caught.value).endswith(".")
    assert problem in str(caught.value)


def test_a_missing_bag_is_said_in_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: does not exist; name a rosbag2 folder"):
        Bag(tmp_path / "nowhere")


def test_a_folder_without_bags_is_said_in_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r": holds no \.mcap file; .*`$"):
        Bag(tmp_path)


def test_a_bag_that_goes_away_is_damaged(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", [0, 1])
    bag = Bag(tmp_path / "a.mcap")
    (tmp_path / "a.mcap").unlink()
    assert list(bag.messages()) == []
    assert bag.damage is not None
    assert "cannot be read" in bag.damage
