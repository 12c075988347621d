"""Bags of a recording: readable whatever ends it, a signal, a full disk or a power cut."""

from __future__ import annotations

import errno
import os
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, cast

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC

from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

_RESERVE = 4 * 2**20
"""Bytes of the disk that are kept free for the end of a bag: a chunk, the indexes, the summary."""

_CHUNK_AGE = 2.0  # [s] after which what was recorded is written, be the chunk full or not
_FULL = (errno.ENOSPC, errno.EDQUOT)


class RecordingBag(BagWriter):
    """A bag that is there while it is written, and that stays whatever ends the writing.

    Used as a `BagWriter`. A chunk is written when it is full, and by `flush_if_due` when it is
    old, so that a process that is killed loses the last one only. When the disk is full the bag is
    finished in room that was kept for that, and the error says so.

    Args:
        folder: the bag, whose last part is its name; it must not be there yet.
        clock: time that only goes forward [s].
    """

    def __init__(self, folder: str | Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(folder)
        self._partial = self._folder / self._file_name
        self._clock = clock
        self._written_at = clock()
        self._disk: _Disk | None = None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish the bag, also when an exception ends the recording.

        Raises:
            InputError: it could not be finished; what was written before can be read.
        """
        assert self._disk is not None
        self._disk.use_reserve()
        try:
            if self._disk.fault is None:
                self._finish()
        except OSError as fault:
            if kind is None:
                raise self._refusal(fault) from fault
        finally:
            self._disk.close()
            self._writer = None

    def flush_if_due(self) -> None:
        """Write what has waited for long.

        Raises:
            InputError: the disk is full, or cannot be written to.
        """
        if self._clock() - self._written_at > _CHUNK_AGE:
            self._written_at = self._clock()
            self._guarded(self._open_writer().flush)

    def write_encoded(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Add a message that is CDR already; its bytes are not looked at.

        Raises:
            InputError: the disk is full, or cannot be written to; nothing more can be added.
            ValueError: as of `BagWriter`.
        """
        self._guarded(lambda: super(RecordingBag, self).write_encoded(topic, data, log_time_ns))

    def _guarded(self, write: Callable[[], None]) -> None:
        assert self._disk is not None
        try:
            write()
        except OSError as fault:
            raise self._refusal(fault) from fault
        if self._disk.is_full:
            raise self._refusal(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))

    def _refusal(self, fault: OSError) -> InputError:
        return InputError(
            f"{self._folder}: cannot be written any further ({fault.strerror}); what was recorded "
            "until then is there"
        )

    def _open_file(self) -> IO[bytes]:
        self._disk = _Disk(self._partial)
        return cast("IO[bytes]", self._disk)


class _Disk:
    """A file that only ever holds what was written to it as a whole, and a reserve beside it.

    Attributes:
        fault: why nothing more can be written, if so.
        is_full: whether the disk is full, and the reserve is being used up.
    """

    def __init__(self, path: Path) -> None:
        self.fault: OSError | None = None
        self.is_full = False
        self._file = path.open("wb", buffering=0)
        self._reserve = path.with_name(f"{path.name}.reserve")
        try:
            with self._reserve.open("wb") as reserve:
                os.posix_fallocate(reserve.fileno(), 0, _RESERVE)
        except OSError:
            self.close()
            path.unlink()
            raise

    def write(self, data: bytes) -> int:
        """Write all of it, or nothing."""
        if self.fault is not None:
            raise self.fault
        start = self._file.tell()
        left = memoryview(data)
        while left:
            try:
                left = left[self._file.write(left) :]
            except OSError as fault:
                if fault.errno in _FULL and self._reserve.exists():
                    self.is_full = True
                    self.use_reserve()
                    continue
                self.fault = fault
                self._file.truncate(start)
                self._file.seek(start)
                raise
        return len(data)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Nothing waits here."""

    def use_reserve(self) -> None:
        """Free the room that was kept."""
        self._reserve.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file, with an end where it had to be broken off."""
        if self.fault is not None and not self._file.closed:
            end = RecordBuilder()
            DataEnd(data_section_crc=0).write(end)
            Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(end)
            with suppress(OSError):
                self._file.write(end.end() + MCAP0_MAGIC)  # type: ignore[no-untyped-call]
        self._file.close()
        self.use_reserve()
