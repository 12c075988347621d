"""Reading ahead in a thread of its own, so that unpacking a chunk holds up nobody."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from threading import Condition, Thread

from bnirl_ros.bags.topics import RawMessage

_BATCH = 64 * 1024  # [bytes] that are handed over together
_OVERHEAD = 200  # [bytes] that a message takes besides its data


class ReadAhead(Iterator[RawMessage]):
    """The messages of an iterator, of which so many bytes are read before they are asked for.

    An error of the iterator is raised when its turn comes. `close` ends the thread, which else
    ends with the messages.
    """

    def __init__(self, messages: Iterator[RawMessage], limit: int = 8 * 2**20) -> None:
        """`limit`: bytes of messages that wait at most, or a single one that is larger."""
        self._messages = messages
        self._limit = limit
        self._condition = Condition()
        self._batches: deque[tuple[int, deque[RawMessage]]] = deque()
        self._waiting = 0  # [bytes] in the batches
        self._ended = False  # by the messages' end or by `close`
        self._error: BaseException | None = None
        self._current: deque[RawMessage] = deque()
        self._thread = Thread(target=self._read, name="read_ahead", daemon=True)
        self._thread.start()

    def __next__(self) -> RawMessage:
        if not self._current:
            with self._condition:
                self._condition.wait_for(lambda: self._batches or self._ended)
                if not self._batches:
                    if self._error is not None:
                        raise self._error
                    raise StopIteration
                size, self._current = self._batches.popleft()
                self._waiting -= size
                self._condition.notify_all()
        return self._current.popleft()

    def close(self) -> None:
        """Read no further; what was read ahead is forgotten."""
        with self._condition:
            self._ended = True
            self._batches.clear()
            self._condition.notify_all()
        self._thread.join()
        self._current.clear()

    def _read(self) -> None:
        error: BaseException | None = None
        try:
            batch: deque[RawMessage] = deque()
            size = 0
            for message in self._messages:
                batch.append(message)
                size += len(message.data) + _OVERHEAD
                if size >= _BATCH:
                    if not self._hand_over(size, batch):
                        return
                    batch, size = deque(), 0
            if batch:
                self._hand_over(size, batch)
        except Exception as fault:
            error = fault
        with self._condition:
            self._error = self._error or error
            self._ended = True
            self._condition.notify_all()

    def _hand_over(self, size: int, batch: deque[RawMessage]) -> bool:
        """Whether more is wanted; waits while enough is there."""
        with self._condition:
            self._condition.wait_for(
                lambda: self._ended or not self._batches or self._waiting + size <= self._limit
            )
            if self._ended:
                return False
            self._batches.append((size, batch))
            self._waiting += size
            self._condition.notify_all()
            return True
