"""A healthy bag from a damaged one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.errors import InputError


@dataclass(frozen=True)
class Repair:
    """What became of a bag.

    Attributes:
        out: the folder of the healthy one.
        messages: how many are in it.
        topics: how many, those without messages among them.
        expected: how many messages were recorded; None where the bag does not say.
        left_out: how many could be read, but have a time that no bag can hold.
        warnings: sentences on what was wrong with the bag, but lost nothing.
        damage: a sentence on where it is damaged and what is lost; None for a sound one.
    """

    out: Path
    messages: int
    topics: int
    expected: int | None
    left_out: int
    warnings: tuple[str, ...]
    damage: str | None


def repair(path: str | Path, out: str | Path, *, overwrite: bool = False) -> Repair:
    """Write all that can be read of a bag into a rosbag2 folder, in the order of log time.

    Messages keep their bytes and times, topics their types, definitions, type hashes and quality
    of service, also those of types unknown to this package. Messages that were compressed one by
    one are unpacked.

    Args:
        path: the bag; it stays as it is.
        out: the folder for the new one.
        overwrite: whether a bag that is there already may be replaced.

    Raises:
        InputError: nothing can be read, or the folder cannot be written to.
    """
    bag = Bag(path)
    topics = bag.topics()
    messages = left_out = 0
    if any(file.resolve().parent == Path(out).resolve() for file in bag.files):
        raise InputError(f"{out}: is where the damaged bag lies; choose another folder")
    if not topics:
        raise InputError(bag.damage or f"{path}: has no topic at all; there is nothing to repair")
    try:
        with BagWriter(out, overwrite=overwrite) as writer:
            for topic in topics:
                writer.add_recorded_topic(topic)
            for message in bag.messages():
                try:
                    writer.write_recorded(message)
                except ValueError:
                    left_out += 1
                else:
                    messages += 1
    except OSError as fault:
        raise InputError(
            f"{out}: cannot be written ({fault.strerror}); choose a folder with more room"
        ) from fault
    return Repair(
        out=Path(out),
        messages=messages,
        topics=len(topics),
        expected=bag.expected,
        left_out=left_out,
        warnings=tuple(bag.warnings),
        damage=bag.damage,
    )
