"""A node on a network where anything is sent stays up, and finds what there is to find."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from bnirl_ros.fuzzing.doors import door_called
from bnirl_ros.fuzzing.mutation import mutated
from demonstration_support import (
    CORNERS,
    MAP,
    OBSERVATIONS_OF_WALK,
    SECOND,
    START,
    map_of_grid,
    pose_at,
    walk,
)
from ros_support import LATCHED, RELIABLE, Subgoals

from bnirl_ros.nodes.conversion import message_class  # isort: skip  # needs rclpy
from bnirl_ros.nodes.subgoal_node import INPUTS  # isort: skip

pytestmark = pytest.mark.timeout(180)

MESSAGES = 300
"""Of each topic."""


def test_a_node_bears_whatever_bytes_come_on_its_topics(
    subgoals: Callable[..., Subgoals],
) -> None:
    node = subgoals(sweeps=300, burn_in=100, journal=False)
    kinds = {topic.name: message_class(topic.type_name) for topic in INPUTS}
    publishers = {
        name: node.peer.publisher(kind, f"/{name}", LATCHED if name == "map" else RELIABLE)
        for name, kind in kinds.items()
    }
    node.peer.let_them_find_us()
    generator = random.Random(0)
    for topic in ("pose", "action", "map"):
        (good, *_) = seeds = door_called(f"topic {topic}").seeds
        bad = [mutated(good, seeds, generator) for _ in range(MESSAGES)]
        # What is too short comes last: Fast DDS gets nothing more across from who sent such.
        for data in sorted(bad, key=lambda data: len(data) < len(good)):
            publishers[topic].publish(data)
    node.send([map_of_grid()], [pose_at(0.5, 0.5, START)])  # the last of each of them
    node.peer.until(
        lambda: int(node.health().get("drops", "0")) > MESSAGES / 10, "what was left out"
    )
    node.until_quiet()
    assert node.process.running
    assert node.call("reset").success
    node.until_health("nothing", observations="0", queue="0")
    node.send([map_of_grid()], walk(start=START + 10_000 * SECOND))
    node.until_settled(OBSERVATIONS_OF_WALK)
    places = {tuple(place) for place in MAP.centres_of(list(CORNERS)).tolist()}
    node.until_shown(places)
    assert node.call("infer").success
    assert "Traceback" not in node.process.err
