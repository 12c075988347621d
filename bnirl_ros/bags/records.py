"""MCAP records of files that may be cut off or altered.

What the bytes of a record mean is left to the library `mcap`. Ours is what it doesn't do: to find
the damage and go on behind it, to keep what a damaged chunk still holds, and to believe no length
that a file claims before it is checked.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import read_magic

CHUNK_LIMIT = 2**30
"""Bytes to which a chunk may unpack; a chunk that claims more is refused, not unpacked."""

_FRAME = struct.Struct("<BQ")  # opcode and length of the content, before every record
_UNPACK_STEP = 32 * 1024  # bytes: so little is lost before damage in a compressed chunk

# The kinds of record that are read, beside messages; and how much tells all but their data.
_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.STATISTICS: Statistics.read,
}
_HEAD_SIZES: dict[int, int] = {Opcode.MESSAGE: 22, Opcode.CHUNK: 64}


class DamageError(Exception):
    """Bytes that are no MCAP; the text says what is wrong with them. Never leaves this package."""


class Frame(NamedTuple):
    """Where a record lies in its stream: from `offset` to `end`, its content from `start`.

    `damage` says why not all of it is there, if it isn't.
    """

    opcode: int
    offset: int
    start: int
    end: int
    damage: str | None = None


@dataclass
class Contents:
    """What a stretch of records holds; `damage` says why something is missing, if it is."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[Message] = field(default_factory=list)
    damage: str | None = None


class _Fields(ReadDataStream):
    """The fields in the content of a record, cut `short` where one claims more than is there."""

    def __init__(self, content: bytes) -> None:
        super().__init__(BytesIO(content))
        self.short = False

    def read(self, length: int) -> bytes:
        data = super().read(min(length, sys.maxsize))
        self.short |= len(data) < length
        return data


def has_magic(stream: IO[bytes]) -> bool:
    """Whether the next eight bytes are those with which MCAP files begin and end."""
    try:
        return bool(_parsed(read_magic, ReadDataStream(stream)))
    except DamageError:
        return False


def frames_in(stream: IO[bytes], offset: int, size: int) -> Iterator[Frame]:
    """The records from an offset on, with the stream placed at the content of each.

    The last frame is a damaged one, if only because the stream has come to its end.
    """
    damage = None
    while damage is None:
        stream.seek(offset)
        frame = stream.read(_FRAME.size)
        start = offset + _FRAME.size
        opcode, length = _FRAME.unpack(frame) if len(frame) == _FRAME.size else (0, 0)
        if len(frame) < _FRAME.size:
            damage = "it breaks off there, as an interrupted recording does"
        elif opcode == 0:
            damage = "there is no record where one should begin"
        elif length > size - start:
            damage = f"a record claims {length} bytes where {size - start} are left"
        yield Frame(opcode, offset, start, min(start + length, size), damage)
        offset = start + length


def head_at(stream: IO[bytes], frame: Frame) -> McapRecord | None:
    """The record at a frame, from a stream placed at its content; None for those of no interest.

    A message comes without its data and a chunk with little of them. Of the records that break
    off only a chunk is of interest, for it can be unpacked as far as it goes.

    Raises:
        DamageError: the record has fields that cannot be read.
    """
    if frame.damage is not None and frame.opcode != Opcode.CHUNK:
        return None
    size = frame.end - frame.start
    return _record(stream, frame.opcode, min(size, _HEAD_SIZES.get(frame.opcode, size)))


def contents_of(data: bytes) -> Contents:
    """The schemas, channels and messages in a stretch of records, as far as it is whole."""
    contents = Contents()
    stream = BytesIO(data)
    for frame in frames_in(stream, 0, len(data)):
        if frame.offset == len(data):
            break
        damage = frame.damage
        record = None
        if damage is None:
            try:
                record = _record(stream, frame.opcode, frame.end - frame.start)
            except DamageError as fault:
                damage = str(fault)  # but the records after this one can still be read
        if isinstance(record, Message):
            contents.messages.append(record)
        elif isinstance(record, Channel):
            contents.channels[record.id] = record
        elif isinstance(record, Schema):
            contents.schemas[record.id] = record
        contents.damage = contents.damage or damage
    return contents


def contents_of_chunk(content: bytes) -> Contents:
    """What the content of a chunk record holds, unpacked as far as it is whole."""
    fields = _Fields(content)
    try:
        unpacked, damage = _unpacked(_parsed(Chunk.read, fields))
    except DamageError as fault:
        return Contents(damage=str(fault))
    contents = contents_of(unpacked)
    contents.damage = "a chunk breaks off" if fields.short else damage or contents.damage
    return contents


def _record(stream: IO[bytes], opcode: int, size: int) -> McapRecord | None:
    """The record whose content comes next in a stream; None for kinds that are not read."""
    if opcode == Opcode.MESSAGE:
        if size < _HEAD_SIZES[opcode]:  # the library would read on to the stream's end
            raise DamageError("a message is too short")
        return _parsed(Message.read, ReadDataStream(stream), size)
    if opcode not in _READERS:
        return None
    fields = _Fields(stream.read(size))
    record = _parsed(_READERS[opcode], fields)
    if fields.short and opcode != Opcode.CHUNK:
        raise DamageError("a field is longer than its record")
    return record


def _parsed(read: Callable[..., Any], stream: ReadDataStream, *arguments: int) -> Any:
    """What a function of the library reads; all that it raises for bad bytes is damage."""
    try:
        return read(stream, *arguments)
    except (McapError, struct.error, UnicodeDecodeError) as fault:
        raise DamageError("a record has fields that cannot be read") from fault


def _unpacked(chunk: Chunk) -> tuple[bytes, str | None]:
    """A chunk's records as far as they can be unpacked and, where they are not all, why."""
    import lz4.frame
    import zstandard

    size, packed = chunk.uncompressed_size, BytesIO(chunk.data)
    if size > CHUNK_LIMIT:
        raise DamageError(f"a chunk claims to unpack to {size} bytes, more than {CHUNK_LIMIT}")
    read: Callable[[int], bytes]
    if chunk.compression == "":
        read = packed.read
    elif chunk.compression == "zstd":
        read = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True).read
    elif chunk.compression == "lz4":
        read = lz4.frame.LZ4FrameFile(packed).read1
    else:
        name = chunk.compression[:20]
        raise DamageError(f"a chunk is compressed by {name!r}, which is no zstd or lz4")
    unpacked = bytearray()
    try:
        # In steps, so that what comes before damage is kept; one byte past the size at most.
        while step := read(min(_UNPACK_STEP, size + 1 - len(unpacked))):
            unpacked += step
    except (zstandard.ZstdError, RuntimeError, EOFError):
        return bytes(unpacked), "a chunk cannot be unpacked to its end"
    if len(unpacked) != size:
        return bytes(unpacked), f"a chunk unpacks to {len(unpacked)} bytes instead of {size}"
    if chunk.uncompressed_crc not in (0, zlib.crc32(unpacked)):
        return bytes(unpacked), "a chunk's checksum is wrong, so that its messages may be altered"
    return bytes(unpacked), None
