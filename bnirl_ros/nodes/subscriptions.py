"""Taking in many messages with little work for each, and knowing how many did not come."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

_PAUSE = 0.001  # [s] between two looks at what has come meanwhile
_LONGEST = 0.02  # [s] after which others have their turn
_AT_ONCE = 100  # messages of one subscription before the next one has its turn


class Losses:
    """Counts the messages that a subscription did not get, as far as that is certain.

    The middleware tells of those that it waited for in vain. It does not tell of those that made
    room for others in a full queue. They leave gaps between the numbers that a publisher gives its
    messages; whose number it is rclpy does not say, and it goes on from the largest one before it.
    Both may tell of the same loss, so that the larger sum counts.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        """`publishers`: how many there are now."""
        self._publishers = publishers
        self._last: list[int] = []  # numbers, one for each publisher; the newest last
        self._told = self._missing = 0

    def told(self, more: int) -> int:
        """The middleware tells of more losses; returns how many are new."""
        before = self._count
        self._told += more
        return self._count - before

    def taken(self, number: int | None) -> int:
        """A message with this number came, None where there are none; returns the new losses."""
        if number is None:
            return 0
        last = self._last
        if number - 1 in last:
            last.remove(number - 1)
            last.append(number)
            return 0
        before, publishers = self._count, max(1, self._publishers())
        earlier = [each for each in last if each < number]
        if earlier and len(last) >= publishers:
            last.remove(max(earlier))
            self._missing += number - max(earlier) - 1
        del last[: max(0, len(last) + 1 - publishers)]  # of publishers that are gone
        last.append(number)
        return self._count - before

    @property
    def _count(self) -> int:
        return max(self._told, self._missing)


def take_together(subscriptions: Sequence[Any]) -> None:
    """Let each subscription that has a message take all that wait for any of them.

    rclpy's executor looks twice at everything that a node serves, for each message: with the tens
    of things that ours serve that is most of a millisecond of Python. So a callback for which more
    was waiting looks again by itself, in short pauses, as long as something comes.

    Args:
        subscriptions: rclpy's, whose callbacks take a message with what is known of it, and
            return at once.
    """
    sources = [(each, each.callback) for each in subscriptions]

    def take_all() -> bool:
        """Take what waits; returns whether anything did."""
        anything = False
        for subscription, callback in sources:
            with subscription.handle:
                for _ in range(_AT_ONCE):
                    taken = subscription.handle.take_message(subscription.msg_type, False)
                    if taken is None:
                        break
                    callback(*taken)
                    anything = True
        return anything

    def and_more(callback: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def take(message: Any, info: Any) -> None:
            callback(message, info)
            end = time.monotonic() + _LONGEST
            while take_all() and time.monotonic() < end:
                time.sleep(_PAUSE)

        return take

    for subscription, callback in sources:
        subscription.callback = and_more(callback)
