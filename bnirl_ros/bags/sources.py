"""Where the bytes of a bag's file are: in the file, behind its compression, or in a pipe."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

from bnirl_ros.bags.unpacking import ZSTD_MAGIC, Packing, temporary_folder, unpack
from bnirl_ros.errors import InputError

FILE_LIMIT = 2**30
"""Bytes to which a compressed file may unpack, or `FILE_RATIO` times its size if that is more."""

FILE_RATIO = 1000
"""How much smaller a file beyond `FILE_LIMIT` may be packed than unpacked."""

STANDARD_INPUT = Path("-")
"""Stands for what is piped into the command."""

ENDINGS = (".mcap", ".mcap.zstd", ".mcap.zst")
"""Of the names of the files that may be of a bag."""


@dataclass(frozen=True)
class Source:
    """Bytes that can be read from any place in them, and more than once.

    Attributes:
        path: where they are from, to be named.
        fault: what is wrong with what they were unpacked from; None if nothing is.
    """

    path: Path
    fault: str | None = None
    _unpacked: IO[bytes] | None = None

    def open(self) -> IO[bytes]:
        """A stream of the bytes.

        Raises:
            OSError: it cannot be opened.
        """
        if self._unpacked is None:
            return self.path.open("rb")
        # Another stream of the same file, which has no name, with a place of its own.
        return Path(f"/proc/self/fd/{self._unpacked.fileno()}").open("rb")


def source_of(path: Path) -> Source:
    """The bytes of a file; what is compressed as a whole is unpacked, into a file without a name.

    Raises:
        InputError: there is no room for it.
        OSError: it cannot be read.
    """
    as_it_is = Source(path, None, _drained(path) if is_pipe(path) else None)
    with as_it_is.open() as packed:
        if packed.read(len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            return as_it_is
        size = packed.seek(0, os.SEEK_END)
        limit = max(FILE_LIMIT, FILE_RATIO * size)
        unpacked = unpack(packed, 0, size, Packing.ZSTD, limit)
    unpacked.stream.fileno()  # now it is in a file, however short
    unpacked.stream.flush()
    fault = unpacked.damage and f"the file {unpacked.damage}"
    return Source(path, fault, unpacked.stream)


def is_pipe(path: Path) -> bool:
    """Whether a path stands for bytes that can be read once only: `-`, or a pipe by its name."""
    try:
        return path == STANDARD_INPUT or stat.S_ISFIFO(path.stat().st_mode)
    except OSError:
        return False


def is_packed(path: Path) -> bool:
    """Whether a file is called as those are that are compressed as a whole."""
    return path.name.endswith(ENDINGS[1:])


def _drained(path: Path) -> IO[bytes]:
    """What comes out of a pipe: read once, when it is asked for first."""
    if path == STANDARD_INPUT:
        return _drained_once(None, os.fstat(sys.stdin.fileno()).st_ino)
    return _drained_once(path, path.stat().st_ino)


@cache
def _drained_once(path: Path | None, number: int) -> IO[bytes]:
    """The file without a name into which a pipe was copied; the pipe is known by its number."""
    kept = TemporaryFile(dir=temporary_folder())  # noqa: SIM115, it stays open
    with path.open("rb") if path else os.fdopen(os.dup(sys.stdin.fileno()), "rb") as stream:
        try:
            shutil.copyfileobj(stream, kept, 2**20)
            kept.flush()
        except OSError as fault:
            raise InputError(
                f"{path or 'standard input'}: cannot be kept while it is read ({fault.strerror}); "
                "make room, or set TMPDIR to a folder that has it"
            ) from fault
    return kept
