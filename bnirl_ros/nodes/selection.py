"""Which topics are wanted, of a recording or for one, and the options that say so."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass

from bnirl_ros.bags.topics import absolute


@dataclass(frozen=True)
class Selection:
    """Which topics are wanted; all where nothing is said.

    Attributes:
        topics: names of some.
        regex: the wanted ones' whole names match it, or are among `topics`.
        exclude: names of those that are not wanted, whatever else is said.
        exclude_regex: as `exclude`, for whole names that match it.
    """

    topics: tuple[str, ...] | None = None
    regex: re.Pattern[str] | None = None
    exclude: tuple[str, ...] = ()
    exclude_regex: re.Pattern[str] | None = None

    def has(self, topic: str) -> bool:
        """Whether a topic is wanted."""
        name = absolute(topic)
        if name in self.exclude or (self.exclude_regex and self.exclude_regex.fullmatch(name)):
            return False
        if self.topics is None and self.regex is None:
            return True
        named = self.topics is not None and name in self.topics
        return named or bool(self.regex and self.regex.fullmatch(name))


def selection_of(given: argparse.Namespace, topics: Sequence[str] | None = None) -> Selection:
    """What the options of `add_selection` say, and the names of wanted topics."""
    return Selection(
        None if topics is None else tuple(map(absolute, topics)),
        given.regex,
        tuple(map(absolute, given.exclude_topics)),
        given.exclude_regex,
    )


def add_selection(parser: argparse._ActionsContainer) -> None:
    """Options by which topics are chosen."""
    parser.add_argument("-e", "--regex", type=_pattern, help="only those whose whole name matches")
    parser.add_argument(
        "--exclude-topics", nargs="+", default=(), metavar="TOPIC", help="leave these out"
    )
    parser.add_argument(
        "-x",
        "--exclude-regex",
        type=_pattern,
        metavar="REGEX",
        help="leave those out whose whole name matches",
    )


def _pattern(text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no regular expression: {error}") from error
