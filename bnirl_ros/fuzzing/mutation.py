"""Changes of good input that make bad input of it."""

from __future__ import annotations

import math
import random
import re
import struct
from collections.abc import Callable, Sequence

_INTEGERS = (0, 1, 2, 127, 128, 255, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63)
_FLOATS = (
    *(0.0, -0.0, 1.0, -1.0, 0.5, 5e-324, 1e-308, 1e-5, 2.0**53, 1e18, 1e19, 1e38, 1e300),
    *(1.797e308, -1e300, math.inf, -math.inf, math.nan),
)
_PACKED = (
    *(struct.pack("<I", number & 0xFFFFFFFF) for number in _INTEGERS),
    *(struct.pack("<Q", number) for number in _INTEGERS),
    *(struct.pack(">I", number & 0xFFFFFFFF) for number in _INTEGERS),
    *(struct.pack("<d", number) for number in _FLOATS),
    *(struct.pack("<f", number) for number in _FLOATS if abs(number) < 3e38 or number != number),
    struct.pack("<f", math.inf),
)
"""Numbers at the edge of what a type holds, and of what arithmetic bears, as they are packed."""

_WORDS = (
    *("0", "-1", "1e309", "-1e309", "1e-320", "nan", ".nan", "inf", "-.inf", "0x10", "1_000"),
    *("99999999999999999999", "-9223372036854775809", "4294967296", "1e5", "٣", "", " ", "~"),
    *("null", "true", "[]", "{}", "[1, 2", "&a [*a]", "*a", "!!python/object:os.system x", "%"),
    *('"', "'", "\x00", "\x1b[2J", "\ufeff", "\u2028", "../../../../etc/passwd", "/dev/zero"),
    "a" * 5000,
)
"""Words that mean something else than they look like, or nothing."""

_NUMBER = re.compile(rb"-?\d+(\.\d+)?")


def mutated(data: bytes, others: Sequence[bytes], generator: random.Random) -> bytes:
    """Good input after one to four changes.

    Args:
        data: to be changed.
        others: input of the same kind, parts of which may take the place of parts.
        generator: source of randomness.
    """
    for _ in range(generator.choice((1, 1, 1, 2, 2, 4))):
        change = generator.choice(_CHANGES)
        data = change(data, others, generator)
    return data


def _flip(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    if not data:
        return data
    place = generator.randrange(len(data))
    return data[:place] + bytes([data[place] ^ 1 << generator.randrange(8)]) + data[place + 1 :]


def _cut(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    return data[: generator.randint(0, len(data))]


def _without(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    first, last = _part(data, generator)
    return data[:first] + data[last:]


def _twice(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    first, last = _part(data, generator)
    return data[:last] + data[first:last] * generator.choice((1, 1, 2, 100)) + data[last:]


def _spliced(data: bytes, others: Sequence[bytes], generator: random.Random) -> bytes:
    other = generator.choice(others)
    first, last = _part(other, generator)
    place = generator.randint(0, len(data))
    return data[:place] + other[first:last] + data[place + (last - first) :]


def _number(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    """Another number where one may lie in the binary data, as CDR and MCAP align them or not."""
    packed = generator.choice(_PACKED)
    if len(data) < len(packed):
        return data
    place = generator.randint(0, len(data) - len(packed))
    if generator.random() < 0.7:
        place -= place % 4
    return data[:place] + packed + data[place + len(packed) :]


def _word(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    """Another word for a number in a text, or one in between."""
    word = generator.choice(_WORDS).encode()
    numbers = list(_NUMBER.finditer(data[:100_000]))
    if numbers and generator.random() < 0.7:
        first, last = generator.choice(numbers).span()
    else:
        first = last = generator.randint(0, len(data))
    return data[:first] + word + data[last:]


def _noise(data: bytes, _: Sequence[bytes], generator: random.Random) -> bytes:
    place = generator.randint(0, len(data))
    return data[:place] + generator.randbytes(generator.randint(1, 64)) + data[place:]


_CHANGES: tuple[Callable[[bytes, Sequence[bytes], random.Random], bytes], ...] = (
    *(_flip, _cut, _without, _twice, _spliced, _number, _number, _number, _word, _word, _noise),
)


def _part(data: bytes, generator: random.Random) -> tuple[int, int]:
    """Where some of the bytes begin and end."""
    first = generator.randint(0, len(data))
    return first, min(len(data), first + generator.choice((1, 4, 16, 256, 4096)))
