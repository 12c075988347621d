"""Several bags, and folders of bags, read as one: everything in the order of log time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path

from bnirl_ros.bags.merging import Merging
from bnirl_ros.bags.reader import Bag, files_in
from bnirl_ros.bags.topics import RawMessage, Topic, joined


class Bags:
    """Recorded bags, opened to be read together. As of one `Bag`, all is read that can be.

    Args:
        paths: rosbag2 folders, MCAP files, and folders with such folders somewhere in them.

    Raises:
        InputError: one of them cannot be read at all; the sentence names it.
    """

    def __init__(self, paths: Sequence[str | Path]) -> None:
        opened = [Bag(found) for path in paths for found in bags_in(Path(path))]
        # An empty bag has nothing to merge.
        self._bags = sorted(opened, key=lambda bag: bag.span or (0, 0))
        self._spans = [bag.span for bag in self._bags]

    def __len__(self) -> int:
        return len(self._bags)

    @property
    def damage(self) -> str | None:
        """What is damaged, as `Bag.damage`."""
        return "; ".join(bag.damage for bag in self._bags if bag.damage) or None

    @property
    def warnings(self) -> list[str]:
        """What is wrong but loses nothing."""
        return [warning for bag in self._bags for warning in bag.warnings]

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last log time [ns], as the bags' chunks tell; None without any."""
        spans = [span for span in self._spans if span]
        if not spans:
            return None
        return min(first for first, _ in spans), max(last for _, last in spans)

    def topics(self) -> list[Topic]:
        """The topics by name, those without messages among them."""
        return joined(topic for bag in self._bags for topic in bag.topics())

    def messages(
        self,
        topics: Iterable[str] | None = None,
        since: int | None = None,
        until: int | None = None,
    ) -> Iterator[RawMessage]:
        """As `Bag.messages`, of all bags. A bag is read only when its time comes."""
        wanted = None if topics is None else frozenset(topics)
        merging = Merging()
        for number, (bag, span) in enumerate(zip(self._bags, self._spans, strict=True)):
            if span is None:
                continue
            yield from merging.messages(until=span[0])
            merging.add((number,), bag.messages(wanted, since, until))
        yield from merging.messages()


def bags_in(path: Path) -> list[Path]:
    """The bags at a path: itself, or those in a folder that is no bag but has some."""
    if not path.is_dir() or _is_bag(path):
        return [path]
    inside = sorted(folder for folder in path.rglob("*") if folder.is_dir() and _is_bag(folder))
    return inside or [path]


def _is_bag(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file() or bool(files_in(folder))


def latched_at(
    bags: Bags, depths: Mapping[str, int], time: int, early: int = 0
) -> list[RawMessage]:
    """What a subscriber that comes at a time would get of latched topics, in order of time.

    Args:
        bags: the bags.
        depths: how many messages each of the topics keeps, by name.
        time: the log time [ns].
        early: of a topic without any message before, its first ones up to this log time [ns] are
            among them. A recorder that is started gets what was latched long before only after
            a moment, when it has found who latches it.
    """
    kept = {topic: deque[RawMessage](maxlen=depth) for topic, depth in depths.items()}
    for message in bags.messages(kept, until=time - 1):
        kept[message.topic].append(message)
    missing = {topic for topic, messages in kept.items() if not messages}
    if missing and early >= time:
        for message in bags.messages(missing, since=time, until=early):
            if len(kept[message.topic]) < depths[message.topic]:
                kept[message.topic].append(message)
    return sorted(
        (each for messages in kept.values() for each in messages), key=attrgetter("log_time")
    )
