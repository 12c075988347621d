"""The node that plays recorded demonstrations onto their topics, and loses nothing on the way."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from bnirl_ros.bags.player import Player, Source
from bnirl_ros.bags.qos import LATCHED, QosProfile, read_overrides
from bnirl_ros.bags.read_ahead import ReadAhead
from bnirl_ros.bags.several import Bags, latched_at
from bnirl_ros.bags.topics import RawMessage, Topic
from bnirl_ros.errors import InputError
from bnirl_ros.limits import Limits
from bnirl_ros.maps import load_map
from bnirl_ros.nodes.conversion import message_class, to_ros
from bnirl_ros.nodes.parameters import Changeable, NodeParameter, declare
from bnirl_ros.nodes.process import run, separated
from bnirl_ros.nodes.replay_options import BETWEEN_BAGS, Options, absolute, parse
from bnirl_ros.nodes.topics import NodeService
from bnirl_ros.views.belief import map_message

_TRIGGER = "std_srvs/srv/Trigger"
SERVICES = (
    NodeService("~/pause", _TRIGGER, "let time stand still; `/clock` goes on, and says so"),
    NodeService("~/resume", _TRIGGER, "go on, also without the subscribers that are waited for"),
    NodeService("~/toggle_paused", _TRIGGER, "the one of the two that changes something"),
    NodeService(
        "~/is_paused", _TRIGGER, "`success` is whether time stands still; the message tells where"
    ),
    NodeService("~/play_next", _TRIGGER, "while paused: send the next message"),
    NodeService("~/burst", _TRIGGER, "while paused: send the next `burst_count` messages"),
    NodeService("~/seek", _TRIGGER, "go to `seek_to`, and send what was latched then"),
    NodeService("~/set_rate", _TRIGGER, "play at the pace of `rate` from now on"),
    NodeService("~/stop", _TRIGGER, "end, with the report of what was sent"),
)
"""What the node can be asked for; the values that some need are parameters."""

PARAMETERS = (
    NodeParameter(
        "rate",
        1.0,
        Limits(
            "factor on the recorded pace, for `~/set_rate`; at first as --rate says", above=0.0
        ),
        Changeable.ALWAYS,
    ),
    NodeParameter(
        "seek_to",
        0.0,
        Limits("place for `~/seek`, from the start of the recording [s]", lowest=0.0),
        Changeable.ALWAYS,
    ),
    NodeParameter(
        "burst_count",
        1,
        Limits("messages that `~/burst` sends", lowest=1, highest=1e9),
        Changeable.ALWAYS,
    ),
)

_CLOCK = "rosgraph_msgs/msg/Clock"
_SECOND = 10**9  # [ns]
_DEPTH = 1000  # of a reliable publisher at least that plays at a pace
# Playing as fast as can be, so many messages of a topic are sent before all must be acknowledged.
# It is also the depth of the publisher: when the history is full, Fast DDS asks subscribers for
# acknowledgement (and has it in some 6 ms); otherwise it asks every three seconds only. And it is
# small: what overflows the transport is sent again at 256 messages in three seconds.
_ROUND = 50
_LOOK_PERIOD = 0.05  # [s] between two looks at subscribers, services, and at whether to stop
_STILL = 0.5  # [s] without a further subscriber, after which nobody is waited for any more
_STUCK_AFTER = 10.0  # [s] without acknowledgement after which a subscriber is given up
# Serving takes that long [s]; for less than that it is not worth while to serve, but to sleep.
_SERVING = 0.001
_SWITCHING = 0.0005  # [s] after which the thread that unpacks lets the one that sends go on
_PROGRESS_PERIOD = 0.2  # [s] between two lines of progress
# A recorder gets what was latched long before when it has found who latches it: messages that come
# so soon in a bag [ns] were there at its beginning.
_LATCHED_BEFORE = 5 * _SECOND
# Each of the nodes that publish fixed transforms latches one message, all on one topic.
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_TRANSFORMS_DEPTH = 100


class ReplayNode(Node):
    """Publishes bags' messages as they were recorded: bytes, order, pace and QoS."""

    def __init__(self, bags: Bags, options: Options) -> None:
        """Announce the wanted topics; those of a type that isn't installed are left out.

        Raises:
            InputError: an option doesn't fit the bags, or the map cannot be used.
        """
        super().__init__("replay_node")
        self.sent: Counter[str] = Counter()
        self.skipped: dict[str, str] = {}
        self.end = ""  # why it ended before the end of the recording
        self._bags = bags
        self._options = options
        self._topic_publishers: dict[str, Any] = {}
        self._types: dict[str, str] = {}  # of the topics; a name may have several in a recording
        self._depths: dict[str, int] = {}  # of latched topics
        self._rounds: dict[str, int] = {}  # messages after which all must be acknowledged
        self._given_up: set[str] = set()  # topics that somebody doesn't acknowledge
        self._begin, self._length = _extent(bags)
        if options.offset > self._length:
            raise InputError(
                f"--start-offset {options.offset:g}: the recording ends after "
                f"{self._length:.1f} s; begin sooner"
            )
        self._overrides = (
            {absolute(topic): qos for topic, qos in read_overrides(options.qos_overrides).items()}
            if options.qos_overrides
            else {}
        )
        topics = bags.topics()
        for topic in topics:
            if not options.selection.has(topic.name):
                self.skipped[topic.name] = "not wanted"
            elif options.clock is not None and absolute(topic.name) == "/clock":
                self.skipped[topic.name] = "--clock takes its place"
            else:
                self._announce(topic)
        for fault in _unknown_names(options, topics):
            self.get_logger().warning(fault)
        if options.grid_map:
            self._publish_map(options.grid_map)
        (entry, *others) = PARAMETERS
        rate = options.rate if options.rate is not None else 1.0
        values = declare(self, (replace(entry, default=rate), *others))
        silence = options.longest_silence
        if silence is None and len(bags) > 1:
            silence = BETWEEN_BAGS
        self._player = Player(
            self._source(),
            rate=None if options.rate is None else values["rate"],
            paused=options.paused,
            loop=options.loop,
            longest_silence=silence,
        )
        self._go_on = False  # without the subscribers that are waited for
        self._stopped = False
        for service in SERVICES:
            answer: Callable[[], tuple[bool, str]] = getattr(self, f"_{service.name[2:]}")
            self.create_service(Trigger, service.name, _answering(answer))
        self._clock_publisher: Any = None
        if options.clock is not None:
            self._clock_publisher = self.create_publisher(message_class(_CLOCK), "/clock", 10)
        self._clock_at = self._progress_at = self._served_at = 0.0
        self._told = sys.stderr.isatty()
        self._server = SingleThreadedExecutor()
        self._server.add_node(self)

    def wait_for_subscribers(self) -> None:
        """Wait until every topic has its subscribers, and a moment for those still coming.

        Says for whom it waits, and goes on without them when patience is at its end.
        """
        count, patience = self._options.subscribers, self._options.patience
        deadline = time.monotonic() + patience
        tell_at = time.monotonic() + 1.0
        wanted = "subscriber" if count == 1 else f"{count} subscribers"
        while (missing := self._with_fewer_subscribers(count)) and not self._may_begin():
            if time.monotonic() > deadline:
                self.get_logger().warning(
                    f"no {wanted} of {', '.join(missing)} after {patience:g} s; goes on without"
                )
                return
            if time.monotonic() > tell_at:
                self.get_logger().info(
                    f"waits for {'a ' * (count == 1)}{wanted} of {', '.join(missing)}, for "
                    f"{patience:g} s at most; --topics leaves topics out, and ~/resume begins"
                )
                tell_at = math.inf
            self._serve(_LOOK_PERIOD)
        # A recorder beside the first subscriber is found a little later, and a short replay would
        # be over by then.
        counts, still_until = self._subscriber_counts(), time.monotonic() + _STILL
        while time.monotonic() < still_until and not self._may_begin():
            self._serve(_LOOK_PERIOD)
            if self._subscriber_counts() != counts:
                counts, still_until = self._subscriber_counts(), time.monotonic() + _STILL
        deadline = time.monotonic() + self._options.delay
        while time.monotonic() < deadline and not self._may_begin():
            self._serve(min(_LOOK_PERIOD, max(0.0, deadline - time.monotonic())))

    def play(self) -> None:
        """Publish the messages in their order, after what was latched where it begins.

        With a rate, each is sent at its recorded time over the rate; without, as soon as the
        subscribers have acknowledged those before.
        """
        player = self._player
        begun = time.monotonic()
        player.start()
        while not player.finished and not self._stopped:
            wait = min(player.due_in(), _LOOK_PERIOD)
            if self._clock_publisher is not None:
                wait = min(wait, max(0.0, self._clock_at - time.monotonic()))
            if wait > 2.0 * _SERVING:
                self._serve(wait - _SERVING)
                continue
            if time.monotonic() - self._served_at > _LOOK_PERIOD:
                self._serve(0.0)
            elif wait > 0.0:
                time.sleep(wait)
            self._tell_time()
            while (message := player.take()) is not None:
                self._send(message)
                if player.rate is None:
                    break
        if self._stopped:
            self.end = f"stopped at {self._seconds():.1f} s of {self._length:.1f} s"
            return
        for topic in self._topic_publishers:
            self._wait_until_acknowledged(topic)
        passed = time.monotonic() - begun
        self._clear_progress()
        self.get_logger().info(f"played {self.sent.total()} messages in {passed:.3f} s")

    def close(self) -> None:
        """Let go of everything."""
        self._clear_progress()
        self._player.close()
        self._server.shutdown()
        self.destroy_node()

    def report(self) -> str:
        """A line on what was sent, and what was not and why."""
        parts = [f"{topic} {count}" for topic, count in sorted(self.sent.items())]
        parts += [f"{topic} not sent ({why})" for topic, why in sorted(self.skipped.items())]
        end = f"; {self.end}" if self.end else ""
        return f"sent {self.sent.total()} messages: {', '.join(parts) or 'none'}{end}"

    # Services: whether it could be done, and what there is to say.

    def _pause(self) -> tuple[bool, str]:
        self._player.pause()
        return True, self._place()

    def _resume(self) -> tuple[bool, str]:
        self._go_on = True
        self._player.resume()
        return True, self._place()

    def _toggle_paused(self) -> tuple[bool, str]:
        return self._resume() if self._player.paused else self._pause()

    def _is_paused(self) -> tuple[bool, str]:
        return self._player.paused, self._place()

    def _play_next(self) -> tuple[bool, str]:
        return self._play_some(1)

    def _burst(self) -> tuple[bool, str]:
        return self._play_some(self.get_parameter("burst_count").value)

    def _play_some(self, count: int) -> tuple[bool, str]:
        if not self._player.paused:
            return False, "is not paused; call ~/pause first"
        sent = 0
        while sent < count and (message := self._player.play_next()) is not None:
            self._send(message)
            sent += 1
        return sent > 0, f"sent {sent} messages; {self._place()}"

    def _seek(self) -> tuple[bool, str]:
        wanted = self.get_parameter("seek_to").value
        if not 0.0 <= wanted <= self._length:
            return False, f"seek_to is {wanted:g} s, the recording ends at {self._length:.1f} s"
        self._player.seek(self._begin + round(wanted * _SECOND))
        return True, self._place()

    def _set_rate(self) -> tuple[bool, str]:
        rate = self.get_parameter("rate").value
        if not 0.0 < rate < math.inf:
            return False, f"rate must be a finite number above 0, not {rate:g}"
        self._player.set_rate(rate)
        return True, self._place()

    def _stop(self) -> tuple[bool, str]:
        self._stopped = True
        return True, self._place()

    def _place(self) -> str:
        rate = (
            "as fast as possible" if self._player.rate is None else f"rate {self._player.rate:g}"
        )
        state = "paused" if self._player.paused else "playing"
        return f"{state} at {self._seconds():.3f} s of {self._length:.3f} s, {rate}"

    def _seconds(self) -> float:
        return (self._player.position - self._begin) / _SECOND

    # Publishing

    def _announce(self, topic: Topic) -> None:
        if topic.name in self._topic_publishers:
            self._skip(
                replace(topic, name=f"{topic.name} ({topic.type_name})"), "its name is taken"
            )
            return
        if topic.encoding != "cdr":
            self._skip(topic, f"encoded as {topic.encoding or 'nothing'}, not cdr")
            return
        try:
            kind = message_class(topic.type_name)
        except (ImportError, ValueError):
            self._skip(topic, f"type {topic.type_name or 'unknown'} isn't installed")
            return
        recorded = joint_offer(topic.qos)
        given = self._overrides.get(absolute(topic.name), {})
        qos = replace(recorded, **given)
        if qos.durability == LATCHED.durability:
            if topic.type_name == _TRANSFORMS and "depth" not in given:
                qos = replace(qos, depth=_TRANSFORMS_DEPTH)
            self._depths[topic.name] = min(max(1, qos.depth), _TRANSFORMS_DEPTH)
        elif qos.reliability != "best_effort" and "depth" not in given:
            depth = _ROUND if self._options.rate is None else max(qos.depth, _DEPTH)
            qos = replace(qos, depth=depth)
        name = dict(self._options.remaps).get(absolute(topic.name), topic.name)
        try:
            publisher = self.create_publisher(kind, name, qos_profile(qos))
        except InvalidTopicNameException as error:
            raise InputError(f"{name}: is no name for a topic; choose another one") from error
        self._topic_publishers[topic.name] = publisher
        self._types[topic.name] = topic.type_name
        self._rounds[topic.name] = min(max(1, qos.depth), _ROUND)

    def _skip(self, topic: Topic, why: str) -> None:
        self.skipped[topic.name] = why
        self.get_logger().warning(f"{topic.name} is not sent: {why}")

    def _publish_map(self, path: Path) -> None:
        """Publish a map file on /map, latched."""
        if "/map" in self._topic_publishers:
            raise InputError(f"{path}: the bag has a topic /map already; leave out --map")
        view = map_message(load_map(path), time.time_ns())
        self._announce(Topic("/map", view.TYPE, 1, (LATCHED,)))
        self._depths.pop("/map")  # it is none of the bag's
        self._topic_publishers["/map"].publish(to_ros(view))
        self.sent["/map"] += 1

    def _source(self) -> Source:
        """The messages of the topics that are sent."""
        wanted = frozenset(self._topic_publishers)
        begin = self._begin + round(self._options.offset * _SECOND)
        end = self._begin + math.ceil(self._length * _SECOND)
        if self._options.duration is not None:
            end = min(end, begin + round(self._options.duration * _SECOND))
        early = min(end, self._begin + _LATCHED_BEFORE)
        until = None if self._options.duration is None else end

        def messages(since: int) -> ReadAhead:
            return ReadAhead(self._bags.messages(wanted, since, until))

        def latched(at: int) -> list[RawMessage]:
            return latched_at(self._bags, self._depths, at, early)

        return Source(begin, messages, latched)

    def _send(self, message: RawMessage) -> None:
        topic = message.topic
        if message.type_name != self._types[topic] or message.encoding != "cdr":
            return
        self._topic_publishers[topic].publish(message.data)
        self.sent[topic] += 1
        if self._player.rate is None and self.sent[topic] % self._rounds[topic] == 0:
            self._wait_until_acknowledged(topic)

    def _wait_until_acknowledged(self, topic: str) -> None:
        """Wait until every reliable subscriber has what was sent, unless one doesn't answer."""
        publisher = self._topic_publishers[topic]
        deadline = time.monotonic() + _STUCK_AFTER
        while topic not in self._given_up:
            if publisher.wait_for_all_acked(Duration(seconds=_LOOK_PERIOD)):
                return
            self._tell_time()
            if time.monotonic() > deadline:
                self._given_up.add(topic)
                self.get_logger().warning(
                    f"a subscriber of {topic} doesn't acknowledge; it is not waited for any more"
                )

    # Whatever else there is to do

    def _serve(self, seconds: float) -> None:
        """Answer services, and tell the time, for so long."""
        self._tell_time()
        self._server.spin_once(timeout_sec=seconds)
        self._served_at = time.monotonic()

    def _tell_time(self) -> None:
        """Publish the clock and show the progress, when it is time."""
        now = time.monotonic()
        if self._clock_publisher is not None and now >= self._clock_at:
            assert self._options.clock is not None
            self._clock_at = max(self._clock_at + 1.0 / self._options.clock, now)
            self._publish_clock()
        if self._told and now >= self._progress_at:
            self._progress_at = now + _PROGRESS_PERIOD
            line = f"{self._place()}, {self.sent.total()} messages"
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)

    def _clear_progress(self) -> None:
        if self._told:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _publish_clock(self) -> None:
        message = message_class(_CLOCK)()
        message.clock.sec, message.clock.nanosec = divmod(self._player.position, _SECOND)
        self._clock_publisher.publish(message)

    def _may_begin(self) -> bool:
        return self._go_on or self._stopped

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


def joint_offer(recorded: Sequence[QosProfile]) -> QosProfile:
    """What one publisher offers in place of several, so that all who heard them hear it."""
    if not recorded:
        return QosProfile()
    first, *others = sorted(recorded, key=lambda each: each.reliability == "best_effort")
    if any(each.durability != LATCHED.durability for each in others):
        return replace(first, durability="volatile")
    return first


def _extent(bags: Bags) -> tuple[int, float]:
    """When the first message was recorded [ns], and how long the recording is [s]."""
    first = next(bags.messages(), None)
    if first is None or bags.span is None:
        return 0, 0.0
    return first.log_time, max(0, bags.span[1] - first.log_time) / _SECOND


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


def _answering(answer: Callable[[], tuple[bool, str]]) -> Callable[..., Any]:
    """A service's callback that says what a function returns."""

    def callback(_: Any, response: Any) -> Any:
        response.success, response.message = answer()
        return response

    return callback


def replay(options: Options) -> None:
    """Play bags; damaged ones as far as they can be read.

    Raises:
        InputError: a bag, the map or an option cannot be used, or a bag is damaged.
    """
    bags = Bags(options.bags)
    node = ReplayNode(bags, options)
    try:
        for warning in bags.warnings:
            node.get_logger().warning(warning)
        if not options.paused:
            node.wait_for_subscribers()
        node.play()
    finally:
        node.close()
        print(node.report(), flush=True)
    if bags.damage:
        raise InputError(bags.damage)


def main(arguments: Sequence[str] | None = None, name: str = "replay_node") -> int:
    """Run the node until the bags' end, or until it is stopped; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    own, of_ros = separated(given)
    options = parse(own, name)
    # The thread that unpacks the bag must not hold up the one that sends.
    sys.setswitchinterval(_SWITCHING)
    return run(name, lambda: replay(options), of_ros)


if __name__ == "__main__":
    sys.exit(main())
