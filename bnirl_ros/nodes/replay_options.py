"""The command line of a replay."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bnirl_ros.bags.topics import absolute
from bnirl_ros.limits import above_zero, one_or_more, zero_or_more
from bnirl_ros.nodes.selection import Selection, add_selection, selection_of

CLOCK_RATE = 40.0
"""How often /clock is published unless it is said [Hz]."""

BETWEEN_BAGS = 5.0
"""To which a silence is cut where there are several bags, unless it is said [s]."""


@dataclass(frozen=True)
class Options:
    """How to play.

    Attributes:
        bags: rosbag2 folders, MCAP files, or folders of them.
        rate: factor on the recorded pace, above 0; None: as fast as subscribers acknowledge.
        grid_map: a map file to publish on /map first, for a bag that has none; None: none.
        subscribers: how many subscribers of every topic to wait for.
        patience: how long to wait for them [s].
        delay: how long to wait after that [s].
        offset: where to begin, from the start of the recording [s].
        duration: how much of the recording to play [s]; None: all of it.
        paused: whether to begin only when `~/resume` is called.
        loop: whether to begin again at the end.
        longest_silence: to which longer silences are cut [s]; None: to `BETWEEN_BAGS` where there
            are several bags, else to none.
        selection: the wanted topics.
        remaps: other names for topics, by the recorded ones.
        qos_overrides: a file with QoS by topic; None: all as recorded.
        clock: how often to publish the time of the recording on /clock [Hz]; None: never.
    """

    bags: tuple[Path, ...]
    rate: float | None = 1.0
    grid_map: Path | None = None
    subscribers: int = 1
    patience: float = 10.0
    delay: float = 0.0
    offset: float = 0.0
    duration: float | None = None
    paused: bool = False
    loop: bool = False
    longest_silence: float | None = None
    selection: Selection = field(default_factory=Selection)
    remaps: tuple[tuple[str, str], ...] = ()
    qos_overrides: Path | None = None
    clock: float | None = None


def parse(arguments: Sequence[str], name: str = "replay_node") -> Options:
    """The options on a command line without ROS arguments; wrong ones end with status 2."""
    given = _parser(name).parse_args(arguments)
    return Options(
        bags=tuple(given.bags),
        rate=None if given.fast else given.rate,
        grid_map=given.map,
        subscribers=given.subscribers,
        patience=given.wait,
        delay=given.delay,
        offset=given.start_offset,
        duration=given.playback_duration,
        paused=given.start_paused,
        loop=given.loop,
        longest_silence=given.longest_silence,
        selection=selection_of(given, given.topics),
        remaps=tuple(given.remap),
        qos_overrides=given.qos_profile_overrides_path,
        clock=given.clock,
    )


def _parser(name: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=name,
        description="Play recorded demonstrations onto their topics. While it plays, services "
        "under the node's name pause and resume it, seek, and more: see docs/reference.md.",
    )
    parser.add_argument(
        "bags",
        metavar="BAG",
        nargs="+",
        type=Path,
        help="rosbag2 folder, .mcap file, or folder of such; several are played in order of time",
    )
    when = parser.add_argument_group("when")
    pace = when.add_mutually_exclusive_group()
    pace.add_argument(
        "-r",
        "--rate",
        type=above_zero,
        default=1.0,
        help="factor on the recorded pace (%(default)s)",
    )
    pace.add_argument("--fast", action="store_true", help="as fast as the subscribers acknowledge")
    when.add_argument("-l", "--loop", action="store_true", help="begin again at the end")
    when.add_argument(
        "-d",
        "--delay",
        type=zero_or_more,
        default=0.0,
        metavar="SECONDS",
        help="wait so long before the first message, when subscribers are there",
    )
    when.add_argument(
        "--start-offset",
        type=zero_or_more,
        default=0.0,
        metavar="SECONDS",
        help="begin so far into the recording, with what was latched then",
    )
    when.add_argument(
        "--playback-duration",
        type=above_zero,
        metavar="SECONDS",
        help="play so much of the recording",
    )
    when.add_argument(
        "-p", "--start-paused", action="store_true", help="begin when ~/resume is called"
    )
    when.add_argument(
        "--longest-silence",
        type=above_zero,
        metavar="SECONDS",
        help=f"cut longer silences in the recording to this ({BETWEEN_BAGS:g} where there are "
        "several bags, else none is cut)",
    )
    when.add_argument(
        "--clock",
        nargs="?",
        type=above_zero,
        const=CLOCK_RATE,
        metavar="HZ",
        help="publish the time of the recording on /clock, so often a second (%(const)g), for "
        "nodes with use_sim_time",
    )
    _add_topics(parser.add_argument_group("what"))
    whom = parser.add_argument_group("for whom")
    whom.add_argument(
        "--wait",
        type=above_zero,
        default=10.0,
        metavar="SECONDS",
        help="how long to wait for the subscribers (%(default)s); ~/resume ends it",
    )
    whom.add_argument(
        "--subscribers",
        type=one_or_more,
        default=1,
        metavar="N",
        help="how many subscribers of every topic to wait for, such as 2 for a node and a "
        "recorder (%(default)s)",
    )
    return parser


def _add_topics(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play only these")
    add_selection(parser)
    parser.add_argument(
        "-m",
        "--remap",
        nargs="+",
        type=_remap,
        default=(),
        metavar="OLD:=NEW",
        help="publish topics under other names",
    )
    parser.add_argument(
        "--qos-profile-overrides-path",
        type=Path,
        metavar="FILE",
        help="YAML with reliability, durability, history and depth by topic; what it leaves open "
        "is as recorded",
    )
    parser.add_argument("--map", type=Path, help="map file to publish on /map for a bag without")


def _remap(text: str) -> tuple[str, str]:
    old, _, new = text.partition(":=")
    if not old or not new:
        raise argparse.ArgumentTypeError(f"{text!r} is not like /old:=/new")
    return absolute(old), new
