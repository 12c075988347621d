"""Reading bags: rosbag2 folders and MCAP files, whole or damaged, in the order of log time."""

from __future__ import annotations

import heapq
import math
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.records import Channel, Footer, Message, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE

from bnirl_ros.bags.definitions import full_type_name
from bnirl_ros.bags.merging import Merging
from bnirl_ros.bags.qos import HASH_KEY, QOS_KEY, parse_yaml, qos_from_yaml
from bnirl_ros.bags.records import (
    MESSAGE_LIMIT,
    ChunkHead,
    Contents,
    DamageError,
    begins_in_spite,
    contents_of,
    frames_in,
    has_magic,
    head_at,
    unpacked_chunk,
)
from bnirl_ros.bags.sources import ENDINGS, is_packed, is_pipe, source_of
from bnirl_ros.bags.topics import RawMessage, Topic, joined
from bnirl_ros.bags.unpacking import IN_MEMORY, ZSTD_MAGIC, Packing, unpack
from bnirl_ros.errors import InputError

_RUN_SIZE = 2**20  # bytes of messages outside chunks that are read at once
_COPY_STEP = 2**20  # bytes that are read at once for a checksum
_SQLITE_MAGIC = b"SQLite format 3\0"
_ROS_1_MAGIC = b"#ROSBAG V2.0\n"
# The second comes with rosbags, which this package needs: there may be no ROS.
_CONVERTERS = "`ros2 bag convert` or `rosbags-convert`"


class Bag:
    """A recorded bag, opened to be read.

    Nothing in the bag can raise anything but `InputError` here, and that only where nothing at
    all can be read, or there is no room to unpack it. Of a damaged bag everything is read that
    can be; `damage` says what was not.

    Args:
        path: a rosbag2 folder; an `.mcap` file, which may be compressed as a whole; or `-` or a
            pipe's name for what comes out of one.

    Attributes:
        path: as given.
        warnings: sentences on what is wrong with the bag but loses nothing.

    Raises:
        InputError: the path doesn't exist, a folder has no `.mcap` file, or no file is MCAP.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.warnings: list[str] = []
        self._files: list[_File] = []
        self._unread: list[str] = []
        try:
            found = self._find_files()
        except OSError as fault:
            raise _unreadable(self.path, fault) from fault
        for file, expected in found.items():
            try:
                self._files.append(_File(file, expected))
            except InputError as refusal:
                self._unread.append(str(refusal))
        if not self._files:
            raise InputError(self._unread[0])

    @property
    def files(self) -> list[Path]:
        """The MCAP files that are read."""
        return [file.path for file in self._files]

    @property
    def damage(self) -> str | None:
        """What is damaged, a sentence for each file: the byte, and how many messages were read.

        None for a sound bag. Damage inside a chunk is found only when its messages are read, so
        ask again after reading.
        """
        damages = [file.damage for file in self._files if file.damage is not None]
        return "; ".join(self._unread + damages) or None

    @property
    def expected(self) -> int | None:
        """How many messages there were when it was recorded; None where it does not say."""
        counts = [file.expected for file in self._files]
        if self._unread or None in counts:
            return None
        return sum(count for count in counts if count is not None)

    def topics(self) -> list[Topic]:
        """The topics by name, those without messages among them."""
        return joined(
            file.topic(channel) for file in self._files for channel in file.channels.values()
        )

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last log time [ns], as the bag's chunks tell; None without any."""
        pieces = [piece for file in self._files for piece in file.pieces]
        if not pieces:
            return None
        return min(piece.time for piece in pieces), max(piece.last_time for piece in pieces)

    def messages(
        self,
        topics: Iterable[str] | None = None,
        since: int | None = None,
        until: int | None = None,
    ) -> Iterator[RawMessage]:
        """The messages in the order of log time, across chunks and files.

        Messages of one time come in the order in which they lie in the bag. Memory holds only
        those chunks whose times overlap, and of a large chunk only a part; what lies outside the
        wanted times is not read.

        Args:
            topics: names of the wanted ones; all when None.
            since, until: the wanted log times, both of them included [ns]; all when None.
        """
        wanted = None if topics is None else frozenset(topics)
        first = -math.inf if since is None else since
        last = math.inf if until is None else until
        # What lies in the bag's pieces is merged; a piece is read only when its time comes.
        waiting = [
            _Waiting(piece.time, (file_number, piece_number), piece)
            for file_number, file in enumerate(self._files)
            for piece_number, piece in enumerate(file.pieces)
            if piece.last_time >= first and piece.time <= last
        ]
        heapq.heapify(waiting)
        for file in self._files:
            file.messages_read = 0
        merging = Merging()
        while waiting:
            time, place, piece = heapq.heappop(waiting)
            yield from merging.messages(until=time)
            file = self._files[place[0]]
            if piece.head is not None and piece.size > IN_MEMORY:
                for number, part in enumerate(file.parts_of(piece)):
                    if part.last_time >= first and part.time <= last:
                        heapq.heappush(waiting, _Waiting(part.time, (*place, number), part))
                continue
            messages = file.messages_of(piece, wanted)
            if piece.time < first or piece.last_time > last:
                messages = [each for each in messages if first <= each.log_time <= last]
            merging.add(place, messages)
        yield from merging.messages()

    def _find_files(self) -> dict[Path, int | None]:
        """The files, each with how many messages metadata.yaml says it has."""
        path = self.path
        if path.is_file() or is_pipe(path):
            return {path: None}
        if not path.is_dir():
            raise InputError(
                f"{path}: does not exist; name a rosbag2 folder or an .mcap file that does"
            )
        here = files_in(path)
        listed, warning = _listed_files(path)
        if warning is None:
            return listed
        if not here:
            raise InputError(
                f"{path}: holds no .mcap file; name a bag recorded with `-s mcap`, or convert one "
                f"with {_CONVERTERS}"
            )
        self.warnings.append(f"{warning}; its .mcap files are read in the order of their names")
        return dict.fromkeys(here)


class _Waiting(NamedTuple):
    """A piece that is read when its time comes; its place in the bag orders equal times."""

    time: int
    place: tuple[int, ...]
    piece: _Piece


def files_in(folder: Path) -> list[Path]:
    """The files that may be of a bag, by name; where one was unpacked, only what came of it."""
    files = sorted(each for ending in ENDINGS for each in folder.glob(f"*{ending}"))
    return [file for file in files if not (is_packed(file) and file.with_suffix("") in files)]


def _listed_files(folder: Path) -> tuple[dict[Path, int | None], str | None]:
    """The files that metadata.yaml names, and a complaint where it cannot be followed."""
    metadata = folder / "metadata.yaml"
    try:
        values = parse_yaml(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        names = values["relative_file_paths"]
        listed = [_file_called(str(name), folder) for name in names]
        missing = [file.name for file in listed if not file.is_file()]
    except (OSError, ValueError):
        return {}, f"{folder}: has no metadata.yaml that can be read"
    except (TypeError, KeyError):
        return {}, f"{metadata}: does not say which files belong to the bag"
    if missing:
        return {}, f"{metadata}: names {', '.join(missing)}, which is not there"
    if not listed:
        return {}, f"{metadata}: names no files"
    return dict(zip(listed, _counts_in(values, len(listed)), strict=False)), None


def _file_called(name: str, folder: Path) -> Path:
    """The file that metadata.yaml means by a name, in the bag's folder, whoever wrote it."""
    leads_out = Path(name).is_absolute() or ".." in Path(name).parts
    file = folder / (Path(name).name if leads_out else name)
    # Early versions wrote the folder's name before that of the file; and what was compressed as a
    # whole may have been unpacked since, or the other way round.
    candidates = [file, folder / file.name]
    for each in tuple(candidates):
        candidates.append(each.with_suffix("") if is_packed(each) else Path(f"{each}.zstd"))
    return next((each for each in candidates if each.is_file()), file)


def _counts_in(values: Mapping[str, Any], files: int) -> list[int | None]:
    """How many messages each file has by metadata.yaml; None where it does not say."""
    try:
        counts = [each["message_count"] for each in values["files"]]
    except (TypeError, KeyError):
        counts = [values.get("message_count")] if files == 1 else []
    known = len(counts) == files and all(isinstance(count, int) for count in counts)
    return counts if known else [None] * files


@dataclass(frozen=True)
class _Piece:
    """A stretch of a file that holds messages: a chunk, or a run of records outside chunks.

    Attributes:
        offset: the first byte, where damage is reported.
        start, end: of the bytes to read: the content of the chunk's record, or whole records.
        time, last_time: the earliest and the latest log time [ns].
        head: what the chunk claims to be; None for a run of records.
        unpacked: where the bytes of a run are that lay in a large chunk; None: in the file.
    """

    offset: int
    start: int
    end: int
    time: int
    last_time: int
    head: ChunkHead | None = None
    unpacked: IO[bytes] | None = None

    @property
    def size(self) -> int:
        """Bytes that it takes in memory, as far as it says itself; more if that is not true."""
        return max(self.end - self.start, self.head.size if self.head else 0)


@dataclass
class _File:
    """One MCAP file: what it defines, and where its messages lie.

    Attributes:
        path: of the file.
        expected: how many messages it had when it was recorded; None where nothing says it.

    Raises:
        InputError: it cannot be opened, or is no MCAP file.
    """

    path: Path
    expected: int | None = None
    pieces: list[_Piece] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    faults: dict[int, str] = field(default_factory=dict)
    messages_read: int = 0

    def __post_init__(self) -> None:
        try:
            self._source = source_of(self.path)
            with self._source.open() as stream:
                size = stream.seek(0, 2)
                stream.seek(0)
                if not has_magic(stream):
                    stream.seek(0)
                    beginning = stream.read(len(_SQLITE_MAGIC))
                    if not begins_in_spite(stream, size):
                        raise _refusal(self.path, beginning, self._source.fault)
                    self.faults[0] = "the file does not begin as MCAP files do"
                self.pieces, statistics = self._scan(stream, MAGIC_SIZE, size)
            if self._source.fault is not None:
                self.faults = {max(self.faults, default=size): self._source.fault}
        except OSError as fault:
            raise _unreadable(self.path, fault) from fault
        if statistics is not None:
            self.expected = statistics.message_count
        if statistics is not None and not self.faults and self._defines_all(statistics):
            self.counts = statistics.channel_message_counts
        else:
            # No summary, or one that leaves things out: only the chunks themselves know them.
            self._read_definitions()

    @property
    def damage(self) -> str | None:
        if not self.faults:
            return None
        offset, reason = min(self.faults.items())
        places = "" if len(self.faults) == 1 else f"in {len(self.faults)} places, the first "
        known = self.expected is not None and self.expected >= self.messages_read
        return (
            f"{self.path}: is damaged {places}at byte {offset} ({reason}); {self.messages_read} "
            f"{f'of {self.expected} ' * known}messages could be read"
        )

    def type_of(self, channel: Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return full_type_name(schema.name) if schema else ""

    def topic(self, channel: Channel) -> Topic:
        return Topic(
            name=channel.topic,
            type_name=self.type_of(channel),
            messages=self.counts.get(channel.id, 0),
            qos=qos_from_yaml(channel.metadata.get(QOS_KEY, "")),
            encoding=channel.message_encoding,
            type_hash=channel.metadata.get(HASH_KEY, ""),
            schema=self.schemas.get(channel.schema_id),
            metadata=channel.metadata,
        )

    def messages_of(self, piece: _Piece, wanted: frozenset[str] | None) -> list[RawMessage]:
        """The wanted messages of a piece in the order of log time."""
        contents = self._contents_of(piece)
        self.messages_read += len(contents.messages)
        kinds = {
            channel.id: (channel.topic, self.type_of(channel), channel.message_encoding)
            for channel in self.channels.values()
            if wanted is None or channel.topic in wanted
        }
        unknown = {message.channel_id for message in contents.messages} - self.channels.keys()
        if unknown:
            self.faults.setdefault(piece.offset, "messages belong to a topic that is not defined")
        messages = []
        for message in contents.messages:
            if message.channel_id in kinds:
                topic, type_name, encoding = kinds[message.channel_id]
                data = message.data
                if encoding == "cdr" and data.startswith(ZSTD_MAGIC):  # as no CDR begins
                    data = self._unpacked(data, piece)
                messages.append(
                    RawMessage(
                        topic,
                        type_name,
                        message.log_time,
                        data,
                        message.publish_time,
                        message.sequence,
                        encoding,
                    )
                )
        messages.sort(key=attrgetter("log_time"))
        return messages

    def parts_of(self, piece: _Piece) -> list[_Piece]:
        """What a chunk consists of that is too large to be read at once."""
        assert piece.head is not None
        try:
            with self._source.open() as stream:
                unpacked = unpacked_chunk(stream, piece.head, piece.end)
            if unpacked.damage is not None:
                self.faults.setdefault(piece.offset, unpacked.damage)
            parts, _ = self._scan(unpacked.stream, 0, unpacked.size, chunk_at=piece.offset)
        except OSError as fault:
            self.faults.setdefault(piece.offset, f"it cannot be read ({fault.strerror})")
            return []
        return [replace(part, offset=piece.offset, unpacked=unpacked.stream) for part in parts]

    def _contents_of(self, piece: _Piece) -> Contents:
        try:
            with self._source.open() as stream:
                if piece.head is not None:
                    unpacked = unpacked_chunk(stream, piece.head, piece.end)
                    contents = contents_of(unpacked.stream.read())
                    contents.damage = unpacked.damage or contents.damage
                else:
                    within = piece.unpacked or stream
                    within.seek(piece.start)
                    contents = contents_of(within.read(piece.end - piece.start))
        except OSError as fault:
            contents = Contents(damage=f"it cannot be read ({fault.strerror})")
        if contents.damage is not None:
            self.faults.setdefault(piece.offset, contents.damage)
        return contents

    def _unpacked(self, data: bytes, piece: _Piece) -> bytes:
        """A message that was compressed by itself."""
        unpacked = unpack(BytesIO(data), 0, len(data), Packing.ZSTD, MESSAGE_LIMIT)
        if unpacked.damage is not None:
            self.faults.setdefault(piece.offset, f"a message {unpacked.damage}")
        return unpacked.stream.read()

    def _defines_all(self, statistics: Statistics) -> bool:
        used = {channel.schema_id for channel in self.channels.values()} - {0}
        return len(self.channels) >= statistics.channel_count and used <= self.schemas.keys()

    def _read_definitions(self) -> None:
        self.counts = {}
        for piece in self.pieces:
            large = piece.head is not None and piece.size > IN_MEMORY
            for part in self.parts_of(piece) if large else [piece]:
                contents = self._contents_of(part)
                # A sound chunk tells more surely than a summary, which may be damaged.
                sure = contents.damage is None
                self._define(contents.schemas, contents.channels, surely=sure)
                self.messages_read += len(contents.messages)
                for message in contents.messages:
                    self.counts[message.channel_id] = self.counts.get(message.channel_id, 0) + 1

    def _define(
        self, schemas: dict[int, Schema], channels: dict[int, Channel], *, surely: bool
    ) -> None:
        self.schemas = self.schemas | schemas if surely else schemas | self.schemas
        self.channels = self.channels | channels if surely else channels | self.channels

    def _scan(
        self, stream: IO[bytes], begin: int, size: int, chunk_at: int | None = None
    ) -> tuple[list[_Piece], Statistics | None]:
        """Walk records without reading the chunks among them; also the summary is records.

        Args:
            stream: the file, or what a chunk unpacks to.
            begin, size: from where to where.
            chunk_at: where in the file the chunk is; None for the file.

        Returns:
            The pieces, and what a sound summary says of their messages.
        """
        pieces: list[_Piece] = []
        run = _Run(pieces)
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        statistics = sound = None
        for frame in frames_in(stream, begin, size):
            if chunk_at is not None and frame.offset == size:
                break
            place = frame.offset if chunk_at is None else chunk_at
            if frame.damage is not None:
                self.faults.setdefault(place, frame.damage)
            try:
                record = head_at(stream, frame)
            except DamageError as damage:
                # The records after this one can still be read, unless it breaks off.
                self.faults.setdefault(place, str(damage))
                continue
            if isinstance(record, Footer):
                stream.seek(frame.end)
                if not has_magic(stream):
                    self.faults[place] = "the file does not end as MCAP files do"
                if _is_sound(stream, record, frame.start):
                    sound = statistics
                elif not self.faults:
                    self.faults[record.summary_start] = "the summary's checksum is wrong"
                break
            if isinstance(record, Message):
                run.add(frame.offset, frame.end, record.log_time)
            elif isinstance(record, ChunkHead):
                where = (frame.offset, frame.start, frame.end)
                pieces.append(_Piece(*where, record.time, record.last_time, record))
            elif isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)
            elif isinstance(record, Statistics):
                statistics = record
        run.finish()
        self._define(schemas, channels, surely=False)
        return pieces, sound


def _is_sound(stream: IO[bytes], footer: Footer, start: int) -> bool:
    """Whether the summary is as it was written, if that can be told.

    Args:
        stream: of the file.
        footer: which has the checksum.
        start: where the footer's content begins: its first two fields are checked as well.
    """
    place, end, crc = footer.summary_start or start - 9, start + 16, 0
    if not footer.summary_crc:
        return True
    if place > start:
        return False
    stream.seek(place)
    while place < end and (step := stream.read(min(_COPY_STEP, end - place))):
        place, crc = place + len(step), zlib.crc32(step, crc)
    return crc == footer.summary_crc


def _refusal(path: Path, beginning: bytes, fault: str | None) -> InputError:
    if fault is not None and not beginning:
        problem = f"is compressed as a whole, but {fault}; copy or record it again"
    elif not beginning:
        problem = "is empty; record it again"
    elif beginning.startswith(_SQLITE_MAGIC):
        problem = f"is an SQLite bag; convert it with {_CONVERTERS}"
    elif beginning.startswith(_ROS_1_MAGIC):
        problem = "is a bag of ROS 1; convert it with `rosbags-convert`"
    else:
        problem = "is no MCAP file; name a rosbag2 folder or an .mcap file"
    return InputError(f"{path}: {problem}")


def _unreadable(path: Path, fault: OSError) -> InputError:
    return InputError(
        f"{path}: cannot be read ({fault.strerror}); check that it is a file or folder that you "
        "may read"
    )


class _Run:
    """Gathers messages outside chunks into pieces of a size that is good to read at once."""

    def __init__(self, pieces: list[_Piece]) -> None:
        self._pieces = pieces
        self._start = self._end = self._time = self._last_time = 0

    def add(self, start: int, end: int, time: int) -> None:
        if start != self._end or end - self._start > _RUN_SIZE:
            self.finish()
            self._start, self._time, self._last_time = start, time, time
        self._end, self._time = end, min(self._time, time)
        self._last_time = max(self._last_time, time)

    def finish(self) -> None:
        if self._end:
            place = (self._start, self._start, self._end)
            self._pieces.append(_Piece(*place, self._time, self._last_time))
        self._start = self._end = 0
