"""Bags are inspected and repaired: what is lost is told, what is saved is what was recorded."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from bag_support import SHARED_BAGS, needs_shared_bags
from bnirl_ros.bags.inspection import inspect, why_not_read
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.repair import repair
from bnirl_ros.bags.topics import RawMessage, Topic
from bnirl_ros.cli import main
from bnirl_ros.errors import InputError
from test_bags_reader import write_mcap

BAGS = Path(__file__).resolve().parent.parent / "bags"
LOOP = BAGS / "paper_loop"
KITCHEN = BAGS / "overcooked_random3" / "overcooked_random3_0.mcap"


def kept(topic: Topic) -> tuple[object, ...]:
    """What a repair keeps of a topic: all but the number of its schema."""
    definition = topic.schema and (topic.schema.name, topic.schema.encoding, topic.schema.data)
    return (topic.key, topic.messages, topic.qos, topic.type_hash, definition)


def messages(path: Path) -> list[RawMessage]:
    return list(Bag(path).messages())


def test_a_sound_bag_is_written_as_it_was(tmp_path: Path) -> None:
    repaired = repair(LOOP, tmp_path / "new")
    assert (repaired.damage, repaired.messages, repaired.expected) == (None, 604, 604)
    assert messages(tmp_path / "new") == messages(LOOP)
    found, old = Bag(tmp_path / "new").topics(), Bag(LOOP).topics()
    assert list(map(kept, found)) == list(map(kept, old))
    assert [topic.metadata for topic in found] == [topic.metadata for topic in old]


@needs_shared_bags
@pytest.mark.parametrize(
    "path",
    sorted(SHARED_BAGS.rglob("*.mcap")),
    ids=lambda path: str(path.relative_to(SHARED_BAGS)),
)
def test_recordings_keep_all_that_they_have(tmp_path: Path, path: Path) -> None:
    new = tmp_path / "new"
    assert repair(path, new).damage is None
    assert messages(new) == messages(path)
    old, found = Bag(path).topics(), Bag(new).topics()
    assert list(map(kept, found)) == list(map(kept, old))
    told = yaml.safe_load((new / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert told["message_count"] == sum(topic.messages for topic in old)


def test_two_other_readers_read_what_was_repaired(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(KITCHEN.read_bytes()[:60_000])
    saved = messages(broken)
    assert {each.topic for each in saved} == {"/map", "/pose", "/action"}
    new = tmp_path / "new"
    repaired = repair(broken, new)
    assert (repaired.messages, repaired.expected) == (len(saved), None)
    assert repaired.damage is not None
    topics = {topic.name: topic for topic in Bag(KITCHEN).topics()}
    with Reader(new) as reader:
        theirs = [(c.topic, time, bytes(data)) for c, time, data in reader.messages()]
        for connection in reader.connections:
            topic = topics[connection.topic]
            assert (connection.msgtype, connection.digest) == (topic.type_name, topic.type_hash)
            (offered,) = connection.ext.offered_qos_profiles
            (qos,) = topic.qos
            assert offered.durability.name.lower() == qos.durability
            assert offered.depth == qos.depth
        assert {each.topic for each in reader.connections} == set(topics)
    assert sorted(theirs) == sorted((each.topic, each.log_time, each.data) for each in saved)
    counts: Counter[str] = Counter()
    with (new / "new_0.mcap").open("rb") as stream:
        for _, channel, message, decoded in make_reader(
            stream, validate_crcs=True, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            counts[channel.topic] += 1
            assert channel.metadata["topic_type_hash"] == topics[channel.topic].type_hash
            if channel.topic == "/pose":
                stamp = decoded.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
    assert counts == Counter(each.topic for each in saved)


def test_times_that_no_bag_can_hold_are_left_out(tmp_path: Path) -> None:
    write_mcap(tmp_path / "old.mcap", [1, 2, 2**64 - 1])
    repaired = repair(tmp_path / "old.mcap", tmp_path / "new")
    assert (repaired.messages, repaired.left_out) == (2, 1)


def test_nothing_is_repaired_onto_itself_or_out_of_nothing(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag_0.mcap", [1, 2])
    with pytest.raises(InputError, match="is where the damaged bag lies; choose another"):
        repair(tmp_path, tmp_path, overwrite=True)
    empty = tmp_path / "empty.mcap"
    empty.write_bytes((tmp_path / "bag_0.mcap").read_bytes()[:30])
    with pytest.raises(InputError, match="is damaged at byte"):
        repair(empty, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_command_repairs_and_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray(KITCHEN.read_bytes())
    data[50_000:50_100] = bytes(100)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    saved, all_of_it = len(messages(broken)), Bag(KITCHEN).expected
    assert all_of_it is not None
    assert 0 < saved < all_of_it
    assert main(["bag", "info", str(broken), str(tmp_path / "none"), str(LOOP)]) == 1
    told = capsys.readouterr()
    assert f"{broken}: {saved} messages in broken.mcap" in told.out
    assert f"{LOOP}: 604 messages in paper_loop_0.mcap" in told.out
    first, second = told.err.splitlines()
    assert (
        f"{saved} of {all_of_it} messages could be read; save them with `bnirl bag repair" in first
    )
    assert "none: does not exist" in second
    new = tmp_path / "new"
    assert main(["bag", "repair", str(broken), "--out", str(new)]) == 0
    written, lost = capsys.readouterr().out.splitlines()
    assert written == f"Written: {new}, {saved} messages on 3 topics"
    assert lost.startswith(
        f"Lost: {all_of_it - saved} of {all_of_it} messages: {broken}: is damaged at byte "
    )
    assert main(["bag", "info", str(new)]) == 0
    assert main(["bag", "repair", str(new), "--out", str(new)]) == 1
    assert main(["bag", "repair", str(LOOP), "--out", str(tmp_path / "other")]) == 0
    assert capsys.readouterr().out.endswith("Lost: nothing, the bag was sound\n")


@needs_shared_bags
def test_what_cannot_be_decoded_is_told() -> None:
    services = inspect(SHARED_BAGS / "rosbag2" / "tests__bag_with_topics_and_service_events")
    assert {topic.name: why_not_read(topic) for topic in services.topics} == {
        "/events/write_split": "type unknown to bnirl_ros",
        "/test_service1/_service_event": "service events",
        "/test_service2/_service_event": "service events",
        "/test_topic1": "type unknown to bnirl_ros",
        "/test_topic2": "type unknown to bnirl_ros",
    }
    wrong = inspect(SHARED_BAGS / "rosbag2" / "tests__wrong_rmw_test")
    assert {why_not_read(topic) for topic in wrong.topics} == {"encoded as wrong_format, not cdr"}
    robot = inspect(SHARED_BAGS / "nav2_turtlebot")
    assert [topic.name for topic in robot.motion] == ["/odom", "/amcl_pose", "/tf"]
    assert robot.use[0].startswith("motion from /odom")
    (lacks,) = robot.lacks
    assert lacks.startswith("no map: give one with `--map`")
    (command,) = inspect(SHARED_BAGS / "turtle_waypoints").lacks[:1]
    assert "--start x,y,heading" in command
