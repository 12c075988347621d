"""The node that records topics, as `ros2 bag record` does, into a bag that survives its end."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from bnirl_ros.bags.definitions import known_types
from bnirl_ros.bags.recording import RecordingBag
from bnirl_ros.nodes.conversion import is_installed, message_class
from bnirl_ros.nodes.process import run, separated
from bnirl_ros.nodes.qos import accepting, recorded_profile
from bnirl_ros.nodes.selection import Selection, add_selection, selection_of
from bnirl_ros.terminal_text import plain

_LOOK_PERIOD = 0.2  # [s] between two looks at who publishes what, and at whether to stop
_OF_ROS = ("/rosout", "/parameter_events")  # are published by every node


@dataclass(frozen=True)
class Options:
    """What to record.

    Attributes:
        out: the bag, a folder that is not there yet.
        topics: names of topics, relative ones in the node's namespace; None: no names are given.
        selection: which others are wanted, and which are not.
    """

    out: Path
    topics: tuple[str, ...] | None
    selection: Selection


class RecordNode(Node):
    """Records topics from when somebody publishes them, with the QoS that is offered."""

    def __init__(self, bag: RecordingBag, options: Options) -> None:
        """Begin to look for the topics."""
        super().__init__("record_node")
        self.recorded: Counter[str] = Counter()
        self.skipped: dict[str, str] = {}
        self._bag = bag
        self._named = {self.resolve_topic_name(name) for name in options.topics or ()}
        topics = None if options.topics is None else tuple(self._named)
        self._selection = replace(options.selection, topics=topics)
        self._heard: dict[str, tuple[QoSProfile, Any]] = {}
        self.create_timer(_LOOK_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._look()

    def report(self) -> str:
        """A line on what was recorded, and what was not and why."""
        parts = [f"{topic} {count}" for topic, count in sorted(self.recorded.items())]
        missing = sorted(self._named - {*self.recorded, *self.skipped})
        skipped = {**self.skipped, **dict.fromkeys(missing, "nobody published it")}
        parts += [f"{topic} not recorded ({why})" for topic, why in sorted(skipped.items())]
        return f"recorded {self.recorded.total()} messages: {', '.join(parts) or 'none'}"

    def _look(self) -> None:
        """Hear what is published by now, and write what has waited for long."""
        for topic, types in self.get_topic_names_and_types():
            if self._is_wanted(topic) and topic not in self.skipped:
                self._hear(topic, types)
        self._bag.flush_if_due()

    def _is_wanted(self, topic: str) -> bool:
        return self._selection.has(topic) and (topic in self._named or topic not in _OF_ROS)

    def _hear(self, topic: str, types: Sequence[str]) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        offered = [each.qos_profile for each in publishers]
        qos = accepting(offered)
        if topic in self._heard:
            before, subscription = self._heard[topic]
            if (before.reliability, before.durability) == (qos.reliability, qos.durability):
                return
            self.destroy_subscription(subscription)
        elif (fault := _fault(types)) is not None:
            self.skipped[topic] = fault
            self.get_logger().warning(plain(f"{topic} is not recorded: {fault}"))
            return
        else:
            profiles = dict.fromkeys(map(recorded_profile, offered))
            self._bag.add_topic(topic, types[0], *profiles)
            self.recorded[topic] = 0
            self.get_logger().info(plain(f"records {topic}"))
        subscription = self.create_subscription(
            message_class(types[0]), topic, self._recorder(topic), qos, raw=True
        )
        self._heard[topic] = qos, subscription

    def _recorder(self, topic: str) -> Callable[[bytes, Any], None]:
        def record(data: bytes, info: Any) -> None:
            received = info["received_timestamp"] or time.time_ns()
            self._bag.write_encoded(topic, data, received)
            self.recorded[topic] += 1

        return record


def _fault(types: Sequence[str]) -> str | None:
    """Why a topic of these types cannot be recorded."""
    if len(types) > 1:
        return f"is published with several types: {', '.join(types)}"
    if types[0] not in known_types():
        return f"type {types[0]} is unknown to bnirl_ros"
    if not is_installed(types[0]):
        return f"type {types[0]} isn't installed"
    return None


def record(options: Options) -> None:
    """Record until a signal comes.

    Raises:
        InputError: the bag cannot be written; what was recorded until then is there.
    """
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    with RecordingBag(options.out) as bag:
        # From here on a signal must not break off what is being written.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        node = RecordNode(bag, options)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.get_logger().info(f"writes to {options.out} until it is stopped")
        try:
            while not stopped:
                executor.spin_once(timeout_sec=_LOOK_PERIOD)
        finally:
            executor.shutdown()
            node.destroy_node()
            print(plain(node.report()), flush=True)


def contract() -> tuple[str, ...]:
    """The topics that are recorded unless others are named: what subgoal_node hears and tells."""
    from bnirl_ros.nodes.managed import DIAGNOSTICS  # takes as long as all the inference
    from bnirl_ros.nodes.subgoal_node import INPUTS, OUTPUTS

    return tuple(topic.name for topic in (*INPUTS, *OUTPUTS, DIAGNOSTICS))


def parse(arguments: Sequence[str], name: str = "record_node") -> Options:
    """The options on a command line without ROS arguments; wrong ones end with status 2."""
    parser = argparse.ArgumentParser(
        prog=name,
        description="Record topics into an MCAP bag until it is stopped: poses, actions, the map "
        "and what subgoal_node publishes, or others.",
    )
    parser.add_argument("topics", metavar="TOPIC", nargs="*", help="others than those")
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        type=Path,
        help="folder of the bag, not there yet (recorded_ with date and time)",
    )
    parser.add_argument("-a", "--all", action="store_true", help="all topics of known types")
    add_selection(parser)
    given = parser.parse_args(arguments)
    if given.all and given.topics:
        parser.error("name topics or --all, not both")
    everything = given.all or given.regex is not None
    topics = None if everything and not given.topics else tuple(given.topics) or contract()
    out = given.output or Path(time.strftime("recorded_%Y_%m_%d-%H_%M_%S"))
    return Options(out, topics, selection_of(given))


def main(arguments: Sequence[str] | None = None, name: str = "record_node") -> int:
    """Run the node until it is stopped; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    own, of_ros = separated(given)
    return run(name, partial(record, parse(own, name)), of_ros)


if __name__ == "__main__":
    sys.exit(main())
