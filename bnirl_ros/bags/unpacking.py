"""Compressed bytes, unpacked as far as they are sound, and in memory only where they are few."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from enum import Enum
from io import RawIOBase
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, NamedTuple, cast

from bnirl_ros.errors import InputError

IN_MEMORY = 2**23
"""Unpacked bytes that are kept in memory; more than these go into a file without a name."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
LZ4_MAGIC = b"\x04\x22\x4d\x18"

_STEP = 2**17  # bytes
_FINER_STEP = 2**10


class Packing(Enum):
    """How bytes are compressed, in the words of MCAP."""

    NONE = ""
    ZSTD = "zstd"
    LZ4 = "lz4"


class Unpacked(NamedTuple):
    """What came out.

    Attributes:
        stream: it, from its beginning.
        size: how much it is [bytes].
        crc: its checksum.
        damage: what the compressed bytes do instead of coming to a good end; None if they do.
    """

    stream: IO[bytes]
    size: int
    crc: int
    damage: str | None


def packing_of(beginning: bytes, name: str | None) -> tuple[Packing | None, int]:
    """How the bytes are packed that follow on some fields, and where they begin.

    Args:
        beginning: the fields, and the first packed bytes.
        name: of the compression as the fields tell it; None where they cannot be read.

    Returns:
        The packing, None where it is unknown, and the place, 0 where it does not show.
    """
    # Before the bytes stand the name's length, the name, and the length of the bytes.
    for magic, packing in ((ZSTD_MAGIC, Packing.ZSTD), (LZ4_MAGIC, Packing.LZ4)):
        place = 4 + len(packing.value) + 8
        if beginning.startswith(magic, place):
            return packing, place
    named = [packing for packing in Packing if packing.value == name]
    return (named[0] if named else None), 0


def unpack(stream: IO[bytes], start: int, end: int, packing: Packing, limit: int) -> Unpacked:
    """Unpack the bytes of a stream from one place to another, up to so many bytes.

    All that comes before damage is kept. Bytes that are not compressed are copied.
    """
    unnamed = SpooledTemporaryFile(IN_MEMORY, dir=temporary_folder())  # noqa: SIM115, it stays open
    out = cast(IO[bytes], unnamed)
    size, crc, damage = 0, 0, None

    def keep(step: bytes) -> None:
        nonlocal size, crc
        size, crc = size + len(step), zlib.crc32(step, crc)
        try:
            out.write(step)
        except OSError as fault:
            raise InputError(
                f"{temporary_folder() or 'the temporary folder'}: {size} bytes cannot be unpacked "
                f"there ({fault.strerror}); make room, or set TMPDIR to a folder that has it"
            ) from fault

    window = _Window(stream, start, end)
    try:
        read = _reader(window, packing)
        while size < limit and (step := read(min(_STEP, limit - size))):
            keep(step)
        if size == limit and read(1):
            damage = f"unpacks to more than {limit} bytes"
    except _faults():
        damage = "cannot be unpacked to its end"
        # The step that failed may have begun well. What comes out before the byte that the
        # unpacking fails at is known when bytes go in one by one, from shortly before it.
        for step_size in (_FINER_STEP, 1):
            begin = window.place - window.step
            window, kept = _Window(stream, start, end, begin, step_size), size
            read = _reader(window, packing, eager=True)
            try:
                while size < limit and (step := read(min(_STEP, limit - size))):
                    kept, step = kept - len(step), step[kept:] if kept > 0 else step
                    if step_size == 1 and step:
                        keep(step)
            except _faults():
                pass
    out.seek(0)
    return Unpacked(out, size, crc, damage)


def temporary_folder() -> str | None:
    """Where large files go for a while: TMPDIR, or /var/tmp, since /tmp may be in memory."""
    large = Path("/var/tmp")  # noqa: S108 # files there have no names, or new ones
    if os.environ.get("TMPDIR") or not (large.is_dir() and os.access(large, os.W_OK)):
        return None  # what the system has for it
    return str(large)


def _reader(window: _Window, packing: Packing, *, eager: bool = False) -> Callable[[int], bytes]:
    """Reads what is unpacked; an eager one returns what it has before it asks for more."""
    import lz4.frame
    import zstandard

    if packing is Packing.ZSTD:
        unpacker = zstandard.ZstdDecompressor().stream_reader(
            cast(IO[bytes], window), read_size=_STEP, read_across_frames=True
        )
        return unpacker.read1 if eager else unpacker.read
    if packing is Packing.LZ4:
        return cast(Callable[[int], bytes], lz4.frame.LZ4FrameFile(window).read1)
    return window.read


def _faults() -> tuple[type[Exception], ...]:
    import zstandard

    return zstandard.ZstdError, RuntimeError, EOFError


class _Window(RawIOBase):
    """A stretch of a stream, given in steps; from a place on, in smaller ones.

    Attributes:
        place: up to where it was read.
        step: how much was read last.
    """

    def __init__(
        self,
        stream: IO[bytes],
        start: int,
        end: int,
        finer_from: int | None = None,
        finer_step: int = 1,
    ) -> None:
        super().__init__()
        self._stream = stream
        self._end = end
        self._finer_from = end if finer_from is None else finer_from
        self._finer_step = finer_step
        self.place = start
        self.step = 0
        stream.seek(start)

    def readable(self) -> bool:
        return True

    def read(self, size: int | None = -1) -> bytes:
        left = max(0, self._end - self.place)
        if self.place < self._finer_from:
            left = min(left, self._finer_from - self.place)
        else:
            left = min(left, self._finer_step)
        data = self._stream.read(left if size is None or size < 0 else min(size, left))
        self.step = len(data)
        self.place += self.step
        return data
