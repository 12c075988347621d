"""Messages that take long to make, made while others are taken in."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from bnirl_ros.bags.cdr import encode
from bnirl_ros.views.messages import Message


class Drawing:
    """Makes messages in a thread of its own; the executor's publishes them, in their order.

    They are encoded there, too: `to_ros` takes ten times as long, and more when it is published.
    """

    def __init__(self) -> None:
        """Nothing is asked for."""
        self._thread = ThreadPoolExecutor(1, "drawing")
        self._asked: deque[tuple[Any, Future[bytes]]] = deque()

    def ask(self, publisher: Any, make: Callable[[], Message]) -> None:
        """Make a message for a publisher, after all others that were asked for."""
        self._asked.append((publisher, self._thread.submit(lambda: encode(make()))))

    @property
    def idle(self) -> bool:
        """Whether all that was asked for is published."""
        return not self._asked

    def publish(self) -> None:
        """Publish what is made by now."""
        while self._asked and self._asked[0][1].done():
            publisher, made = self._asked.popleft()
            publisher.publish(made.result())

    def forget(self) -> None:
        """Publish nothing of what was asked for."""
        self._asked.clear()

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown(cancel_futures=True)
