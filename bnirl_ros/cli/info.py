"""`bnirl info`: the topics of a bag, and which of them are taken."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from bnirl_ros.cli.inference import told_of
from bnirl_ros.cli.terminal import warn


def add(commands: Any) -> None:
    """The subcommand and its options."""
    parser = commands.add_parser("info", help="list the topics of a bag")
    parser.description = (
        "List the topics of a bag, and tell what bnirl infer takes from it: poses and actions, or "
        "the motion that topics tell, which are numbered in the order in which they are tried."
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="rosbag2 folder or .mcap file")
    parser.set_defaults(run=_info, command=parser)


def _info(options: argparse.Namespace) -> int:
    """`bnirl info`: the topics of a bag, and which of them are taken."""
    from bnirl_ros.bags.raw_demonstration import is_raw, motion_topics
    from bnirl_ros.bags.reader import Bag
    from bnirl_ros.demonstrations.discretising import Discretising
    from bnirl_ros.demonstrations.messages import TOPIC_TYPES
    from bnirl_ros.views.tables import topic_table

    bag = Bag(options.bag)
    motion = motion_topics(bag) if is_raw(options.bag, Discretising()) else []
    for warning in bag.warnings:
        warn(warning)
    print(topic_table(bag.topics(), motion))
    if motion:
        print(
            "bnirl infer takes the motion on topic 1, or the next one that can be used; --source "
            "names another"
        )
    elif any(topic.type_name == TOPIC_TYPES["action"] for topic in bag.topics()):
        print("bnirl infer takes poses and actions")
    else:
        print("nothing here tells motion")
    return told_of(bag.damage)
