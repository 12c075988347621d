"""A demonstration bag: the pose, action and map topics of the contract, as a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from bnirl_ros.bags.cdr import decode
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.topics import absolute
from bnirl_ros.demonstrations.messages import TOPIC_TYPES, map_of, take_action, take_pose
from bnirl_ros.demonstrations.recording import Recorder, Recording
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap


@dataclass(frozen=True, eq=False)
class RecordedDemonstration:
    """What a bag holds of a demonstration.

    Attributes:
        recording: its poses and actions.
        grid_map: the last map in it that can be used; None if there is none.
        faults: how often each fault occurred among the messages that cannot be used.
        warnings: sentences on what is wrong with the bag, but loses nothing.
        damage: a sentence on where the bag is damaged and what is lost; None for a sound one.
        opened: cells (x, y) of the map that are free only since the robot was in them.
        map_is_assumed: whether the map is open space that was taken for lack of any.
    """

    recording: Recording
    grid_map: GridMap | None
    faults: Counter[str]
    warnings: tuple[str, ...]
    damage: str | None
    opened: tuple[tuple[int, int], ...] = ()
    map_is_assumed: bool = False


def read_demonstration(
    path: str | Path, remappings: Mapping[str, str] = MappingProxyType({})
) -> RecordedDemonstration:
    """Read a demonstration from a rosbag2 folder or an MCAP file.

    Args:
        path: the bag.
        remappings: recorded topic by the contract's name for it, such as {"pose": "/robot/pose"};
            names that are not in it stand for themselves.

    Raises:
        InputError: the bag cannot be read, has no pose or action topic, or one of another type;
            the sentence tells which topics it has.
    """
    bag = Bag(path)
    names = {name: absolute(remappings.get(name, name)) for name in TOPIC_TYPES}
    types = {topic.name: topic.type_name for topic in bag.topics()}
    for name, type_name in TOPIC_TYPES.items():
        recorded = types.get(names[name])
        if recorded is None and name != "map":
            raise InputError(_without(names[name], name, types, bag))
        if recorded not in (None, type_name):
            raise InputError(
                f"{path}: topic {names[name]} is of type {recorded}, not {type_name}; "
                f"name the right one with --remap {name}:=/topic"
            )
    recorder = Recorder()
    recorder.map_arrived()  # nothing waits for a map: it is looked for in all of the bag
    faults: Counter[str] = Counter()
    grid_map = None
    name_of = {topic: name for name, topic in names.items()}
    for raw in bag.messages(names.values()):
        name = name_of[raw.topic]
        try:
            message = decode(TOPIC_TYPES[name], raw.data)
            if name == "map":
                grid_map = map_of(message, f"{path}, topic {raw.topic}")
            elif name == "pose":
                take_pose(recorder, message)
            else:
                take_action(recorder, message)
        except InputError as error:
            faults[str(error)] += 1
    return RecordedDemonstration(
        recording=recorder.snapshot(),
        grid_map=grid_map,
        faults=faults + recorder.faults,
        warnings=tuple(bag.warnings),
        damage=bag.damage,
    )


def _without(topic: str, name: str, types: Mapping[str, str], bag: Bag) -> str:
    """The sentence on a bag that lacks a topic, or whose damage hides it."""
    wanted = f"{topic} ({TOPIC_TYPES[name]})"
    if bag.damage:
        return f"{bag.damage}, and no topic {wanted} was found; name a sound bag"
    if not types:
        return f"{bag.path}: has no topic at all; name a bag with the topic {wanted}"
    there = ", ".join(f"{topic} ({kind})" for topic, kind in types.items())
    return (
        f"{bag.path}: has no topic {wanted}, only {there}; "
        f"name the right one with --remap {name}:=/topic"
    )
