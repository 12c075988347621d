"""The definitions that come with the package are ROS's, and laid out as rosbag2 lays them out."""

import json
from pathlib import Path

import pytest
from mcap.records import Schema
from mcap.stream_reader import StreamReader

from bag_support import SHARED_BAGS, needs_ros_definitions, needs_shared_bags, ros_share
from bnirl_ros.bags import definitions
from bnirl_ros.bags.definitions import (
    full_type_name,
    known_types,
    message_definition,
    type_hash,
)
from bnirl_ros.errors import InputError
from bnirl_ros.resources import share_folder


def installed(type_name: str, suffix: str) -> Path:
    package, _, name = type_name.split("/")
    share = ros_share(package)
    assert share is not None
    return share / "msg" / f"{name}{suffix}"


# tf2_msgs is none of the wheels: without a ROS installation a recorded bag has to do, see below.
INSTALLED = [name for name in known_types() if ros_share(name.split("/")[0])]


@needs_ros_definitions
@pytest.mark.parametrize("name", INSTALLED)
def test_definitions_are_verbatim(name: str) -> None:
    package, folder, short = name.split("/")
    ours = share_folder() / "msg_schemas" / package / folder / f"{short}.msg"
    assert ours.read_bytes() == installed(name, ".msg").read_bytes()


@needs_ros_definitions
@pytest.mark.parametrize("name", INSTALLED)
def test_hashes_are_those_of_ros(name: str) -> None:
    described = json.loads(installed(name, ".json").read_text())
    hashes = {each["type_name"]: each["hash_string"] for each in described["type_hashes"]}
    assert type_hash(name) == hashes[name]


def test_a_definition_holds_every_type_once_depth_first() -> None:
    text = message_definition("geometry_msgs/msg/PoseStamped")
    assert [line for line in text.splitlines() if line.startswith("MSG: ")] == [
        "MSG: geometry_msgs/Pose",
        "MSG: geometry_msgs/Point",
        "MSG: geometry_msgs/Quaternion",
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
    ]
    assert f"\n\n{'=' * 80}\nMSG: geometry_msgs/Pose\n" in text


@needs_ros_definitions
@needs_shared_bags
def test_the_layout_is_that_of_a_recorded_bag(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the installed definitions in place of ours, as not all of the bags' types are ours."""

    our_text = definitions._text

    def installed_text(name: str) -> str:
        there = ros_share(name.split("/")[0])
        return installed(name, ".msg").read_text() if there else our_text(name)

    monkeypatch.setattr(definitions, "_text", installed_text)
    compared = set()
    for path in sorted(SHARED_BAGS.glob("*/*.mcap")):
        with path.open("rb") as stream:
            for record in StreamReader(stream).records:
                if isinstance(record, Schema) and (
                    record.name in known_types() or ros_share(record.name.split("/")[0])
                ):
                    recorded = record.data.decode()
                    assert message_definition.__wrapped__(record.name) == recorded
                    compared.add(record.name)
    definitions._closure.cache_clear()
    assert compared == {
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/Twist",
        "nav_msgs/msg/Odometry",
        "tf2_msgs/msg/TFMessage",
    }


@pytest.mark.parametrize(
    "name", ["std_msgs/msg/String", "nonsense", "", "../msg/Path", "nav_msgs/msg/../../README"]
)
def test_an_unknown_type_is_said_in_words(name: str) -> None:
    with pytest.raises(InputError, match=r"unknown to bnirl_ros.*nav_msgs/msg/OccupancyGrid"):
        message_definition(name)


def test_names_are_completed() -> None:
    assert full_type_name("nav_msgs/Path") == "nav_msgs/msg/Path"
    assert full_type_name("nav_msgs/msg/Path") == "nav_msgs/msg/Path"
    assert full_type_name("pkg/srv/Some_Event") == "pkg/srv/Some_Event"
