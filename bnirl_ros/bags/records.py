"""MCAP records in bytes: their framing, the few kinds that reading needs, and what breaks them.

Written for files that are cut off or altered: whatever can be read before the damage is returned
with it, and no length that a file claims is believed before it is checked.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from io import BytesIO
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
"""The first and the last eight bytes of every MCAP file."""

CHUNK_LIMIT = 2**30
"""Bytes to which a chunk may unpack; a chunk that claims more is refused, not unpacked."""

# Opcode and length of the content come before every record.
FRAME = struct.Struct("<BQ")
# Start and end [ns], unpacked size and checksum, and the length of the compression's name.
CHUNK_HEAD = struct.Struct("<QQQII")
# Channel, sequence number, log time and publish time [ns] come before a message's data.
MESSAGE_HEAD = struct.Struct("<HIQQ")

_UNPACK_STEP = 32 * 1024  # bytes: so little is lost before damage in a compressed chunk


class Opcode(IntEnum):
    """The kinds of record that reading messages needs."""

    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    STATISTICS = 0x0B


class DamageError(Exception):
    """Bytes that are no MCAP; the text says what is wrong with them. Never leaves this package."""


@dataclass(frozen=True)
class Schema:
    """A message type as the file defines it."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A topic as the file defines it; `schema_id` 0 means that it has no schema."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True)
class Statistics:
    """What the summary says of the file: its channels, and messages by channel id."""

    channels: int
    messages: dict[int, int]


class StoredMessage(NamedTuple):
    """One message as it lies in the file."""

    channel_id: int
    log_time: int
    data: bytes


@dataclass
class Contents:
    """What a stretch of records holds; `damage` says why something is missing, if it is."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[StoredMessage] = field(default_factory=list)
    damage: str | None = None


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of each record in the bytes.

    Raises:
        DamageError: at the first record that isn't whole.
    """
    place, size = 0, len(data)
    while place < size:
        if size - place < FRAME.size:
            raise DamageError("a record breaks off")
        opcode, length = FRAME.unpack_from(data, place)
        place += FRAME.size
        check_frame(opcode, length, size - place)
        yield opcode, place, place + length
        place += length


def check_frame(opcode: int, length: int, room: int) -> None:
    """Whether a record can be: of some kind, and no longer than the room left for it.

    Raises:
        DamageError: it can't.
    """
    if opcode == 0:
        raise DamageError("there is no record where one should begin")
    if length > room:
        raise DamageError(f"a record claims {length} bytes where {room} are left")


def contents_of(data: bytes) -> Contents:
    """The schemas, channels and messages in a stretch of records, as far as it is whole."""
    contents = Contents()
    try:
        for opcode, start, end in records_in(data):
            try:
                _add_record(contents, opcode, data, start, end)
            except DamageError as damage:
                # The frame is whole, so the records after this one can still be read.
                contents.damage = contents.damage or str(damage)
    except DamageError as damage:
        contents.damage = contents.damage or str(damage)
    return contents


def _add_record(contents: Contents, opcode: int, data: bytes, start: int, end: int) -> None:
    if opcode == Opcode.MESSAGE:
        contents.messages.append(_message(data, start, end))
    elif opcode == Opcode.CHANNEL:
        channel = parse_channel(data[start:end])
        contents.channels[channel.id] = channel
    elif opcode == Opcode.SCHEMA:
        schema = parse_schema(data[start:end])
        contents.schemas[schema.id] = schema


def contents_of_chunk(data: bytes) -> Contents:
    """What the content of a chunk record holds, unpacked as far as it is whole."""
    try:
        unpacked, damage = _unpack_chunk(data)
    except DamageError as fault:
        return Contents(damage=str(fault))
    contents = contents_of(unpacked)
    contents.damage = damage or contents.damage
    return contents


def parse_schema(content: bytes) -> Schema:
    """The schema in the content of its record.

    Raises:
        DamageError: there is none.
    """
    cursor = _Cursor(content)
    return Schema(
        id=cursor.integer("<H"),
        name=cursor.text(),
        encoding=cursor.text(),
        data=cursor.take(cursor.integer("<I")),
    )


def parse_channel(content: bytes) -> Channel:
    """The channel in the content of its record.

    Raises:
        DamageError: there is none.
    """
    cursor = _Cursor(content)
    identifier, schema_id = cursor.integer("<H"), cursor.integer("<H")
    topic, encoding = cursor.text(), cursor.text()
    pairs = _Cursor(cursor.take(cursor.integer("<I")))
    metadata = {}
    while pairs.left:
        key = pairs.text()
        metadata[key] = pairs.text()
    return Channel(identifier, schema_id, topic, encoding, metadata)


def parse_statistics(content: bytes) -> Statistics:
    """The statistics in the content of their record.

    Raises:
        DamageError: there are none.
    """
    cursor = _Cursor(content)
    cursor.take(8 + 2)  # numbers of messages and schemas
    channels = cursor.integer("<I")
    cursor.take(4 + 4 + 4 + 8 + 8)  # numbers of attachments, metadata and chunks; first, last time
    counts = _Cursor(cursor.take(cursor.integer("<I")))
    messages = {}
    while counts.left:
        channel_id = counts.integer("<H")
        messages[channel_id] = counts.integer("<Q")
    return Statistics(channels, messages)


def message_time(content: bytes) -> int:
    """The log time [ns] in the content of a message record, or in its beginning.

    Raises:
        DamageError: it is too short.
    """
    if len(content) < MESSAGE_HEAD.size:
        raise DamageError("a message is too short")
    return int(MESSAGE_HEAD.unpack_from(content)[2])


def _message(data: bytes, start: int, end: int) -> StoredMessage:
    body = start + MESSAGE_HEAD.size
    if body > end:
        raise DamageError("a message is too short")
    channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, start)
    return StoredMessage(channel_id, log_time, data[body:end])


class _Cursor:
    """Reads fields from bytes, one after the other."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._place = 0

    @property
    def left(self) -> int:
        return len(self._data) - self._place

    def take(self, length: int) -> bytes:
        if length > self.left:
            raise DamageError("a field is longer than its record")
        self._place += length
        return self._data[self._place - length : self._place]

    def integer(self, layout: str) -> int:
        return int(struct.unpack(layout, self.take(struct.calcsize(layout)))[0])

    def text(self) -> str:
        try:
            return self.take(self.integer("<I")).decode()
        except UnicodeDecodeError:
            raise DamageError("a text is no UTF-8") from None


def _unpack_chunk(content: bytes) -> tuple[bytes, str | None]:
    """A chunk's records and, where they are not all, why."""
    if len(content) < CHUNK_HEAD.size:
        raise DamageError("a chunk breaks off")
    _, _, size, checksum, name_length = CHUNK_HEAD.unpack_from(content)
    cursor = _Cursor(content)
    cursor.take(CHUNK_HEAD.size)
    compression = cursor.take(name_length).decode(errors="replace")
    packed_size = cursor.integer("<Q")
    packed = cursor.take(min(packed_size, cursor.left))
    if size > CHUNK_LIMIT:
        raise DamageError(f"a chunk claims to unpack to {size} bytes, more than {CHUNK_LIMIT}")
    if compression not in _UNPACKERS:
        raise DamageError(
            f"a chunk is compressed by {compression[:20]!r}, which is no zstd or lz4"
        )
    unpacked, damage = _UNPACKERS[compression](packed, size)
    if len(packed) < packed_size:
        damage = "a chunk breaks off"
    elif damage is None and len(unpacked) != size:
        damage = f"a chunk unpacks to {len(unpacked)} bytes instead of {size}"
    elif damage is None and checksum not in (0, zlib.crc32(unpacked)):
        damage = "a chunk's checksum is wrong, so that its messages may be altered"
    return unpacked, damage


def _unpack_none(packed: bytes, size: int) -> tuple[bytes, str | None]:
    return packed[: size + 1], None


def _unpack_zstd(packed: bytes, size: int) -> tuple[bytes, str | None]:
    import zstandard

    reader = zstandard.ZstdDecompressor().stream_reader(BytesIO(packed), read_across_frames=True)
    return _collect(reader.read, size, zstandard.ZstdError)


def _unpack_lz4(packed: bytes, size: int) -> tuple[bytes, str | None]:
    import lz4.frame

    file = lz4.frame.LZ4FrameFile(BytesIO(packed))
    return _collect(file.read1, size, (RuntimeError, EOFError))


def _collect(
    read: Callable[[int], bytes],
    size: int,
    errors: type[Exception] | tuple[type[Exception], ...],
) -> tuple[bytes, str | None]:
    """Unpack in steps, so that what comes before damage is kept; one byte past `size` at most."""
    unpacked = bytearray()
    try:
        while len(unpacked) <= size:
            step = read(min(_UNPACK_STEP, size + 1 - len(unpacked)))
            if not step:
                break
            unpacked += step
    except errors:
        return bytes(unpacked), "a chunk cannot be unpacked to its end"
    return bytes(unpacked), None


_UNPACKERS: dict[str, Callable[[bytes, int], tuple[bytes, str | None]]] = {
    "": _unpack_none,
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
}
