"""The topics of a replay: offered as they were recorded, and waited for."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node

from bnirl_ros.bags.qos import LATCHED, read_overrides
from bnirl_ros.bags.topics import RawMessage, Topic, absolute
from bnirl_ros.errors import InputError
from bnirl_ros.maps import load_map
from bnirl_ros.nodes.conversion import is_installed, message_class, to_ros
from bnirl_ros.nodes.qos import joint_offer, qos_profile
from bnirl_ros.nodes.replay_options import Options
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.belief import map_message

_DEPTH = 1000  # of a reliable publisher at least that plays at a pace
# Playing as fast as can be, so many messages of a topic are sent before all must be acknowledged.
# It is also the depth of the publisher: when the history is full, Fast DDS asks subscribers for
# acknowledgement (and has it in some 6 ms); otherwise it asks every three seconds only. And it is
# small: what overflows the transport is sent again at 256 messages in three seconds.
_ROUND = 50
_LOOK_PERIOD = 0.05  # [s] between two looks at what else there is to do
_STUCK_AFTER = 10.0  # [s] without acknowledgement after which a subscriber is given up
# Each of the nodes that publish fixed transforms latches one message, all on one topic.
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_TRANSFORMS_DEPTH = 100


class PlayedTopics:
    """Publishers of recorded topics, and the account of what was sent on them.

    Attributes:
        sent: messages by topic.
        skipped: why a topic is not sent.
        latched: how many messages are kept of each latched topic of the recording.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[Topic],
        options: Options,
        meanwhile: Callable[[], None],
    ) -> None:
        """Announce the wanted topics; those of a type that isn't installed are left out.

        Args:
            node: which publishes.
            topics: of the recording.
            options: which of them are wanted, and how.
            meanwhile: called again and again while subscribers are waited for.

        Raises:
            InputError: an option doesn't fit the topics, or the map cannot be used.
        """
        self.sent: Counter[str] = Counter()
        self.skipped: dict[str, str] = {}
        self.latched: dict[str, int] = {}
        self._node = node
        self._options = options
        self._meanwhile = meanwhile
        self._publishers: dict[str, Any] = {}
        self._types: dict[str, str] = {}  # a name may have several in a recording
        self._rounds: dict[str, int] = {}  # messages after which all must be acknowledged
        self._given_up: set[str] = set()  # topics that somebody doesn't acknowledge
        self._overrides = (
            {absolute(topic): qos for topic, qos in read_overrides(options.qos_overrides).items()}
            if options.qos_overrides
            else {}
        )
        for topic in topics:
            if not options.selection.has(topic.name):
                self.skipped[topic.name] = "not wanted"
            elif options.clock is not None and absolute(topic.name) == "/clock":
                self.skipped[topic.name] = "--clock takes its place"
            else:
                self._announce(topic)
        for fault in _unknown_names(options, topics):
            node.get_logger().warning(plain(fault))
        if options.grid_map:
            self._publish_map(options.grid_map)

    @property
    def names(self) -> frozenset[str]:
        """The topics that are sent."""
        return frozenset(self._publishers)

    def send(self, message: RawMessage, *, fast: bool) -> None:
        """Publish a recorded message.

        Args:
            message: of one of the topics.
            fast: whether to wait, every now and then, until all subscribers have what was sent.
        """
        topic = message.topic
        if message.type_name != self._types[topic] or message.encoding != "cdr":
            return
        self._publishers[topic].publish(message.data)
        self.sent[topic] += 1
        if fast and self.sent[topic] % self._rounds[topic] == 0:
            self._wait_until_acknowledged(topic)

    def wait_until_acknowledged(self) -> None:
        """Wait until every reliable subscriber has what was sent, unless one doesn't answer."""
        for topic in self._publishers:
            self._wait_until_acknowledged(topic)

    def subscriber_counts(self) -> dict[str, int]:
        """How many hear each topic."""
        return {
            topic: publisher.get_subscription_count()
            for topic, publisher in self._publishers.items()
        }

    def with_fewer_subscribers(self, wanted: int) -> list[str]:
        """The topics that fewer hear than that."""
        return [topic for topic, count in self.subscriber_counts().items() if count < wanted]

    def report(self) -> str:
        """A line on what was sent, and what was not and why."""
        parts = [f"{topic} {count}" for topic, count in sorted(self.sent.items())]
        parts += [f"{topic} not sent ({why})" for topic, why in sorted(self.skipped.items())]
        return f"sent {self.sent.total()} messages: {', '.join(parts) or 'none'}"

    def _announce(self, topic: Topic) -> None:
        if topic.name in self._publishers:
            self._skip(
                replace(topic, name=f"{topic.name} ({topic.type_name})"), "its name is taken"
            )
            return
        if topic.encoding != "cdr":
            self._skip(topic, f"encoded as {topic.encoding or 'nothing'}, not cdr")
            return
        if not is_installed(topic.type_name):
            self._skip(topic, f"type {topic.type_name or 'unknown'} isn't installed")
            return
        recorded = joint_offer(topic.qos)
        given = self._overrides.get(absolute(topic.name), {})
        qos = replace(recorded, **given)
        if qos.durability == LATCHED.durability:
            if topic.type_name == _TRANSFORMS and "depth" not in given:
                qos = replace(qos, depth=_TRANSFORMS_DEPTH)
            self.latched[topic.name] = min(max(1, qos.depth), _TRANSFORMS_DEPTH)
        elif qos.reliability != "best_effort" and "depth" not in given:
            depth = _ROUND if self._options.rate is None else max(qos.depth, _DEPTH)
            qos = replace(qos, depth=depth)
        name = dict(self._options.remaps).get(absolute(topic.name), topic.name)
        try:
            publisher = self._node.create_publisher(
                message_class(topic.type_name), name, qos_profile(qos)
            )
        except InvalidTopicNameException as error:
            raise InputError(f"{name}: is no name for a topic; choose another one") from error
        self._publishers[topic.name] = publisher
        self._types[topic.name] = topic.type_name
        self._rounds[topic.name] = min(max(1, qos.depth), _ROUND)

    def _skip(self, topic: Topic, why: str) -> None:
        self.skipped[topic.name] = why
        self._node.get_logger().warning(plain(f"{topic.name} is not sent: {why}"))

    def _publish_map(self, path: Path) -> None:
        """Publish a map file on /map, latched."""
        if "/map" in self._publishers:
            raise InputError(f"{path}: the bag has a topic /map already; leave out --map")
        view = map_message(load_map(path), time.time_ns())
        self._announce(Topic("/map", view.TYPE, 1, (LATCHED,)))
        self.latched.pop("/map")  # it is none of the bag's
        self._publishers["/map"].publish(to_ros(view))
        self.sent["/map"] += 1

    def _wait_until_acknowledged(self, topic: str) -> None:
        publisher = self._publishers[topic]
        deadline = time.monotonic() + _STUCK_AFTER
        while topic not in self._given_up:
            if publisher.wait_for_all_acked(Duration(seconds=_LOOK_PERIOD)):
                return
            self._meanwhile()
            if time.monotonic() > deadline:
                self._given_up.add(topic)
                self._node.get_logger().warning(
                    plain(
                        f"a subscriber of {topic} doesn't acknowledge; it is not waited for any "
                        "more"
                    )
                )


def _unknown_names(options: Options, topics: Sequence[Topic]) -> list[str]:
    """What is said of topics that no bag has; if none of the wanted ones is there, an error."""
    names = {absolute(topic.name) for topic in topics}
    selection = options.selection
    given = {*(selection.topics or ()), *selection.exclude, *dict(options.remaps)}
    if (selection.topics or selection.regex) and not any(map(selection.has, names)):
        raise InputError(
            f"{options.bags[0]}: has none of the topics that are wanted; it has "
            f"{', '.join(sorted(names)) or 'none'}"
        )
    return [f"there is no {name} in the recording" for name in sorted(given - names)]
