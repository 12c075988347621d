"""Topics and messages as bags hold them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from mcap.records import Schema

from bnirl_ros.bags.qos import QOS_KEY, QosProfile


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
        schema: the definition of its type as recorded; None where the bag has none.
        metadata: what else the bag says of it, as recorded.
    """

    name: str
    type_name: str
    messages: int
    qos: tuple[QosProfile, ...] = ()
    encoding: str = "cdr"
    type_hash: str = ""
    schema: Schema | None = field(default=None, repr=False)
    metadata: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def key(self) -> tuple[str, str, str]:
        """What its messages have in common, and tells it from other topics of its name."""
        return self.name, self.type_name, self.encoding


class RawMessage(NamedTuple):
    """A message as recorded.

    Attributes:
        topic, type_name: as those of its `Topic`.
        log_time: when it was received [ns].
        data: still encoded.
        publish_time: when it was sent [ns].
        sequence: its publisher's number for it; 0 where there is none.
        encoding: of its data.
    """

    topic: str
    type_name: str
    log_time: int
    data: bytes
    publish_time: int = 0
    sequence: int = 0
    encoding: str = "cdr"

    @property
    def key(self) -> tuple[str, str, str]:
        """That of its `Topic`."""
        return self.topic, self.type_name, self.encoding


def absolute(topic: str) -> str:
    """A topic's name with the leading slash that bags record."""
    return topic if topic.startswith("/") else f"/{topic}"


def joined(topics: Iterable[Topic]) -> list[Topic]:
    """The topics by name, each once that several files, or channels of a file, hold."""
    found: dict[tuple[str, str, str], Topic] = {}
    for topic in topics:
        known = found.get(topic.key)
        found[topic.key] = topic if known is None else _joined(known, topic)
    return [found[key] for key in sorted(found)]


def _joined(first: Topic, second: Topic) -> Topic:
    """One topic that two files, or two channels of a file, hold."""
    return replace(
        first,
        messages=first.messages + second.messages,
        qos=first.qos + tuple(new for new in second.qos if new not in first.qos),
        type_hash=first.type_hash or second.type_hash,
        schema=first.schema or second.schema,
        metadata={**second.metadata, **first.metadata, **_joined_qos(first, second)},
    )


def _joined_qos(first: Topic, second: Topic) -> dict[str, str]:
    """The recorded YAML of what the publishers of two topics offered."""
    mine, theirs = (topic.metadata.get(QOS_KEY, "").strip() for topic in (first, second))
    if not theirs or theirs in mine:
        return {}
    if not mine or not all(each.startswith("-") for each in (mine, theirs)):
        return {QOS_KEY: theirs} if not mine else {}
    return {QOS_KEY: f"{mine}\n{theirs}"}
