"""Reading bags: rosbag2 folders and MCAP files, whole or damaged, in the order of log time."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

from mcap.records import Channel, Chunk, Footer, Message, Schema, Statistics

from bnirl_ros.bags.definitions import full_type_name
from bnirl_ros.bags.qos import QosProfile, parse_yaml, qos_from_yaml
from bnirl_ros.bags.records import (
    Contents,
    DamageError,
    contents_of,
    contents_of_chunk,
    frames_in,
    has_magic,
    head_at,
)
from bnirl_ros.errors import InputError

_RUN_SIZE = 2**20  # bytes of messages outside chunks that are read at once
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SQLITE_MAGIC = b"SQLite format 3\0"
_ROS_1_MAGIC = b"#ROSBAG V2.0\n"
# The second comes with rosbags, which this package needs: there may be no ROS.
_CONVERTERS = "`ros2 bag convert` or `rosbags-convert`"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: as recorded.
        type_name: `package/msg/Type`; empty where the bag doesn't say.
        messages: how many, as far as the bag says or could be read.
        qos: what each of its publishers offered; empty where the bag doesn't say.
        encoding: of its messages' bytes; only `cdr` can be decoded.
        type_hash: `RIHS01_...`; empty where the bag doesn't say.
    """

    name: str
    type_name: str
    messages: int
    qos: tuple[QosProfile, ...] = ()
    encoding: str = "cdr"
    type_hash: str = ""


class RawMessage(NamedTuple):
    """A message as recorded: `data` is still encoded; `log_time` is when it was received [ns]."""

    topic: str
    type_name: str
    log_time: int
    data: bytes


class Bag:
    """A recorded bag, opened to be read.

    Nothing in the bag can raise anything but `InputError` here, and that only where nothing at
    all can be read. Of a damaged bag everything is read that can be; `damage` says what was not.

    Args:
        path: a rosbag2 folder, or an `.mcap` file.

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
        for file in found:
            try:
                self._files.append(_File(file))
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

    def topics(self) -> list[Topic]:
        """The topics by name, those without messages among them."""
        found: dict[tuple[str, str, str], Topic] = {}
        for file in self._files:
            for channel in file.channels.values():
                topic = file.topic(channel)
                key = (topic.name, topic.type_name, topic.encoding)
                found[key] = _joined(found[key], topic) if key in found else topic
        return [found[key] for key in sorted(found)]

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """The messages in the order of log time, across chunks and files.

        Messages of one time come in the order in which they lie in the bag. Memory holds only
        those chunks whose times overlap.

        Args:
            topics: names of the wanted ones; all when None.
        """
        wanted = None if topics is None else frozenset(topics)
        # What lies in the bag's pieces is merged; a piece is read only when its time comes.
        waiting = sorted(
            (piece.time, file_number, piece_number)
            for file_number, file in enumerate(self._files)
            for piece_number, piece in enumerate(file.pieces)
        )
        for file in self._files:
            file.messages_read = 0
        merging: list[tuple[int, int, int, int, list[RawMessage]]] = []
        for time, file_number, piece_number in waiting:
            yield from _merged(merging, until=time)
            file = self._files[file_number]
            messages = file.messages_of(file.pieces[piece_number], wanted)
            if messages:
                first = (messages[0].log_time, file_number, piece_number, 0, messages)
                heapq.heappush(merging, first)
        yield from _merged(merging, until=None)

    def _find_files(self) -> list[Path]:
        path = self.path
        if path.is_file():
            return [path]
        if not path.is_dir():
            raise InputError(
                f"{path}: does not exist; name a rosbag2 folder or an .mcap file that does"
            )
        here = sorted(path.glob("*.mcap"))
        listed, warning = _listed_files(path)
        if warning is None:
            return listed
        if not here:
            raise InputError(
                f"{path}: holds no .mcap file; name a bag recorded with `-s mcap`, or convert one "
                f"with {_CONVERTERS}"
            )
        self.warnings.append(f"{warning}; its .mcap files are read in the order of their names")
        return here


def _listed_files(folder: Path) -> tuple[list[Path], str | None]:
    """The files that metadata.yaml names, and a complaint where it cannot be followed."""
    metadata = folder / "metadata.yaml"
    try:
        values = parse_yaml(metadata.read_text(encoding="utf-8"))
        names = values["rosbag2_bagfile_information"]["relative_file_paths"]
        listed = [folder / str(name) for name in names]
        # Early versions wrote the folder's name before that of the file.
        listed = [file if file.exists() else folder / file.name for file in listed]
        missing = [file.name for file in listed if not file.is_file()]
    except (OSError, ValueError):
        return [], f"{folder}: has no metadata.yaml that can be read"
    except (TypeError, KeyError):
        return [], f"{metadata}: does not say which files belong to the bag"
    if missing:
        return [], f"{metadata}: names {', '.join(missing)}, which is not there"
    if not listed:
        return [], f"{metadata}: names no files"
    return listed, None


def _joined(first: Topic, second: Topic) -> Topic:
    """One topic that two files, or two channels of a file, hold."""
    return replace(
        first,
        messages=first.messages + second.messages,
        qos=first.qos + tuple(new for new in second.qos if new not in first.qos),
        type_hash=first.type_hash or second.type_hash,
    )


def _merged(
    merging: list[tuple[int, int, int, int, list[RawMessage]]], until: int | None
) -> Iterator[RawMessage]:
    """Take messages from a heap of sorted lists, up to a time; None takes all.

    An entry is the time of the list's next message, two numbers that order equal times, the place
    of that message in the list, and the list.
    """
    while merging and (until is None or merging[0][0] < until):
        _, file_number, piece_number, place, messages = merging[0]
        yield messages[place]
        place += 1
        if place == len(messages):
            heapq.heappop(merging)
        else:
            after = (messages[place].log_time, file_number, piece_number, place, messages)
            heapq.heapreplace(merging, after)


@dataclass(frozen=True)
class _Piece:
    """A stretch of a file that holds messages: a chunk, or a run of records outside chunks.

    Attributes:
        offset: the first byte, where damage is reported.
        start, end: of the bytes to read: the content of the chunk's record, or whole records.
        time: the earliest log time [ns].
    """

    offset: int
    start: int
    end: int
    time: int
    is_chunk: bool


@dataclass
class _File:
    """One MCAP file: what it defines, and where its messages lie.

    Raises:
        InputError: it cannot be opened, or is no MCAP file.
    """

    path: Path
    pieces: list[_Piece] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    faults: dict[int, str] = field(default_factory=dict)
    messages_read: int = 0

    def __post_init__(self) -> None:
        try:
            with self.path.open("rb") as stream:
                if not has_magic(stream):
                    stream.seek(0)
                    raise _refusal(self.path, stream.read(len(_SQLITE_MAGIC)))
                statistics = self._scan(stream)
        except OSError as fault:
            raise _unreadable(self.path, fault) from fault
        if statistics is not None and self._defines_all(statistics):
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
        return (
            f"{self.path}: is damaged {places}at byte {offset} ({reason}); {self.messages_read} "
            "messages could be read"
        )

    def type_of(self, channel: Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return full_type_name(schema.name) if schema else ""

    def topic(self, channel: Channel) -> Topic:
        return Topic(
            name=channel.topic,
            type_name=self.type_of(channel),
            messages=self.counts.get(channel.id, 0),
            qos=qos_from_yaml(channel.metadata.get("offered_qos_profiles", "")),
            encoding=channel.message_encoding,
            type_hash=channel.metadata.get("topic_type_hash", ""),
        )

    def messages_of(self, piece: _Piece, wanted: frozenset[str] | None) -> list[RawMessage]:
        """The wanted messages of a piece in the order of log time."""
        contents = self._contents_of(piece)
        self.messages_read += len(contents.messages)
        kinds = {
            channel.id: (channel.topic, self.type_of(channel))
            for channel in self.channels.values()
            if wanted is None or channel.topic in wanted
        }
        unknown = {message.channel_id for message in contents.messages} - self.channels.keys()
        if unknown:
            self.faults.setdefault(piece.offset, "messages belong to a topic that is not defined")
        messages = [
            RawMessage(*kinds[message.channel_id], message.log_time, message.data)
            for message in contents.messages
            if message.channel_id in kinds
        ]
        messages.sort(key=attrgetter("log_time"))
        return messages

    def _contents_of(self, piece: _Piece) -> Contents:
        try:
            with self.path.open("rb") as stream:
                stream.seek(piece.start)
                data = stream.read(piece.end - piece.start)
        except OSError as fault:
            contents = Contents(damage=f"it cannot be read ({fault.strerror})")
        else:
            contents = contents_of_chunk(data) if piece.is_chunk else contents_of(data)
        if contents.damage is not None:
            self.faults.setdefault(piece.offset, contents.damage)
        return contents

    def _defines_all(self, statistics: Statistics) -> bool:
        used = {channel.schema_id for channel in self.channels.values()} - {0}
        return len(self.channels) >= statistics.channel_count and used <= self.schemas.keys()

    def _read_definitions(self) -> None:
        self.counts = {}
        for piece in self.pieces:
            contents = self._contents_of(piece)
            self.schemas |= contents.schemas
            self.channels |= contents.channels
            self.messages_read += len(contents.messages)
            for message in contents.messages:
                self.counts[message.channel_id] = self.counts.get(message.channel_id, 0) + 1

    def _scan(self, stream: IO[bytes]) -> Statistics | None:
        """Walk the file's records without reading the chunks; also the summary is records."""
        begin, size = stream.tell(), stream.seek(0, 2)
        run = _Run(self.pieces)
        statistics = None
        for frame in frames_in(stream, begin, size):
            if frame.damage is not None:
                self.faults[frame.offset] = frame.damage
            try:
                record = head_at(stream, frame)
            except DamageError as damage:
                # The records after this one can still be read, unless it breaks off.
                self.faults.setdefault(frame.offset, str(damage))
                continue
            if isinstance(record, Footer):
                if not has_magic(stream):
                    self.faults[frame.offset] = "the file does not end as MCAP files do"
                break
            if isinstance(record, Message):
                run.add(frame.offset, frame.end, record.log_time)
            elif isinstance(record, Chunk):
                place = (frame.offset, frame.start, frame.end)
                self.pieces.append(_Piece(*place, record.message_start_time, is_chunk=True))
            elif isinstance(record, Schema):
                self.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
            elif isinstance(record, Statistics):
                statistics = record
        run.finish()
        return None if self.faults else statistics


def _refusal(path: Path, beginning: bytes) -> InputError:
    if not beginning:
        problem = "is empty; record it again"
    elif beginning.startswith(_ZSTD_MAGIC):
        problem = "is compressed as a whole; unpack it with `zstd -d`"
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
        self._start = self._end = self._time = 0

    def add(self, start: int, end: int, time: int) -> None:
        if start != self._end or end - self._start > _RUN_SIZE:
            self.finish()
            self._start, self._time = start, time
        self._end, self._time = end, min(self._time, time)

    def finish(self) -> None:
        if self._end:
            piece = _Piece(self._start, self._start, self._end, self._time, is_chunk=False)
            self._pieces.append(piece)
        self._start = self._end = 0
