"""Damage bags in thousands of ways, and see what is read of them: only what must be may be lost.

`python -m bnirl_ros.experiments.damage BAG...`, or `make campaigns`. Each file is cut off at many
places, and each time one of its bytes is changed. What has to be read then is known: all messages
before the damage, and inside of a damaged chunk whatever can be unpacked of the bytes before it.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from mcap.opcode import Opcode

from bnirl_ros.bags.reader import Bag
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.restraint import limited_memory, patience

CUTS = 100
"""Places at which each file is cut off."""

CHANGES = 1000
"""Bytes of each file that are changed, one at a time."""

_MAGIC_SIZE = 8
_FRAME = struct.Struct("<BQ")
_CHUNK_FIELDS = 40  # bytes, without the name of the compression
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time and publish time


class Damage(NamedTuple):
    """A byte's place, and its new value; None cuts the file off before it."""

    place: int
    value: int | None

    def done_to(self, data: bytes) -> bytes:
        """The damaged bytes."""
        if self.value is None:
            return data[: self.place]
        return data[: self.place] + bytes([self.value]) + data[self.place + 1 :]


Recorded = tuple[int, bytes]
"""What tells one message from another: its log time and its data."""


@dataclass(frozen=True)
class _Stretch:
    """Messages whose records lie one after the other, in a chunk or outside of one.

    Attributes:
        start, end: of what the messages are made of in the file: packed bytes, or records.
        compression: of the bytes, as MCAP calls it.
        ends: where each message ends among the bytes when unpacked, ascending.
        messages: they.
    """

    start: int
    end: int
    compression: str
    ends: list[int]
    messages: list[Recorded]

    def before(self, data: bytes, place: int) -> list[Recorded]:
        """The messages that are left of it when the file is damaged at a place."""
        if place >= self.end:
            return self.messages
        if place <= self.start:
            return []
        size = len(_unpacked(data[self.start : place], self.compression))
        return [each for end, each in zip(self.ends, self.messages, strict=True) if end <= size]


def stretches_of(data: bytes) -> list[_Stretch]:
    """The messages of a sound MCAP file, told without anything that the reader uses."""
    found = []
    for opcode, start, end in _records(data, _MAGIC_SIZE):
        if opcode == Opcode.MESSAGE:
            found.append(_Stretch(start, end, "", [end - start], [_recorded(data, start, end)]))
        elif opcode == Opcode.CHUNK:
            (length,) = struct.unpack_from("<I", data, start + 28)
            name = data[start + 32 : start + 32 + length].decode()
            first = start + _CHUNK_FIELDS + length
            records = _unpacked(data[first:end], name)
            places = [(a, b) for opcode, a, b in _records(records, 0) if opcode == Opcode.MESSAGE]
            messages = [_recorded(records, a, b) for a, b in places]
            found.append(_Stretch(first, end, name, [b for _, b in places], messages))
        elif opcode == Opcode.FOOTER:
            break
    return found


def damages_of(data: bytes, cuts: int, changes: int, seed: int = 0) -> list[Damage]:
    """Cuts at even distances, and changes of random bytes to other random ones."""
    generator = random.Random(seed)
    made = [Damage(len(data) * number // cuts, None) for number in range(cuts)]
    for _ in range(changes):
        place = generator.randrange(len(data))
        value = (data[place] + generator.randrange(1, 256)) % 256
        made.append(Damage(place, value))
    return made


def problem_with(
    path: Path, damage: Damage, data: bytes, stretches: Sequence[_Stretch]
) -> str | None:
    """What is wrong with how a damaged file is read; None if nothing is.

    Args:
        path: where to write it.
        damage: what to do to it.
        data: the sound file.
        stretches: of the sound file.
    """
    path.write_bytes(damage.done_to(data))
    found: Counter[Recorded] = Counter()
    try:
        bag = Bag(path)
        found.update((message.log_time, message.data) for message in bag.messages())
        bag.topics()
        words = bag.damage
    except InputError as refusal:
        words = str(refusal)
    if words is not None and ("\n" in words or str(path) not in words):
        return f"says {words!r}"
    due = Counter(each for part in stretches for each in part.before(data, damage.place))
    missing = due - found
    if missing:
        return f"misses {missing.total()} of the {due.total()} messages before the damage"
    if damage.value is None and words is None:
        return "says nothing of a file that is cut off"
    return None


@dataclass(frozen=True)
class Result:
    """What came of damaging one file.

    Attributes:
        path: of the file.
        messages: how many it has.
        damages: how often it was damaged.
        problems: what went wrong, each with the damage.
        slowest: the longest time to read it [s].
        memory: the most that the process took [bytes].
    """

    path: Path
    messages: int
    damages: int
    problems: tuple[str, ...]
    slowest: float
    memory: int


def campaign(path: Path, cuts: int = CUTS, changes: int = CHANGES) -> Result:
    """Damage one file in all these ways, and read it each time."""
    data = path.read_bytes()
    stretches = stretches_of(data)
    problems, slowest = [], 0.0
    damages = damages_of(data, cuts, changes)
    with TemporaryDirectory() as folder, limited_memory(), patience() as watched:
        for damage in damages:
            begun = time.monotonic()
            try:
                with watched():
                    problem = problem_with(Path(folder) / path.name, damage, data, stretches)
            except Exception as fault:  # whatever it is, the campaign is to tell of it
                problem = f"raises {type(fault).__name__}: {fault}"
            slowest = max(slowest, time.monotonic() - begun)
            if problem is not None:
                how = "cut off" if damage.value is None else f"changed to {damage.value}"
                problems.append(f"{path}: byte {damage.place} {how}: {problem}")
    count = sum(len(part.messages) for part in stretches)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Result(path, count, len(damages), tuple(problems), slowest, memory)


def _records(data: bytes, place: int) -> Iterator[tuple[int, int, int]]:
    """The kind, start and end of each record's content."""
    while place + _FRAME.size <= len(data):
        opcode, length = _FRAME.unpack_from(data, place)
        start = place + _FRAME.size
        yield opcode, start, start + length
        place = start + length


def _recorded(data: bytes, start: int, end: int) -> Recorded:
    _, _, log_time, _ = _MESSAGE.unpack_from(data, start)
    return log_time, data[start + _MESSAGE.size : end]


def _unpacked(packed: bytes, compression: str) -> bytes:
    import lz4.frame
    import zstandard

    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(packed)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    return packed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign; returns its exit status: 0, 1 if anything went wrong."""
    parser = argparse.ArgumentParser(
        prog="damage", description="Damage bags, and see what is read of them."
    )
    parser.add_argument(
        "bags", nargs="+", metavar="BAG", type=Path, help="MCAP files, or folders with some"
    )
    parser.add_argument("--cuts", type=int, default=CUTS, help="of each file (%(default)s)")
    parser.add_argument("--changes", type=int, default=CHANGES, help="of each (%(default)s)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="(%(default)s)")
    options = parser.parse_args(arguments)
    files = [
        file
        for bag in options.bags
        for file in ([bag] if bag.is_file() else sorted(bag.rglob("*.mcap")))
    ]
    if not files:
        print("damage: no MCAP files there; name some", file=sys.stderr)
        return 1
    problems = []
    print("| file | messages | damaged | went wrong | slowest [s] | memory [MB] |")
    print("|---|---|---|---|---|---|")
    with ProcessPoolExecutor(options.jobs, max_tasks_per_child=1) as pool:
        count = len(files)
        cuts, changes = [options.cuts] * count, [options.changes] * count
        for result in pool.map(campaign, files, cuts, changes):
            problems += result.problems
            print(
                f"| {result.path.name} | {result.messages} | {result.damages} | "
                f"{len(result.problems)} | {result.slowest:.2f} | {result.memory / 1e6:.0f} |",
                flush=True,
            )
    print("\n".join(problems))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
