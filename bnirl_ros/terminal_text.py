"""Text of unknown origin, such as a bag's topic names, as a terminal may be given it."""

from __future__ import annotations

import re

# Control characters, which a terminal takes for commands; what turns the direction of writing, so
# that other words are read than stand there; and halves of characters, which cannot be written.
_NOT_PLAIN = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


def plain(text: str) -> str:
    r"""The text in one line that does nothing to a terminal: escape is \x1b there, and so on."""
    return _NOT_PLAIN.sub(lambda found: ascii(found.group())[1:-1], text)


def plain_lines(text: str) -> str:
    """As `plain`, of several lines."""
    return "\n".join(map(plain, text.split("\n")))
