"""`bnirl bag`: what is in a bag, and a healthy bag from a damaged one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bnirl_ros.cli.terminal import say, warn
from bnirl_ros.errors import InputError
from bnirl_ros.terminal_text import plain

if TYPE_CHECKING:
    from bnirl_ros.bags.inspection import Inspection

_BAG_HELP = "rosbag2 folder, .mcap file, also compressed, or - for standard input"


def add(commands: Any) -> None:
    """The subcommand and its own subcommands."""
    parser = commands.add_parser("bag", help="tell what is in a bag, or repair a damaged one")
    actions = parser.add_subparsers(required=True, metavar="ACTION")

    info = actions.add_parser("info", help="tell what is in bags, and what could be inferred")
    info.description = (
        "Read bags from end to end, damaged ones as far as they go, and tell what is in them, "
        "what `bnirl infer` would take of it, and what is missing."
    )
    info.add_argument(
        "bags", nargs="+", metavar="BAG", type=Path, help=f"{_BAG_HELP}, or folder of bags"
    )
    info.set_defaults(run=_info, command=info)

    repair = actions.add_parser("repair", help="write a healthy bag from a damaged one")
    repair.description = (
        "Write all that can be read of a bag into a rosbag2 folder: messages with their bytes and "
        "times, topics with their types, type hashes and quality of service. The bag itself stays "
        "as it is."
    )
    repair.add_argument("bag", metavar="BAG", type=Path, help=_BAG_HELP)
    repair.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="folder of the new bag"
    )
    repair.set_defaults(run=_repair, command=repair)


def _info(options: argparse.Namespace) -> int:
    """`bnirl bag info`: a bag that cannot be read does not stop the others."""
    from bnirl_ros.bags.inspection import inspect
    from bnirl_ros.bags.several import bags_in

    status = 0
    for number, path in enumerate(bag for given in options.bags for bag in bags_in(given)):
        try:
            inspection = inspect(path)
        except InputError as refusal:
            warn(str(refusal))
            status = 1
            continue
        say("\n" * bool(number) + _told(inspection))
        for warning in inspection.warnings:
            warn(warning)
        if inspection.damage:
            remedy = f"; save them with `bnirl bag repair {path} --out FOLDER`"
            warn(inspection.damage + remedy * bool(inspection.messages))
            status = 1
    return status


def _told(inspection: Inspection) -> str:
    """All that is told of a bag, line by line."""
    from bnirl_ros.bags.inspection import why_not_read
    from bnirl_ros.views.tables import topic_table

    files = ", ".join(file.name for file in inspection.files)
    lines = [plain(f"{inspection.path}: {inspection.messages} messages in {files}")]
    if inspection.start is not None and inspection.end is not None:
        seconds = (inspection.end - inspection.start) / 1e9
        start, end = _date(inspection.start), _date(inspection.end)
        lines.append(f"{seconds:.3f} s, from {start} to {end}")
    lines.append(topic_table(inspection.topics, inspection.motion))
    lines.append(plain(f"bnirl infer takes {'; '.join(inspection.use)}"))
    lines += [plain(f"missing: {words}") for words in inspection.lacks]
    skipped = [(topic, why_not_read(topic)) for topic in inspection.topics]
    reasons = [f"{topic.name} {topic.messages} ({why})" for topic, why in skipped if why]
    if reasons:
        lines.append(plain(f"not for bnirl to decode, by messages: {', '.join(reasons)}"))
    return "\n".join(lines)


def _date(nanoseconds: int) -> str:
    """A time as the day and hour in UTC, or in seconds where it is none of a clock."""
    from datetime import UTC, datetime

    try:
        moment = datetime.fromtimestamp(nanoseconds / 1e9, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{nanoseconds / 1e9:.3f} s"
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def _repair(options: argparse.Namespace) -> int:
    """`bnirl bag repair`: what was saved, and what was lost."""
    from bnirl_ros.bags.repair import repair

    repaired = repair(options.bag, options.out)
    for warning in repaired.warnings:
        warn(warning)
    say(f"Written: {repaired.out}, {repaired.messages} messages on {repaired.topics} topics")
    if repaired.left_out:
        say(f"Left out: {repaired.left_out} messages with a time that no bag can hold")
    if repaired.damage is None:
        say("Lost: nothing, the bag was sound")
    else:
        say(f"Lost: {_lost(repaired.expected, repaired.messages)}: {repaired.damage}")
    return 0


def _lost(expected: int | None, found: int) -> str:
    if expected is None:
        return "what came after, and nothing tells how many messages that is"
    return f"{max(0, expected - found)} of {expected} messages"
