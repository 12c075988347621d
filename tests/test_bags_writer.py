"""Bags that are written are what rosbag2 writes: others read them, and none is left by half."""

from collections import Counter
from pathlib import Path as File

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from bnirl_ros.bags.definitions import message_definition, type_hash
from bnirl_ros.bags.qos import LATCHED, RELIABLE, QosProfile, qos_from_yaml, qos_to_yaml
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.errors import InputError
from bnirl_ros.views.messages import (
    Header,
    MapMetaData,
    Marker,
    MarkerArray,
    OccupancyGrid,
    Point,
    Pose,
    PoseStamped,
    Time,
    Vector3,
    Vector3Stamped,
)

TOPICS = {
    "map": (OccupancyGrid.TYPE, LATCHED),
    "pose": (PoseStamped.TYPE, RELIABLE),
    "action": (Vector3Stamped.TYPE, RELIABLE),
    "/subgoals": (MarkerArray.TYPE, LATCHED),
    "unused": (PoseStamped.TYPE, RELIABLE),
}
STEPS = 500
MILLISECOND = 1_000_000


def header(time: int) -> Header:
    return Header(Time(*divmod(time, 10**9)), "map")


def write_example(folder: File, *, overwrite: bool = False) -> None:
    grid = OccupancyGrid(
        header(0), MapMetaData(resolution=1.0, width=3, height=2), np.zeros(6, dtype=np.int8)
    )
    with BagWriter(folder, overwrite=overwrite) as writer:
        for name, (type_name, qos) in TOPICS.items():
            writer.add_topic(name, type_name, qos)
        writer.write("map", grid, 0)
        for step in range(STEPS):
            time = 1_700_000_000 * 10**9 + step * 200 * MILLISECOND
            place = Pose(Point(step % 3 + 0.5, 0.5))
            writer.write("pose", PoseStamped(header(time), place), time)
            writer.write("action", Vector3Stamped(header(time), Vector3(1.0)), time)
        writer.write("/subgoals", MarkerArray([Marker(action=Marker.DELETEALL)]), time)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> File:
    folder = tmp_path_factory.mktemp("bags") / "example"
    write_example(folder)
    return folder


COUNTS = {"map": 1, "pose": STEPS, "action": STEPS, "/subgoals": 1, "unused": 0}


def test_our_reader_reads_it(bag: File) -> None:
    opened = Bag(bag)
    found = {topic.name: topic for topic in opened.topics()}
    assert {name: topic.messages for name, topic in found.items()} == COUNTS
    for name, (type_name, qos) in TOPICS.items():
        assert found[name].type_name == type_name
        assert found[name].qos == (qos,)
        assert found[name].type_hash == type_hash(type_name)
    counts = Counter(message.topic for message in opened.messages())
    assert counts == Counter(COUNTS)
    assert (opened.damage, opened.warnings) == (None, [])


def test_rosbags_reads_it(bag: File) -> None:
    ours = list(Bag(bag).messages())
    with Reader(bag) as reader:
        assert reader.ros_distro == "jazzy"
        assert reader.message_count == sum(COUNTS.values())
        for connection in reader.connections:
            type_name, qos = TOPICS[connection.topic]
            assert connection.msgtype == type_name
            assert connection.msgcount == COUNTS[connection.topic]
            assert connection.digest == type_hash(type_name)
            (offered,) = connection.ext.offered_qos_profiles
            read = (offered.reliability, offered.durability, offered.history)
            words = (qos.reliability, qos.durability, qos.history)
            assert tuple(each.name.lower() for each in read) == words
            assert offered.depth == qos.depth
        theirs = [(c.topic, time, bytes(data)) for c, time, data in reader.messages()]
    assert sorted(theirs) == sorted((each.topic, each.log_time, each.data) for each in ours)


def test_mcap_ros2_support_reads_it(bag: File) -> None:
    counts: Counter[str] = Counter()
    with (bag / "example_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            if channel.topic == "pose":
                stamp = decoded.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
                assert decoded.pose.orientation.w == 1.0
    assert counts == Counter(COUNTS)


def test_the_file_is_laid_out_as_rosbag2_does(bag: File) -> None:
    with (bag / "example_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        (metadata,) = reader.iter_metadata()
        assert reader.get_header().profile == "ros2"
        assert sum(1 for _ in reader.iter_messages()) == sum(COUNTS.values())
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(COUNTS.values())
    assert {
        each.topic: each.message_encoding for each in summary.channels.values()
    } == dict.fromkeys(TOPICS, "cdr")
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
        assert schema.data.decode() == message_definition(schema.name)
    for channel in summary.channels.values():
        assert channel.metadata == {
            "offered_qos_profiles": qos_to_yaml([TOPICS[channel.topic][1]]),
            "topic_type_hash": type_hash(TOPICS[channel.topic][0]),
        }
    for chunk in summary.chunk_indexes:
        assert chunk.compression == "zstd"
        assert chunk.message_index_offsets
    assert metadata.name == "rosbag2"
    beside = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert yaml.safe_load(metadata.metadata["serialized_metadata"]) == beside


def test_metadata_are_those_of_version_9(bag: File) -> None:
    values = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    last = 1_700_000_000 * 10**9 + (STEPS - 1) * 200 * MILLISECOND
    assert values["version"] == 9
    assert values["duration"]["nanoseconds"] == last
    assert values["relative_file_paths"] == ["example_0.mcap"]
    assert values["files"][0]["message_count"] == sum(COUNTS.values())
    topics = values["topics_with_message_count"]
    assert {each["topic_metadata"]["name"]: each["message_count"] for each in topics} == COUNTS
    (qos,) = topics[0]["topic_metadata"]["offered_qos_profiles"]
    assert qos["durability"] == "transient_local"
    assert qos["lifespan"] == {"sec": 9223372036, "nsec": 854775807}


def test_the_same_calls_give_the_same_bytes(bag: File, tmp_path: File) -> None:
    write_example(tmp_path / "example")
    for name in ("example_0.mcap", "metadata.yaml"):
        assert (tmp_path / "example" / name).read_bytes() == (bag / name).read_bytes()


def test_nothing_is_left_when_writing_fails(tmp_path: File) -> None:
    def write_and_fail() -> None:
        with BagWriter(tmp_path / "half") as writer:
            writer.add_topic("pose", PoseStamped.TYPE, RELIABLE)
            writer.write("pose", PoseStamped(), 0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_and_fail()
    assert list(tmp_path.iterdir()) == []


def test_a_failing_overwrite_leaves_the_old_bag(tmp_path: File) -> None:
    write_example(tmp_path / "old")
    before = (tmp_path / "old" / "old_0.mcap").read_bytes()
    with (
        pytest.raises(ValueError, match="not added"),
        BagWriter(tmp_path / "old", overwrite=True) as writer,
    ):
        writer.write("pose", PoseStamped(), 0)
    assert (tmp_path / "old" / "old_0.mcap").read_bytes() == before
    assert Bag(tmp_path / "old").damage is None


def test_a_bag_is_overwritten_only_when_asked(tmp_path: File) -> None:
    folder = tmp_path / "example"
    write_example(folder)
    (folder / "README.md").write_text("whose data these are")
    (folder / "example_1.mcap").write_text("a split of the bag before")
    with pytest.raises(InputError, match="exists already; choose another name"):
        write_example(folder)
    write_example(folder, overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md",
        "example_0.mcap",
        "metadata.yaml",
    ]


def test_a_folder_that_cannot_be_made_is_said_in_words(tmp_path: File) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        write_example(tmp_path / "file" / "bag")


def test_an_empty_bag_is_a_bag(tmp_path: File) -> None:
    with BagWriter(tmp_path / "empty: no" / "bag #1") as writer:
        writer.add_topic("pose", PoseStamped.TYPE, RELIABLE)
    opened = Bag(tmp_path / "empty: no" / "bag #1")
    assert list(opened.messages()) == []
    assert [topic.name for topic in opened.topics()] == ["pose"]
    assert (opened.damage, opened.warnings) == (None, [])


def test_no_message_goes_where_it_does_not_belong(tmp_path: File) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("pose", PoseStamped.TYPE, RELIABLE)
        with pytest.raises(ValueError, match="in the bag already"):
            writer.add_topic("pose", PoseStamped.TYPE, RELIABLE)
        with pytest.raises(ValueError, match="no name for a topic"):
            writer.add_topic("a topic", PoseStamped.TYPE, RELIABLE)
        with pytest.raises(InputError, match="unknown to bnirl_ros"):
            writer.add_topic("scan", "sensor_msgs/msg/LaserScan", RELIABLE)
        with pytest.raises(ValueError, match="carries geometry_msgs/msg/PoseStamped"):
            writer.write("pose", Vector3Stamped(), 0)
        with pytest.raises(ValueError, match="no time that a bag can hold"):
            writer.write("pose", PoseStamped(), -1)
    with pytest.raises(ValueError, match="inside its with statement"):
        writer.write("pose", PoseStamped(), 0)


def test_qos_survives_its_yaml() -> None:
    profiles = (RELIABLE, LATCHED, QosProfile("best_effort", "volatile", "keep_all", 0))
    assert qos_from_yaml(qos_to_yaml(profiles)) == profiles


@pytest.mark.parametrize(
    ("text", "profiles"),
    [
        (
            "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n",
            (QosProfile("reliable", "volatile", "unknown", 0),),
        ),
        (
            "- history: 1\n  depth: 1\n  reliability: 2\n  durability: 1\n",
            (QosProfile("best_effort", "transient_local", "keep_last", 1),),
        ),
        ("- history: [1]\n  durability: 77\n", (QosProfile(*["unknown"] * 3, 0),)),
        ("", ()),
        ("just words", ()),
        ("- [unclosed", ()),
        ("- 1\n- 2\n", ()),
    ],
)
def test_qos_of_older_bags_is_read(text: str, profiles: tuple[QosProfile, ...]) -> None:
    assert qos_from_yaml(text) == profiles
