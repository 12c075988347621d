"""When each message of a replay is due: pace, pause, seeking and repetition, without any ROS."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from bnirl_ros.bags.topics import RawMessage

_SECOND = 10**9  # [ns]


class Messages(Iterator[RawMessage], Protocol):
    """Messages in the order of log time, of which no more may be wanted."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class Source:
    """Where a player has its messages from.

    Attributes:
        begin: log time at which it begins [ns].
        messages: those from a log time on.
        latched: what was latched at a log time and is to be sent there first; it may have
            messages that come later, which then are not sent again.
    """

    begin: int
    messages: Callable[[int], Messages]
    latched: Callable[[int], list[RawMessage]]


class Player:
    """Says which message comes next, and when. It neither waits nor sends.

    Each message is due at its log time, counted from the beginning and divided by the rate; one
    that is late is due at once, so that the pace is kept. The order is always that of log time.

    Attributes:
        paused: whether time stands still.
        rate: factor on the recorded pace; None: everything is due at once.
        rounds: how often the end was reached.
    """

    def __init__(
        self,
        source: Source,
        *,
        rate: float | None = 1.0,
        paused: bool = False,
        loop: bool = False,
        longest_silence: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Be ready at the beginning; time passes from `start` on.

        Args:
            source: of the messages.
            rate: factor on the recorded pace; None: as fast as they are taken.
            paused: whether time is to stand still at first.
            loop: whether to begin again at the end.
            longest_silence: to which longer silences are cut, in recorded time [s]; None: to none.
            clock: time that only goes forward [s].
        """
        self.paused = paused
        self.rate = rate
        self.rounds = 0
        self._source = source
        self._loop = loop
        self._longest_silence = longest_silence
        self._clock = clock
        self._started = False
        self._messages: Messages | None = None
        self._first: deque[RawMessage] = deque()  # to be sent at once
        self._sent_early: dict[str, deque[RawMessage]] = {}
        self._next: RawMessage | None = None
        # Where in the recording we were at which time of the clock.
        self._place = self._last = source.begin
        self._at = 0.0
        self._go_to(source.begin)

    @property
    def finished(self) -> bool:
        """Whether nothing more will come."""
        return self._next is None and not self._first

    @property
    def position(self) -> int:
        """The log time that it is now [ns]; never beyond that of a message not yet taken."""
        if self.paused or self.rate is None or not self._started:
            return self._place
        passed = (self._clock() - self._at) * self.rate
        limit = self._last if self._next is None else self._next.log_time
        return max(self._place, min(self._place + int(passed * _SECOND), limit))

    def start(self) -> None:
        """Let time pass."""
        self._started = True
        self._at = self._clock()

    def due_in(self) -> float:
        """For how long to wait until `take` has a message [s]; infinite while time stands."""
        if self._first:
            return 0.0
        if self._next is None or self.paused or not self._started:
            return math.inf
        if self.rate is None:
            return 0.0
        due = self._at + (self._next.log_time - self._place) / _SECOND / self.rate
        return max(0.0, due - self._clock())

    def take(self) -> RawMessage | None:
        """The next message, if it is due."""
        if self.due_in() > 0.0:
            return None
        if self._first:
            return self._first.popleft()
        return self._step()

    def play_next(self) -> RawMessage | None:
        """The next message while time stands still, which then is at that message."""
        if not self.paused:
            return None
        return self._first.popleft() if self._first else self._step()

    def pause(self) -> None:
        """Let time stand still."""
        self._anchor()
        self.paused = True

    def resume(self) -> None:
        """Let time go on."""
        self._anchor()
        self.paused = False

    def set_rate(self, rate: float) -> None:
        """Go on at another pace."""
        self._anchor()
        self.rate = rate

    def seek(self, log_time: int) -> None:
        """Go to a time of the recording [ns]; what was latched then is sent again."""
        self._go_to(log_time)

    def close(self) -> None:
        """Read no more."""
        if self._messages is not None:
            self._messages.close()
            self._messages = None

    def _anchor(self) -> None:
        self._place, self._at = self.position, self._clock()

    def _go_to(self, log_time: int) -> None:
        self.close()
        self._first.clear()
        self._sent_early.clear()
        for message in self._source.latched(log_time):
            self._first.append(message)
            if message.log_time >= log_time:
                self._sent_early.setdefault(message.topic, deque()).append(message)
        self._messages = self._source.messages(log_time)
        self._last = log_time
        self._fetch()
        self._place, self._at = log_time, self._clock()

    def _step(self) -> RawMessage | None:
        """The next message, be it due or not."""
        message = self._next
        if message is None:
            return None
        self._last = message.log_time
        if self.paused or self.rate is None:
            self._place = message.log_time
        self._fetch()
        if self._next is None:
            self.rounds += 1
            if self._loop:
                self._go_to(self._source.begin)
        elif self._longest_silence is not None:
            too_long = self._next.log_time - message.log_time - self._longest_silence * _SECOND
            self._place += max(0, int(too_long))
        return message

    def _fetch(self) -> None:
        """Look at the message after the next."""
        assert self._messages is not None
        for message in self._messages:
            early = self._sent_early.get(message.topic)
            if early and early[0] == message:
                early.popleft()
                continue
            self._next = message
            return
        self._next = None
