"""Messages from several places, in the order of log time."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator

from bnirl_ros.bags.topics import RawMessage


class Merging:
    """Merges iterators of messages that are each in the order of log time.

    They may be added at any time. Of messages of one time those with the lower place come first.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[int, tuple[int, ...], RawMessage, Iterator[RawMessage]]] = []

    def add(self, place: tuple[int, ...], messages: Iterable[RawMessage]) -> None:
        """Take part from now on; each iterator has a place of its own."""
        following = iter(messages)
        for first in following:
            heapq.heappush(self._heap, (first.log_time, place, first, following))
            return

    def messages(self, until: int | None = None) -> Iterator[RawMessage]:
        """Take the messages before a log time [ns], or all."""
        heap = self._heap
        while heap and (until is None or heap[0][0] < until):
            _, place, message, following = heap[0]
            yield message
            for after in following:
                heapq.heapreplace(heap, (after.log_time, place, after, following))
                break
            else:
                heapq.heappop(heap)
