"""Taking in many messages with little work for each."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

_PAUSE = 0.001  # [s] between two looks at what has come meanwhile
_LONGEST = 0.02  # [s] after which others have their turn
_AT_ONCE = 100  # messages of one subscription before the next one has its turn


def take_together(subscriptions: Sequence[Any]) -> None:
    """Let each subscription that has a message take all that wait for any of them.

    rclpy's executor looks twice at everything that a node serves, for each message: with the tens
    of things that ours serve that is most of a millisecond of Python. So a callback for which more
    was waiting looks again by itself, in short pauses, as long as something comes.

    Args:
        subscriptions: rclpy's, whose callbacks take a message and return at once.
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
                    callback(taken[0])
                    anything = True
        return anything

    def and_more(callback: Callable[[Any], None]) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            callback(message)
            end = time.monotonic() + _LONGEST
            while take_all() and time.monotonic() < end:
                time.sleep(_PAUSE)

        return take

    for subscription, callback in sources:
        subscription.callback = and_more(callback)
