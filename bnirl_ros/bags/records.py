"""MCAP records of files that may be cut off or altered.

What the bytes of a record mean is left to the library `mcap`. Ours is what it doesn't do: to find
the damage and go on behind it, to keep what a damaged chunk still holds, and to believe no length
that a file claims before it is checked.
"""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE, read_magic

from bnirl_ros.bags.unpacking import Packing, Unpacked, packing_of, unpack

CHUNK_LIMIT = 2**30
"""Bytes to which a chunk may unpack, or `CHUNK_RATIO` times its size if that is more; one that
claims more is not believed."""

CHUNK_RATIO = 200
"""How much smaller a chunk beyond `CHUNK_LIMIT` may be packed than unpacked."""

MESSAGE_LIMIT = 2**27
"""Bytes that a message may have; a record that claims more is damaged."""

DEFINITION_LIMIT = 2**24
"""Bytes that a schema, a channel or statistics may have; a record that claims more is damaged."""

_FRAME = struct.Struct("<BQ")  # opcode and length of the content, before every record
_CHUNK_HEAD = struct.Struct("<QQQI")  # first and last time, unpacked size, checksum
_CHUNK_LEAST = 40  # bytes of a chunk's fields
_DISBELIEVED = 2**26  # bytes beyond what is believed, in case that only the claim is damaged
_SEARCH_STEP = 2**20  # bytes that are searched at once for the next record
_ANY = sys.maxsize

# The kinds of record that are read, beside messages; and how much tells all but their data.
_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.STATISTICS: Statistics.read,
}
_MESSAGE_HEAD = 22

# The least and the most bytes in the content of each kind of record.
_SIZES: dict[int, tuple[int, int]] = {
    Opcode.HEADER: (8, DEFINITION_LIMIT),
    Opcode.FOOTER: (20, 20),
    Opcode.SCHEMA: (14, DEFINITION_LIMIT),
    Opcode.CHANNEL: (16, DEFINITION_LIMIT),
    Opcode.MESSAGE: (_MESSAGE_HEAD, MESSAGE_LIMIT),
    Opcode.CHUNK: (_CHUNK_LEAST, _ANY),
    Opcode.MESSAGE_INDEX: (6, _ANY),
    Opcode.CHUNK_INDEX: (64, _ANY),
    Opcode.ATTACHMENT: (36, _ANY),
    Opcode.ATTACHMENT_INDEX: (48, _ANY),
    Opcode.STATISTICS: (46, DEFINITION_LIMIT),
    Opcode.METADATA: (8, _ANY),
    Opcode.METADATA_INDEX: (20, _ANY),
    Opcode.SUMMARY_OFFSET: (17, 17),
    Opcode.DATA_END: (4, 4),
}
# What may begin a record: a kind, and a length of less than a terabyte.
_BEGINNING = re.compile(rb"(?=[\x01-\x0f][\s\S]{5}\x00{3})")


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


class ChunkHead(NamedTuple):
    """What the beginning of a chunk says of it.

    Attributes:
        time, last_time: the earliest and the latest log time in it [ns].
        size: of its records when unpacked [bytes], as claimed.
        crc: of its records; 0 where there is none.
        packing: how they are packed.
        start, end: of the packed bytes in their stream; `end` as claimed.
    """

    time: int
    last_time: int
    size: int
    crc: int
    packing: Packing
    start: int
    end: int


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


def begins_in_spite(stream: IO[bytes], size: int) -> bool:
    """Whether records follow on the first eight bytes, though these are not the right ones."""
    first = _frame_at(stream, MAGIC_SIZE, size)
    return first.opcode == Opcode.HEADER and _is_chained(stream, MAGIC_SIZE, size, 0)


def frames_in(stream: IO[bytes], offset: int, size: int) -> Iterator[Frame]:
    """The records from an offset on, with the stream placed at the content of each.

    Where no record follows on another, the next one is searched for. The last frame is a damaged
    one, if only because the stream has come to its end.
    """
    frame = _frame_at(stream, offset, size)
    while True:
        frame, following, search_from = _after(stream, frame, size)
        if following is not None:
            yield _placed(stream, frame)
        else:
            # A record that claims too much has others inside; but what looks like them must lead
            # out of it, since this may be a good record, and damaged only what comes after it.
            out_of = frame.start if frame.damage else frame.end
            place = _next_record(stream, search_from, size, out_of)
            if place is None or place > frame.end:
                yield _placed(stream, frame)
                if frame.damage is None:  # then it is the record after it that is damaged
                    after = _frame_at(stream, frame.end, size)
                    yield _placed(stream, after._replace(end=size if place is None else place))
            else:
                damage = frame.damage or "a record claims more bytes than it has"
                yield _placed(stream, frame._replace(end=place, damage=damage))
            if place is None:
                return
            following = _frame_at(stream, place, size)
        if following.offset == size:
            yield following
            return
        frame = following


def head_at(stream: IO[bytes], frame: Frame) -> McapRecord | ChunkHead | None:
    """The record at a frame, from a stream placed at its content; None for those of no interest.

    A message comes without its data. Of the records that break off only a chunk is of interest,
    for it can be unpacked as far as it goes.

    Raises:
        DamageError: the record has fields that cannot be read.
    """
    if frame.opcode == Opcode.CHUNK:
        return _chunk_at(stream, frame)
    if frame.damage is not None:
        return None
    size = frame.end - frame.start
    return _record(stream, frame.opcode, _MESSAGE_HEAD if frame.opcode == Opcode.MESSAGE else size)


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
            contents.channels.setdefault(record.id, record)
        elif isinstance(record, Schema):
            contents.schemas.setdefault(record.id, record)
        contents.damage = contents.damage or damage
    return contents


def unpacked_chunk(stream: IO[bytes], head: ChunkHead, end: int) -> Unpacked:
    """The records of a chunk as far as they can be unpacked, and why they are not all, if so.

    Args:
        stream: of the chunk.
        head: what the chunk claims to be.
        end: where it ends at the latest.
    """
    believed = max(CHUNK_LIMIT, CHUNK_RATIO * (end - head.start))
    absurd = head.size > believed
    limit = _DISBELIEVED + (0 if absurd else head.size)
    unpacked = unpack(stream, head.start, min(head.end, end), head.packing, limit)
    if head.start <= head.end < end and unpacked.size < head.size:
        # One of its two lengths must be wrong. It is not the record's, if more can be unpacked.
        longer = unpack(stream, head.start, end, head.packing, limit)
        unpacked = longer if longer.size > unpacked.size else unpacked
    if absurd:
        damage = f"a chunk claims to unpack to {head.size} bytes, more than {believed}"
    elif head.end > end:
        damage = "a chunk breaks off"
    elif unpacked.damage is not None:
        damage = f"a chunk {unpacked.damage}"
    elif unpacked.size != head.size:
        damage = f"a chunk unpacks to {unpacked.size} bytes instead of {head.size}"
    elif head.crc not in (0, unpacked.crc):
        damage = "a chunk's checksum is wrong, so that its messages may be altered"
    else:
        return unpacked
    return unpacked._replace(damage=damage)


def _frame_at(stream: IO[bytes], offset: int, size: int) -> Frame:
    stream.seek(offset)
    frame = stream.read(_FRAME.size)
    start = offset + _FRAME.size
    if len(frame) < _FRAME.size:
        damage = "it breaks off there, as an interrupted recording does"
        return Frame(0, offset, size, size, damage)
    opcode, length = _FRAME.unpack(frame)
    least, most = _SIZES.get(opcode, (0, _ANY))
    end = min(start + length, size)
    if opcode == 0:
        return Frame(opcode, offset, start, end, "there is no record where one should begin")
    if length > size - start:
        damage = f"a record claims {length} bytes where {size - start} are left"
        return Frame(opcode, offset, start, end, damage)
    if not least <= length <= most:
        damage = f"a record claims {length} bytes, which none of its kind has"
        return Frame(opcode, offset, start, end, damage)
    return Frame(opcode, offset, start, end)


def _after(stream: IO[bytes], frame: Frame, size: int) -> tuple[Frame, Frame | None, int]:
    """What comes after a record.

    Returns:
        The record, with the end that it must have; the one after it, or None; and then from where
        to search for the next one.
    """
    if frame.damage is None:
        following = _frame_at(stream, frame.end, size)
        # After the footer comes no record. A reader stops there.
        ended = frame.end == size or frame.opcode == Opcode.FOOTER
        if following.damage is None or ended or _is_cut_chunk(stream, following):
            return frame, following, frame.end
    search_from = frame.offset + 1 if frame.opcode == 0 else frame.start
    if frame.opcode == Opcode.CHUNK:
        # A chunk tells its length a second time.
        try:
            end = _chunk_at(stream, frame).end
        except DamageError:
            return frame, None, search_from
        if end < size:
            following = _frame_at(stream, end, size)
            if following.damage is None and end != frame.end:
                damage = frame.damage or "a chunk claims a length that it does not have"
                return frame._replace(end=end, damage=damage), following, end
        if end == frame.end or (end > size and frame.damage is not None):
            return frame, None, frame.end
    return frame, None, search_from


def _placed(stream: IO[bytes], frame: Frame) -> Frame:
    stream.seek(frame.start)
    return frame


def _next_record(stream: IO[bytes], offset: int, size: int, out_of: int) -> int | None:
    """Where the next records begin, of which one leads to another beyond a place."""
    while offset + _FRAME.size <= size:
        stream.seek(offset)
        block = stream.read(_SEARCH_STEP)
        for match in _BEGINNING.finditer(block):
            opcode, length = _FRAME.unpack_from(block, match.start())
            place = offset + match.start()
            least, most = _SIZES[opcode]
            fits = length <= size - place - _FRAME.size
            if least <= length <= most and fits and _is_chained(stream, place, size, out_of):
                return place
        offset += max(len(block) - _FRAME.size + 1, 1)
    return None


def _is_chained(stream: IO[bytes], place: int, size: int, out_of: int) -> bool:
    """Whether a record begins at a place, and others after it, one at least beyond `out_of`."""
    frame = _frame_at(stream, place, size)
    while frame.damage is None and frame.opcode in _SIZES:
        if frame.opcode == Opcode.FOOTER or frame.offset >= max(out_of, place + 1):
            return True
        frame = _frame_at(stream, frame.end, size)
    return False


def _is_cut_chunk(stream: IO[bytes], frame: Frame) -> bool:
    """Whether this is a chunk that was sound until the end of its file was cut off."""
    if frame.damage is None or frame.opcode != Opcode.CHUNK:
        return False
    stream.seek(frame.offset)
    _, length = _FRAME.unpack(stream.read(_FRAME.size))
    try:
        return _chunk_at(stream, frame).end == frame.start + length
    except DamageError:
        return True  # not even its head is there


def _chunk_at(stream: IO[bytes], frame: Frame) -> ChunkHead:
    stream.seek(frame.start)
    content = stream.read(max(0, min(64, frame.end - frame.start)))
    if len(content) < _CHUNK_HEAD.size:
        raise DamageError("a chunk breaks off")
    time, last_time, size, crc = _CHUNK_HEAD.unpack_from(content)
    fields = _Fields(content)
    try:
        name = _parsed(Chunk.read, fields).compression
    except DamageError:
        name = None
    # The bytes themselves tell how they are packed; the name of it may be damaged.
    packing, found = packing_of(content[_CHUNK_HEAD.size :], name)
    if packing is None:
        if name is None:
            raise DamageError("a record has fields that cannot be read")
        raise DamageError(f"a chunk is compressed by {name[:20]!r}, which is no zstd or lz4")
    data = _CHUNK_HEAD.size + found if found else _CHUNK_LEAST + len((name or "").encode())
    (length,) = struct.unpack_from("<Q", content, data - 8) if data <= len(content) else (0,)
    start = frame.start + data
    return ChunkHead(time, last_time, size, crc, packing, start, start + length)


def _record(stream: IO[bytes], opcode: int, size: int) -> McapRecord | None:
    """The record whose content comes next in a stream; None for kinds that are not read."""
    if opcode == Opcode.MESSAGE:
        return _parsed(Message.read, ReadDataStream(stream), size)
    if opcode not in _READERS:
        return None
    fields = _Fields(stream.read(size))
    record = _parsed(_READERS[opcode], fields)
    if fields.short:
        raise DamageError("a field is longer than its record")
    return record


def _parsed(read: Callable[..., Any], stream: ReadDataStream, *arguments: int) -> Any:
    """What a function of the library reads; all that it raises for bad bytes is damage."""
    try:
        return read(stream, *arguments)
    except (McapError, struct.error, UnicodeDecodeError) as fault:
        raise DamageError("a record has fields that cannot be read") from fault
