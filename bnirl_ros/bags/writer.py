"""Writing bags: the folder, file and metadata that `ros2 bag record -s mcap` would leave."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Self

from bnirl_ros import __version__
from bnirl_ros.bags.cdr import Message, encode
from bnirl_ros.bags.definitions import full_type_name, message_definition, type_hash
from bnirl_ros.bags.qos import HASH_KEY, QOS_KEY, QosProfile, qos_to_yaml
from bnirl_ros.bags.topics import RawMessage, Topic
from bnirl_ros.errors import InputError

if TYPE_CHECKING:
    from mcap.writer import Writer

CHUNK_SIZE = 1024 * 1024
"""Bytes of messages in a chunk before compression: larger ones hardly compress better, and all
but the last are safe when the writing process is killed."""

_NEVER = 2**63 - 1  # rosbag2's starting time of a bag without messages [ns]
_TOPIC_NAME = re.compile(r"~?/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*")
_PLAIN_YAML = re.compile(r"~?/?[A-Za-z_][\w./-]*")
_NUMBERED_POLICY = re.compile(r"\b(history|reliability|durability|liveliness): *\d")


@dataclass
class _Channel:
    """A topic in the making: what its metadata say, and its number in the MCAP file."""

    name: str
    type_name: str
    encoding: str
    qos_yaml: str
    type_hash: str
    id: int
    messages: int = 0


@dataclass(frozen=True)
class BagPart:
    """One of the files of a bag, as its metadata tell.

    Attributes:
        name: of the file.
        messages: how many, by topic.
        span: the first and the last log time [ns]; None without messages.
    """

    name: str
    messages: Mapping[str, int]
    span: tuple[int, int] | None


class BagWriter:
    """Writes one rosbag2 folder, `<name>/<name>_0.mcap` and `<name>/metadata.yaml`.

    To be used in a `with` statement. The bag appears when the block ends well; when an exception
    leaves it, nothing that looks like a bag is left behind. The same calls give the same bytes.

    Args:
        folder: the bag, whose last part is its name.
        overwrite: whether a bag that is there already may be replaced; other files in the folder
            stay.

    Raises:
        InputError: the folder is there and not empty, or cannot be written to.
    """

    def __init__(self, folder: str | Path, *, overwrite: bool = False) -> None:
        self._folder = Path(folder)
        self._file_name = f"{self._folder.resolve().name}_0.mcap"
        self._partial = self._folder / f"{self._file_name}.partial"
        self._earlier: tuple[BagPart, ...] = ()  # files of the bag that are there already
        self._overwrite = overwrite
        self._channels: dict[str | tuple[str, ...], _Channel] = {}
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._start: int | None = None
        self._end = 0
        self._stream: IO[bytes] | None = None
        self._writer: Writer | None = None

    def __enter__(self) -> Self:
        """Make the folder and begin the file, under a name that no reader takes for a bag."""
        from mcap.writer import Writer  # only those who write pay for it

        try:
            is_new = not (self._overwrite or self._earlier)
            if is_new and self._folder.exists() and any(self._folder.iterdir()):
                raise InputError(
                    f"{self._folder}: exists already; choose another name, or allow it to be "
                    "overwritten"
                )
            self._folder.mkdir(parents=True, exist_ok=True)
            self._stream = self._open_file()
        except OSError as fault:
            raise InputError(
                f"{self._folder}: cannot be written ({fault.strerror}); choose a folder that can"
            ) from fault
        self._writer = Writer(self._stream, chunk_size=CHUNK_SIZE)
        self._writer.start(profile="ros2", library=f"bnirl_ros {__version__}")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish the bag and let it appear, or remove what was written of it."""
        assert self._stream is not None
        try:
            if kind is None:
                self._finish()
        finally:
            self._stream.close()
            self._partial.unlink(missing_ok=True)
            self._writer = None
            if self._folder.is_dir() and not any(self._folder.iterdir()):
                self._folder.rmdir()

    def _open_file(self) -> IO[bytes]:
        return self._partial.open("wb")

    def add_topic(self, name: str, type_name: str, *qos: QosProfile) -> None:
        """Announce a topic; also one without messages then is in the bag.

        Args:
            name: of the topic.
            type_name: of its messages.
            qos: what each of its publishers offers.

        Raises:
            InputError: the message type is unknown.
            ValueError: the name is no topic name, or the topic is there already.
        """
        if not _TOPIC_NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no name for a topic.")
        if name in self._channels:
            raise ValueError(f"The topic {name} is in the bag already.")
        type_name = full_type_name(type_name)
        schema = (type_name, "ros2msg", message_definition(type_name).encode())
        metadata = {QOS_KEY: qos_to_yaml(qos), HASH_KEY: type_hash(type_name)}
        self._channels[name] = self._channel(name, type_name, "cdr", schema, metadata)

    def add_recorded_topic(self, topic: Topic) -> None:
        """Announce a topic of another bag, of any type, with all that is recorded of it."""
        recorded = topic.schema
        schema = (recorded.name, recorded.encoding, recorded.data) if recorded else None
        metadata = dict(topic.metadata)
        if _NUMBERED_POLICY.search(metadata.get(QOS_KEY, "")):  # from before version 9
            metadata[QOS_KEY] = qos_to_yaml(topic.qos)
        self._channels[topic.key] = self._channel(
            topic.name, topic.type_name, topic.encoding, schema, metadata
        )

    def write(self, topic: str, message: Message, log_time_ns: int) -> None:
        """Add a message.

        Args:
            topic: one that was announced.
            message: of the topic's type.
            log_time_ns: when it was received; also written as when it was published [ns].

        Raises:
            ValueError: the topic was not announced, the message is of another type or cannot be
                encoded, or the time lies outside 0 to 2^63 - 1.
        """
        channel = self._channels.get(topic)
        if channel is not None and channel.type_name != message.TYPE:
            raise ValueError(f"The topic {topic} carries {channel.type_name}, no {message.TYPE}.")
        self.write_encoded(topic, encode(message), log_time_ns)

    def write_recorded(self, message: RawMessage) -> None:
        """Add a message of a topic that `add_recorded_topic` announced: its bytes, its times.

        Raises:
            ValueError: the topic was not announced, or its log time lies outside 0 to 2^63 - 1.
        """
        self._add(
            message.key,
            message.data,
            message.log_time,
            publish_time=message.publish_time,
            sequence=message.sequence,
        )

    def write_encoded(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Add a message that is CDR already, as `write` does; its bytes are not looked at."""
        self._add(topic, data, log_time_ns, publish_time=log_time_ns)

    def _channel(
        self,
        name: str,
        type_name: str,
        encoding: str,
        schema: tuple[str, str, bytes] | None,
        metadata: dict[str, str],
    ) -> _Channel:
        """A channel of the file; `schema` is a type's name, and a definition's kind and text."""
        writer = self._open_writer()
        if schema is not None and schema not in self._schema_ids:
            self._schema_ids[schema] = writer.register_schema(*schema)
        number = writer.register_channel(
            topic=name,
            message_encoding=encoding,
            schema_id=self._schema_ids[schema] if schema is not None else 0,
            metadata=metadata,
        )
        qos, digest = metadata.get(QOS_KEY, ""), metadata.get(HASH_KEY, "")
        return _Channel(name, type_name, encoding, qos, digest, number)

    def _add(
        self,
        key: str | tuple[str, ...],
        data: bytes,
        log_time_ns: int,
        publish_time: int,
        sequence: int = 0,
    ) -> None:
        channel = self._channels.get(key)
        if channel is None:
            raise ValueError(f"The topic {key} was not added to the bag.")
        if not 0 <= log_time_ns <= _NEVER:
            raise ValueError(f"{log_time_ns} ns is no time that a bag can hold.")
        self._open_writer().add_message(
            channel_id=channel.id,
            log_time=log_time_ns,
            publish_time=publish_time,
            data=data,
            sequence=sequence,
        )
        channel.messages += 1
        self._start = log_time_ns if self._start is None else min(self._start, log_time_ns)
        self._end = max(self._end, log_time_ns)

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise ValueError("A BagWriter writes only inside its with statement.")
        return self._writer

    def _finish(self) -> None:
        writer = self._open_writer()
        assert self._stream is not None
        metadata = self._metadata()
        writer.add_metadata("rosbag2", {"serialized_metadata": metadata})
        writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
        # metadata.yaml makes the folder a bag: it goes first and comes last.
        yaml_file = self._folder / "metadata.yaml"
        yaml_file.unlink(missing_ok=True)
        self._partial.replace(self._folder / self._file_name)
        own = {self._file_name, *(part.name for part in self._earlier)}
        stem = re.escape(self._folder.resolve().name)
        for split in self._folder.glob("*.mcap"):
            if split.name not in own and re.fullmatch(rf"{stem}_\d+\.mcap", split.name):
                split.unlink()
        indented = "".join(f"  {line}\n" for line in metadata.splitlines())
        yaml_file.write_text(f"rosbag2_bagfile_information:\n{indented}", encoding="utf-8")

    def _metadata(self) -> str:
        """Version 9 of rosbag2's metadata, in the order in which rosbag2 writes it."""
        span = None if self._start is None else (self._start, self._end)
        counts: Counter[str] = Counter()  # channels of several types may have one name
        for channel in self._channels.values():
            counts[channel.name] += channel.messages
        parts = (*self._earlier, BagPart(self._file_name, counts, span))
        spans = [part.span for part in parts if part.span is not None]
        whole = (min(spans)[0], max(end for _, end in spans)) if spans else None
        start, duration = _start_and_duration(whole)
        files = "\n".join(_file_metadata(part) for part in parts)
        paths = "\n".join(f"  - {_quoted(part.name)}" for part in parts)
        topics = "\n".join(
            _topic_metadata(
                channel,
                channel.messages
                + sum(part.messages.get(channel.name, 0) for part in self._earlier),
            )
            for channel in self._channels.values()
        )
        return f"""\
version: 9
storage_identifier: mcap
duration:
  nanoseconds: {duration}
starting_time:
  nanoseconds_since_epoch: {start}
message_count: {sum(sum(part.messages.values()) for part in parts)}
topics_with_message_count:
{topics or "  []"}
compression_format: ""
compression_mode: ""
relative_file_paths:
{paths}
files:
{files}
custom_data: ~
ros_distro: jazzy"""


def _start_and_duration(span: tuple[int, int] | None) -> tuple[int, int]:
    """As rosbag2 writes a span of log times [ns], or that there is none."""
    return (_NEVER, 0) if span is None else (span[0], span[1] - span[0])


def _file_metadata(part: BagPart) -> str:
    start, duration = _start_and_duration(part.span)
    return f"""\
  - path: {_quoted(part.name)}
    starting_time:
      nanoseconds_since_epoch: {start}
    duration:
      nanoseconds: {duration}
    message_count: {sum(part.messages.values())}"""


def _topic_metadata(channel: _Channel, messages: int) -> str:
    profiles = channel.qos_yaml if channel.qos_yaml.lstrip().startswith("-") else "[]"
    qos = "\n".join(f"        {line}" for line in profiles.splitlines())
    return f"""\
  - topic_metadata:
      name: {_quoted(channel.name)}
      type: {_quoted(channel.type_name)}
      serialization_format: {_quoted(channel.encoding)}
      offered_qos_profiles:
{qos}
      type_description_hash: {_quoted(channel.type_hash)}
    message_count: {messages}"""


def _quoted(text: str) -> str:
    """A string as YAML takes it for a string: JSON's quotes are YAML's, too."""
    import json

    return text if _PLAIN_YAML.fullmatch(text) else json.dumps(text)
