"""The node that plays recorded demonstrations onto their topics, and loses nothing on the way."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from bnirl_ros.bags.player import Player, Source
from bnirl_ros.bags.read_ahead import ReadAhead
from bnirl_ros.bags.several import Bags, latched_at
from bnirl_ros.bags.topics import RawMessage
from bnirl_ros.errors import InputError
from bnirl_ros.limits import Limits
from bnirl_ros.nodes.conversion import message_class
from bnirl_ros.nodes.parameters import Changeable, NodeParameter, declare
from bnirl_ros.nodes.played_topics import PlayedTopics
from bnirl_ros.nodes.process import run, separated
from bnirl_ros.nodes.replay_options import BETWEEN_BAGS, Options, parse
from bnirl_ros.nodes.topics import NodeService
from bnirl_ros.terminal_text import plain

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
_LOOK_PERIOD = 0.05  # [s] between two looks at subscribers, services, and at whether to stop
_STILL = 0.5  # [s] without a further subscriber, after which nobody is waited for any more
# Serving takes that long [s]; for less than that it is not worth while to serve, but to sleep.
_SERVING = 0.001
# [s] for who asked to stop to take the answer, which is gone with the process that gave it.
_ANSWERING = 0.5
_SWITCHING = 0.0005  # [s] after which the thread that unpacks lets the one that sends go on
_PROGRESS_PERIOD = 0.2  # [s] between two lines of progress
# A recorder gets what was latched long before when it has found who latches it: messages that come
# so soon in a bag [ns] were there at its beginning.
_LATCHED_BEFORE = 5 * _SECOND


class ReplayNode(Node):
    """Publishes bags' messages as they were recorded: bytes, order, pace and QoS."""

    def __init__(self, bags: Bags, options: Options) -> None:
        """Announce the wanted topics; those of a type that isn't installed are left out.

        Raises:
            InputError: an option doesn't fit the bags, or the map cannot be used.
        """
        super().__init__("replay_node")
        self.end = ""  # why it ended before the end of the recording
        self._bags = bags
        self._options = options
        self._begin, self._length = _extent(bags)
        if options.offset > self._length:
            raise InputError(
                f"--start-offset {options.offset:g}: the recording ends after "
                f"{self._length:.1f} s; begin sooner"
            )
        self._clock_publisher: Any = None
        if options.clock is not None:
            self._clock_publisher = self.create_publisher(message_class(_CLOCK), "/clock", 10)
        self._topics = PlayedTopics(self, bags.topics(), options, self._tell_time)
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
        while (missing := self._topics.with_fewer_subscribers(count)) and not self._may_begin():
            if time.monotonic() > deadline:
                self.get_logger().warning(
                    plain(
                        f"no {wanted} of {', '.join(missing)} after {patience:g} s; goes on "
                        "without"
                    )
                )
                return
            if time.monotonic() > tell_at:
                self.get_logger().info(
                    plain(
                        f"waits for {'a ' * (count == 1)}{wanted} of {', '.join(missing)}, for "
                        f"{patience:g} s at most; --topics leaves topics out, and ~/resume begins"
                    )
                )
                tell_at = math.inf
            self._serve(_LOOK_PERIOD)
        # A recorder beside the first subscriber is found a little later, and a short replay would
        # be over by then.
        counts, still_until = self._topics.subscriber_counts(), time.monotonic() + _STILL
        while time.monotonic() < still_until and not self._may_begin():
            self._serve(_LOOK_PERIOD)
            if self._topics.subscriber_counts() != counts:
                counts, still_until = self._topics.subscriber_counts(), time.monotonic() + _STILL
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
                self._topics.send(message, fast=player.rate is None)
                if player.rate is None:
                    break
        if self._stopped:
            self.end = f"stopped at {self._seconds():.1f} s of {self._length:.1f} s"
            time.sleep(_ANSWERING)
            return
        self._topics.wait_until_acknowledged()
        passed = time.monotonic() - begun
        self._clear_progress()
        self.get_logger().info(f"played {self._topics.sent.total()} messages in {passed:.3f} s")

    def close(self) -> None:
        """Let go of everything."""
        self._clear_progress()
        self._player.close()
        self._server.shutdown()
        self.destroy_node()

    def report(self) -> str:
        """A line on what was sent, and what was not and why."""
        return self._topics.report() + (f"; {self.end}" if self.end else "")

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
            self._topics.send(message, fast=self._player.rate is None)
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

    def _source(self) -> Source:
        """The messages of the topics that are sent."""
        wanted = self._topics.names
        begin = self._begin + round(self._options.offset * _SECOND)
        end = self._begin + math.ceil(self._length * _SECOND)
        if self._options.duration is not None:
            end = min(end, begin + round(self._options.duration * _SECOND))
        early = min(end, self._begin + _LATCHED_BEFORE)
        until = None if self._options.duration is None else end

        def messages(since: int) -> ReadAhead:
            return ReadAhead(self._bags.messages(wanted, since, until))

        def latched(at: int) -> list[RawMessage]:
            return latched_at(self._bags, self._topics.latched, at, early)

        return Source(begin, messages, latched)

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
            line = f"{self._place()}, {self._topics.sent.total()} messages"
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


def _extent(bags: Bags) -> tuple[int, float]:
    """When the first message was recorded [ns], and how long the recording is [s]."""
    first = next(bags.messages(), None)
    if first is None or bags.span is None:
        return 0, 0.0
    return first.log_time, max(0, bags.span[1] - first.log_time) / _SECOND


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
            node.get_logger().warning(plain(warning))
        if not options.paused:
            node.wait_for_subscribers()
        node.play()
    finally:
        node.close()
        print(plain(node.report()), flush=True)
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
