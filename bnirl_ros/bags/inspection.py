"""What is in a bag, what the inference could use of it, and what it lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from bnirl_ros.bags.definitions import known_types
from bnirl_ros.bags.raw_demonstration import action_topics, motion_topics
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.topics import Topic, absolute
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.demonstrations.raw_messages import COMMAND_TYPES, TF

_SERVICE_EVENTS = "/_service_event"  # how the names of the topics end on which services tell


@dataclass(frozen=True)
class Inspection:
    """What a bag was found to hold, once all of it was read.

    Attributes:
        path: of the bag.
        files: its MCAP files.
        topics: by name, with the number of messages that can be read.
        motion: those that tell motion, in the order in which they are tried; none where poses and
            actions are taken.
        start, end: the first and the last log time [ns]; None without messages.
        use: sentences on what the inference takes of it.
        lacks: sentences on what is missing, and what to do.
        warnings: sentences on what is wrong with it, but loses nothing.
        damage: a sentence on where it is damaged and what is lost; None for a sound one.
    """

    path: Path
    files: tuple[Path, ...]
    topics: tuple[Topic, ...]
    motion: tuple[Topic, ...]
    start: int | None
    end: int | None
    use: tuple[str, ...]
    lacks: tuple[str, ...]
    warnings: tuple[str, ...]
    damage: str | None

    @property
    def messages(self) -> int:
        return sum(topic.messages for topic in self.topics)


def inspect(path: str | Path, remappings: Mapping[str, str] = MappingProxyType({})) -> Inspection:
    """Read a bag from end to end and tell what is in it.

    Args:
        path: the bag.
        remappings: as of `read_demonstration`.

    Raises:
        InputError: nothing of it can be read.
    """
    bag = Bag(path)
    start = end = None
    counts: dict[tuple[str, str, str], int] = {}
    for message in bag.messages():
        counts[message.key] = counts.get(message.key, 0) + 1
        start = message.log_time if start is None else min(start, message.log_time)
        end = message.log_time if end is None else max(end, message.log_time)
    topics = tuple(replace(topic, messages=counts.get(topic.key, 0)) for topic in bag.topics())
    use, lacks = _use_of(topics, remappings)
    return Inspection(
        path=bag.path,
        files=tuple(bag.files),
        topics=topics,
        motion=() if action_topics(topics) else tuple(motion_topics(topics)),
        start=start,
        end=end,
        use=use,
        lacks=lacks,
        warnings=tuple(bag.warnings),
        damage=bag.damage,
    )


def why_not_read(topic: Topic) -> str | None:
    """Why the messages of a topic cannot be decoded; None if they can."""
    if topic.encoding != "cdr":
        return f"encoded as {topic.encoding or 'nothing'}, not cdr"
    if topic.name.endswith(_SERVICE_EVENTS):
        return "service events"
    if not topic.type_name:
        return "no type is told"
    if topic.type_name not in known_types():
        return "type unknown to bnirl_ros"
    return None


def _use_of(
    topics: tuple[Topic, ...], remappings: Mapping[str, str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What `bnirl infer` would take of a bag, and what it lacks."""
    names = {name: absolute(remappings.get(name, name)) for name in TOPIC_TYPES}
    there = {
        name: topic
        for name, type_name in TOPIC_TYPES.items()
        for topic in topics
        if topic.name == names[name] and topic.type_name == type_name and topic.messages
    }
    use, lacks = [], []
    sources = motion_topics(topics)
    if "pose" in there and "action" in there:
        use.append(f"poses and actions from {names['pose']} and {names['action']}")
    elif others := action_topics(topics):
        missing = "pose" if "action" in there else "action"
        use.append("nothing yet")
        lacks.append(
            f"no {names[missing]} ({TOPIC_TYPES[missing]}): name the right topics, as with "
            f"`--remap {missing}:={'/topic' if missing == 'pose' else others[0].name}`"
        )
    elif sources:
        best = sources[0]
        use.append(f"motion from {best.name} ({best.type_name}), {best.messages} messages")
        if len(sources) > 1:
            use[0] += ", or from the next one that can be used; --source names another"
        lacks += _needs_of(best, topics)
    else:
        use.append("nothing")
        lacks.append(
            "no topic tells where the demonstrator was: record /pose and /action, odometry, "
            "stamped poses such as AMCL's, tf, or velocity commands"
        )
    if "map" in there:
        use.append(f"the map from {names['map']}")
    elif use != ["nothing"]:
        lacks.append(
            "no map: give one with `--map`"
            + ("; without one the surroundings are taken for open space" if sources else "")
        )
    return tuple(use), tuple(lacks)


def _needs_of(source: Topic, topics: tuple[Topic, ...]) -> list[str]:
    """What a source of motion needs beside itself and is not in the bag."""
    if source.type_name in COMMAND_TYPES:
        return [f"{source.name} tells no place: give the first pose with `--start x,y,heading`"]
    has_tf = any(topic.type_name == TF and topic.messages for topic in topics)
    if source.type_name == "nav_msgs/msg/Odometry" and not has_tf:
        return [
            f"no tf, which would bring {source.name} to the map's frame: name the frame in which "
            "it is with `--map-frame`, if that is the map's"
        ]
    return []
