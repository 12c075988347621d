"""The node that plays a recorded demonstration onto its topics, and loses nothing on the way."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args

from bnirl_ros.bags.qos import LATCHED, QosProfile
from bnirl_ros.bags.reader import Bag, RawMessage, Topic
from bnirl_ros.errors import InputError
from bnirl_ros.limits import above_zero, one_or_more
from bnirl_ros.maps import load_map
from bnirl_ros.nodes.conversion import message_class, to_ros
from bnirl_ros.nodes.process import run
from bnirl_ros.views.belief import map_message

_DEPTH = 1000  # of a reliable publisher at least that plays at a pace
# Playing as fast as can be, so many messages of a topic are sent before all must be acknowledged.
# It is also the depth of the publisher: when the history is full, Fast DDS asks subscribers for
# acknowledgement (and has it in some 6 ms); otherwise it asks every three seconds only. And it is
# small: what overflows the transport is sent again at 256 messages in three seconds.
_ROUND = 50
_LOOK_PERIOD = 0.05  # [s] between two looks at subscribers, and at whether to stop
_STILL = 0.5  # [s] without a further subscriber, after which nobody is waited for any more
_STUCK_AFTER = 10.0  # [s] without acknowledgement after which a subscriber is given up


@dataclass(frozen=True)
class Options:
    """How to play.

    Attributes:
        bag: rosbag2 folder or MCAP file.
        rate: factor on the recorded pace, above 0; None: as fast as subscribers acknowledge.
        grid_map: a map file to publish on /map first, for a bag that has none; None: none.
        subscribers: how many subscribers of every topic to wait for.
        patience: how long to wait for them [s].
    """

    bag: Path
    rate: float | None
    grid_map: Path | None
    subscribers: int
    patience: float


class ReplayNode(Node):
    """Publishes a bag's messages as they were recorded: bytes, order, pace and QoS."""

    def __init__(self, bag: Bag, rate: float | None) -> None:
        """Announce the bag's topics; those of a type that isn't installed are left out.

        Args:
            bag: the bag.
            rate: factor on the recorded pace; None: as fast as the subscribers acknowledge.
        """
        super().__init__("replay_node")
        self._rate = rate
        self.sent: Counter[str] = Counter()
        self.skipped: dict[str, str] = {}
        self._topic_publishers: dict[str, Any] = {}
        self._latched: set[str] = set()
        for topic in bag.topics():
            self._announce(topic)

    def wait_for_subscribers(self, count: int, patience: float) -> None:
        """Wait until every topic has so many subscribers, and a moment for those still coming.

        Says for whom it waits, and goes on without them when patience is at its end.
        """
        deadline = time.monotonic() + patience
        tell_at = time.monotonic() + 1.0
        wanted = "subscriber" if count == 1 else f"{count} subscribers"
        while missing := self._with_fewer_subscribers(count):
            if time.monotonic() > deadline:
                self.get_logger().warning(
                    f"no {wanted} of {', '.join(missing)} after {patience:g} s; goes on without"
                )
                return
            if time.monotonic() > tell_at:
                self.get_logger().info(
                    f"waits for {'a ' * (count == 1)}{wanted} of {', '.join(missing)}"
                )
                tell_at = deadline
            time.sleep(_LOOK_PERIOD)
        # A recorder beside the first subscriber is found a little later, and a short replay would
        # be over by then.
        counts, still_until = self._subscriber_counts(), time.monotonic() + _STILL
        while time.monotonic() < still_until:
            time.sleep(_LOOK_PERIOD)
            if self._subscriber_counts() != counts:
                counts, still_until = self._subscriber_counts(), time.monotonic() + _STILL

    def publish_map(self, path: Path) -> None:
        """Publish a map file on /map, latched.

        Raises:
            InputError: the file cannot be used, or the bag has a map itself.
        """
        if "/map" in self._topic_publishers:
            raise InputError(f"{path}: the bag has a topic /map already; leave out --map")
        view = map_message(load_map(path), time.time_ns())
        self._announce(Topic("/map", view.TYPE, 1, (LATCHED,)))
        self._topic_publishers["/map"].publish(to_ros(view))
        self.sent["/map"] += 1

    def play(self, bag: Bag) -> None:
        """Publish a bag's messages: the first one of each latched topic, then all in their order.

        With a rate, each is sent at its recorded time since the first one over the rate; without,
        as soon as the subscribers have acknowledged those before.
        """
        first: dict[str, RawMessage] = {}
        for message in bag.messages(self._latched):
            if message.topic not in first:
                first[message.topic] = message
                self._topic_publishers[message.topic].publish(message.data)
                self.sent[message.topic] += 1
                if len(first) == len(self._latched):
                    break
        start: tuple[float, int] | None = None
        for message in bag.messages(self._topic_publishers):
            publisher = self._topic_publishers[message.topic]
            if first.get(message.topic) == message:  # sent already
                del first[message.topic]
                continue
            if start is None:
                start = (time.monotonic(), message.log_time)
            if self._rate is not None:
                due = start[0] + (message.log_time - start[1]) / 1e9 / self._rate
                time.sleep(max(0.0, due - time.monotonic()))
            publisher.publish(message.data)
            self.sent[message.topic] += 1
            if self._rate is None and self.sent[message.topic] % _ROUND == 0:
                self.wait_until_acknowledged(message.topic)
        for topic in self._topic_publishers:
            self.wait_until_acknowledged(topic)

    def wait_until_acknowledged(self, topic: str) -> None:
        """Wait until every reliable subscriber has what was sent, unless one doesn't answer."""
        publisher = self._topic_publishers[topic]
        deadline = time.monotonic() + _STUCK_AFTER
        while not publisher.wait_for_all_acked(Duration(seconds=_LOOK_PERIOD)):
            if time.monotonic() > deadline:
                self.get_logger().warning(
                    f"a subscriber of {topic} doesn't acknowledge; goes on without it",
                    throttle_duration_sec=10.0,
                )
                return

    def report(self) -> str:
        """A line on what was sent, and what was not and why."""
        parts = [f"{topic} {count}" for topic, count in sorted(self.sent.items())]
        parts += [f"{topic} not sent ({why})" for topic, why in sorted(self.skipped.items())]
        return f"sent {self.sent.total()} messages: {', '.join(parts) or 'none'}"

    def _announce(self, topic: Topic) -> None:
        if topic.encoding != "cdr":
            self.skipped[topic.name] = f"encoded as {topic.encoding or 'nothing'}, not cdr"
            return
        try:
            kind = message_class(topic.type_name)
        except (ImportError, ValueError):
            self.skipped[topic.name] = f"type {topic.type_name or 'unknown'} isn't installed"
            return
        recorded = topic.qos[0] if topic.qos else QosProfile()
        if recorded.durability == LATCHED.durability:
            self._latched.add(topic.name)
        elif recorded.reliability != "best_effort":
            depth = _ROUND if self._rate is None else max(recorded.depth, _DEPTH)
            recorded = replace(recorded, depth=depth)
        self._topic_publishers[topic.name] = self.create_publisher(
            kind, topic.name, qos_profile(recorded)
        )

    def _subscriber_counts(self) -> dict[str, int]:
        return {
            topic: publisher.get_subscription_count()
            for topic, publisher in self._topic_publishers.items()
        }

    def _with_fewer_subscribers(self, wanted: int) -> list[str]:
        return [topic for topic, count in self._subscriber_counts().items() if count < wanted]


def qos_profile(recorded: QosProfile) -> QoSProfile:
    """rclpy's form of a recorded profile; what it leaves open is as ROS does by default."""
    return QoSProfile(
        depth=recorded.depth or 10,
        history=HistoryPolicy.KEEP_ALL
        if recorded.history == "keep_all"
        else HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.BEST_EFFORT
        if recorded.reliability == "best_effort"
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if recorded.durability == "transient_local"
        else DurabilityPolicy.VOLATILE,
    )


def replay(options: Options) -> None:
    """Play a bag; a damaged one as far as it can be read.

    Raises:
        InputError: the bag or the map cannot be used, or the bag is damaged.
    """
    bag = Bag(options.bag)
    node = ReplayNode(bag, options.rate)
    log = node.get_logger()
    try:
        for warning in bag.warnings:
            log.warning(warning)
        if options.grid_map:
            node.publish_map(options.grid_map)
        for topic, why in node.skipped.items():
            log.warning(f"{topic} is not sent: {why}")
        node.wait_for_subscribers(options.subscribers, options.patience)
        node.play(bag)
        if bag.damage:
            raise InputError(bag.damage)
    finally:
        print(node.report(), flush=True)
        node.destroy_node()


def parse(arguments: Sequence[str], name: str = "replay_node") -> Options:
    """The options on a command line without ROS arguments; wrong ones end with status 2."""
    parser = argparse.ArgumentParser(
        prog=name, description="Play a recorded demonstration onto its topics."
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="rosbag2 folder or .mcap file")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        "-r",
        "--rate",
        type=above_zero,
        default=1.0,
        help="factor on the recorded pace (%(default)s)",
    )
    pace.add_argument("--fast", action="store_true", help="as fast as the subscribers acknowledge")
    parser.add_argument("--map", type=Path, help="map file to publish on /map for a bag without")
    parser.add_argument(
        "--wait",
        type=above_zero,
        default=10.0,
        metavar="SECONDS",
        help="how long to wait for the subscribers (%(default)s)",
    )
    parser.add_argument(
        "--subscribers",
        type=one_or_more,
        default=1,
        metavar="N",
        help="how many subscribers of every topic to wait for, such as 2 for a node and a "
        "recorder (%(default)s)",
    )
    given = parser.parse_args(arguments)
    rate = None if given.fast else given.rate
    return Options(given.bag, rate, given.map, given.subscribers, given.wait)


def main(arguments: Sequence[str] | None = None, name: str = "replay_node") -> int:
    """Run the node until the bag's end, or until it is stopped; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    options = parse(remove_ros_args([name, *given])[1:], name)
    return run(name, lambda: replay(options), given)


if __name__ == "__main__":
    sys.exit(main())
