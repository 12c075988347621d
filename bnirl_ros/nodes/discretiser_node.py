"""The node that makes poses, actions and a planning map of what a robot publishes anyway."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy

from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.frames import frame_name
from bnirl_ros.demonstrations.live import LiveMotion, News
from bnirl_ros.demonstrations.messages import TOPIC_TYPES, map_of, stamp_of
from bnirl_ros.demonstrations.raw_messages import (
    COMMAND_TYPES,
    NO_MOTION,
    POSE_TYPES,
    TF,
    RawPose,
    brought,
    command_of,
    pose_of,
)
from bnirl_ros.errors import InputError
from bnirl_ros.inference.settings import Settings
from bnirl_ros.limits import Limits
from bnirl_ros.nodes.managed import LATCHED, ManagedNode, publish, serve
from bnirl_ros.nodes.parameters import Changeable, NodeParameter, parameter_of
from bnirl_ros.nodes.topics import NodeTopic
from bnirl_ros.nodes.transforms import LiveTransforms, tf_is_installed
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.belief import map_message
from bnirl_ros.views.demonstration import visit_messages
from bnirl_ros.views.diagnostics import Health

PARAMETERS = (
    *(parameter_of(setting, Changeable.UNCONFIGURED) for setting in fields(Discretising)),
    *(
        parameter_of(setting, Changeable.UNCONFIGURED)
        for setting in fields(Settings)
        if setting.name == "moves"
    ),
    NodeParameter(
        "open_space",
        0.0,
        Limits(
            "edge of a square round the first pose that is taken for free [m], where there is no "
            "map; 0: wait for a map",
            lowest=0.0,
            highest=1e4,
        ),
    ),
    NodeParameter(
        "queue_depth",
        1000,
        Limits("messages of the motion that may wait to be taken", lowest=1, highest=1e7),
    ),
    NodeParameter(
        "waiting_limit",
        40_000,
        Limits("poses that may wait for the first map", lowest=0, highest=1e7),
    ),
    NodeParameter(
        "transform_patience",
        1.0,
        Limits("how long a pose may wait for tf to bring it into the map's frame [s]", lowest=0.0),
    ),
)
"""Parameters: how motion is discretised, and the node's own."""

INPUTS = (
    NodeTopic(
        "map",
        TOPIC_TYPES["map"],
        "the robot's own map, of whatever resolution; a new one takes the place of the one before",
    ),
)
"""What is heard besides the topics that `source` and `intent` name, and tf."""

OUTPUTS = (
    NodeTopic(
        "pose",
        TOPIC_TYPES["pose"],
        "the cell of the planning map that the robot has come to, when it comes to it; stamped by "
        "the source",
        latched=False,
    ),
    NodeTopic(
        "action",
        TOPIC_TYPES["action"],
        "the step that led there, stamped as the pose before",
        latched=False,
    ),
    NodeTopic(
        "planning_map",
        TOPIC_TYPES["map"],
        "the map with cells of `planning_resolution`, to which the `map` of subgoal_node is to be "
        "remapped",
    ),
)
"""What subgoal_node hears."""

_AUTOMATIC = POSE_TYPES[:2]
"""What is followed if no source is named: odometry, and poses with covariance, as AMCL's. Stamped
poses may be anybody's, among them our own."""

_LOOK_PERIOD = 1.0  # [s] between two looks for topics that are not there yet
_TICK_PERIOD = 0.1  # [s] between two looks at tf, and at what commands led to
_LATENESS = 0.5  # [s] that a command may be older than the clock when it comes
_PUBLISHER_DEPTH = 1000


class DiscretiserNode(ManagedNode):
    """Makes poses, actions and a planning map of what a robot publishes anyway.

    The topics of the motion are looked for until they are there, since their types tell what to
    hear. All that is made of them is made by `LiveMotion`.
    """

    def __init__(self) -> None:
        """Declare the parameters.

        Raises:
            InputError: a parameter was given a value that it cannot have.
        """
        super().__init__("discretiser_node", "motion", PARAMETERS)

    def configure(self, values: dict[str, Any]) -> None:
        """Prepare to follow by these settings."""
        self._settings = Discretising(
            **{setting.name: values[setting.name] for setting in fields(Discretising)}
        )
        self._motion = LiveMotion(
            self._settings, values["moves"], values["open_space"], values["waiting_limit"]
        )
        self._depth: int = values["queue_depth"]
        self._patience: float = values["transform_patience"]
        self._outputs = self.advertise(OUTPUTS, _PUBLISHER_DEPTH)
        self._followed = ""  # the topic that is, in words
        self._is_heard = False  # whether anybody has heard of the poses
        self._sought: dict[str, str] = {}  # topics that are not heard yet, by their parameters
        self._refusals: dict[str, str] = {}  # why one that is there cannot be taken
        self._pending: deque[tuple[float, RawPose]] = deque()  # for tf; when it came, and what

    def activate(self) -> None:
        """Hear the map, and look for the topics of the motion until they are there."""
        self._transforms = LiveTransforms(self) if tf_is_installed() else None
        self._tells_no_time = False  # the last command
        self._last_tf = -1  # stamp of the last pose that tf told
        self._sought = {"source": self._settings.source}
        if self._settings.intent:
            self._sought["intent"] = self._settings.intent
        self._candidates: list[tuple[str, str]] = []
        backwards = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jumps = self.get_clock().create_jump_callback(
            backwards, post_callback=self._on_clock_jumped_back
        )
        (map_topic,) = INPUTS
        self.hear(map_topic.name, map_topic.type_name, self._on_map, LATCHED)
        self._tick: Any = None
        self._look = self.every(_LOOK_PERIOD, self._look_for_topics)
        self._look_for_topics()

    def deactivate(self) -> None:
        """Look for nothing any more; where the robot was last is kept."""
        self._followed = ""
        self._refusals.clear()
        self._pending.clear()
        self._jumps.unregister()
        for timer in (self._look, self._tick):
            if timer:
                self.destroy_timer(timer)
        if self._transforms:
            self._transforms.close()

    def clean_up(self) -> None:
        """Forget the motion."""
        del self._motion

    def health(self) -> Health:
        """What is followed, and what was made of it."""
        motion = self._motion
        faults = motion.faults + self.faults
        self.tell(faults)
        waits_for = [] if self._is_heard else ["a subscriber of pose"]
        waits_for += [
            f"the topic of {role}" + (f", {topic}" if topic else "")
            for role, topic in self._sought.items()
        ]
        if motion.grid_map is None:
            waits_for.append("a map")
        follows = bool(self._followed) and motion.grid_map is not None
        states = ["following"] if follows else []
        states += [f"waiting for {' and '.join(waits_for)}"] if waits_for else []
        return Health(
            subject="motion",
            state=", ".join(states),
            message=f"{motion.visits} visits of cells from {motion.poses} poses",
            values={
                "source": self._followed,
                "poses": str(motion.poses),
                "visits": str(motion.visits),
                "opened cells": str(motion.opened),
                "subscribers": str(min(self._subscribers(name) for name in ("pose", "action"))),
                "queue": str(motion.waiting + len(self._pending)),
            },
            faults=faults,
            error="; ".join(self._refusals.values()),
        )

    def _subscribers(self, output: str) -> int:
        """How many hear an output now."""
        return int(self._outputs[output].get_subscription_count())

    def _look_for_topics(self) -> None:
        """Hear what is sought and there by now; looking ends when all is found.

        Nothing is heard before somebody hears of it: a replay waits for this node, which so waits
        for the next one, and nothing is lost on the way.
        """
        self._is_heard = self._is_heard or self._subscribers("pose") > 0
        if not self._is_heard:
            return
        types = dict(self.get_topic_names_and_types())
        for role, topic in tuple(self._sought.items()):
            found = self._named(role, topic, types) if topic else self._automatic(types)
            if found and (role == "intent" or self._may_follow(*found)):
                del self._sought[role]
                self._refusals.pop(role, None)
                self._hear_motion(role, *found)
        if not self._sought:
            self._look.cancel()

    def _named(
        self, role: str, topic: str, types: Mapping[str, Sequence[str]]
    ) -> tuple[str, str] | None:
        """A topic and its type, if it is there and can be taken for its role."""
        wanted = COMMAND_TYPES if role == "intent" else (*POSE_TYPES, TF, *COMMAND_TYPES)
        there = types.get(self.resolve_topic_name(topic), ())
        for type_name in wanted:
            if type_name in there:
                return topic, type_name
        if there:
            self._refuse(
                role, f"{topic} is of type {', '.join(there)}; {role} takes {', '.join(wanted)}"
            )
        return None

    def _automatic(self, types: Mapping[str, Sequence[str]]) -> tuple[str, str] | None:
        """The topic to follow if none is named, once no further one turns up."""
        wanted = _AUTOMATIC if self._transforms else _AUTOMATIC[::-1]
        candidates = [
            (topic, type_name)
            for type_name in wanted
            for topic, there in sorted(types.items())
            if type_name in there
            and not topic.endswith(NO_MOTION)
            and self.count_publishers(topic)
        ]
        before, self._candidates = self._candidates, candidates
        if not candidates or candidates != before:
            return None
        if len(candidates) > 1:
            others = ", ".join(topic for topic, _ in candidates[1:])
            self.get_logger().info(
                plain(f"{others} would do, too; name one with the parameter source")
            )
        return candidates[0]

    def _may_follow(self, topic: str, type_name: str) -> bool:
        """Whether all is there that a source of this type needs; if not, it is told."""
        if type_name == TF and not self._transforms:
            self._refuse("source", f"{topic} can be followed only where tf2_ros is installed")
        elif type_name in COMMAND_TYPES and not self._settings.start:
            self._refuse(
                "source",
                f"{topic} has velocity commands, which tell no place; give the pose from which "
                "they are followed with the parameter start",
            )
        else:
            return True
        return False

    def _refuse(self, role: str, reason: str) -> None:
        if self._refusals.get(role) != reason:
            self._refusals[role] = reason
            self.get_logger().error(plain(reason))

    def _hear_motion(self, role: str, topic: str, type_name: str) -> None:
        """Hear a topic by the best QoS that all its publishers offer."""
        offered = self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
        best_effort = ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=self._depth)
        if any(each.qos_profile.reliability == best_effort for each in offered):
            qos.reliability = best_effort
        if role == "intent":
            self.hear(topic, type_name, self._on_intent, qos)
            return
        self._followed = f"{topic} ({type_name})"
        self.get_logger().info(plain(f"follows {self._followed}"))
        if type_name == TF:
            self._tick = self.every(_TICK_PERIOD, self._on_tf_tick)
        elif type_name in COMMAND_TYPES:
            self.hear(topic, type_name, self._on_command, qos)
            self._tick = self.every(_TICK_PERIOD, self._on_command_tick)
        else:
            self.hear(topic, type_name, self._on_pose, qos)
            if self._transforms:
                self._tick = self.every(_TICK_PERIOD, self._bring)

    @property
    def _map_frame(self) -> str:
        """The map's frame, or what it will probably be."""
        return frame_name(self._motion.frame_id or self._settings.map_frame or "map")

    def _on_map(self, message: Any, _: Mapping[str, int]) -> None:
        try:
            grid_map = map_of(message, "topic map")
        except InputError as error:
            self.faults[str(error)] += 1
            return
        self._tell(self._motion.take_map(grid_map))

    def _on_pose(self, message: Any, _: Mapping[str, int]) -> None:
        pose = pose_of(message)
        if self._transforms and pose.frame_id != self._map_frame:
            self._pending.append((time.monotonic(), pose))
            self._bring()
        else:
            self._tell(self._motion.take_pose(pose))

    def _bring(self) -> None:
        """Take the poses that tf brings into the map's frame by now, in their order."""
        assert self._transforms
        while self._pending:
            came, pose = self._pending[0]
            transform = self._transforms.look_up(self._map_frame, pose.frame_id, pose.stamp)
            if transform is None:
                if time.monotonic() - came < self._patience:
                    return
                self.faults[
                    f"pose in frame {pose.frame_id!r}, which tf does not join to "
                    f"{self._map_frame!r} at its time"
                ] += 1
            else:
                self._tell(self._motion.take_pose(brought(pose, transform)))
            self._pending.popleft()

    def _on_tf_tick(self) -> None:
        assert self._transforms
        base = frame_name(self._settings.base_frame)
        transform = self._transforms.look_up(self._map_frame, base, None)
        if transform is not None and stamp_of(transform) != self._last_tf:
            self._last_tf = stamp_of(transform)
            at_its_origin = RawPose(self._last_tf, base, (0.0, 0.0, 0.0), 0.0)
            self._tell(self._motion.take_pose(brought(at_its_origin, transform)))

    def _on_command(self, message: Any, info: Mapping[str, int]) -> None:
        # A Twist has no stamp, and many leave that of a TwistStamped empty. When it was published
        # is nearer the truth than when it is taken, but not by a simulation's clock.
        stamp = stamp_of(message) if hasattr(message, "header") else 0
        self._tells_no_time = not stamp
        if not stamp:
            simulated = self.get_clock().ros_time_is_active
            stamp = self.stamp() if simulated else info["source_timestamp"]
        self._tell(self._motion.take_command(stamp, command_of(message)))

    def _on_command_tick(self) -> None:
        if self._tells_no_time:  # stamps may be of another time, as when a bag is replayed
            self._tell(self._motion.advance(self.stamp() - round(_LATENESS * 1e9)))

    def _on_intent(self, message: Any, _: Mapping[str, int]) -> None:
        self._tell(self._motion.take_intent(command_of(message)))

    def _on_clock_jumped_back(self, _: Any) -> None:
        self._tell(self._motion.clock_jumped_back())
        self._pending.clear()
        if self._transforms:
            self._transforms.clear()

    def _tell(self, news: News) -> None:
        for warning in news.warnings:
            self.get_logger().warning(plain(warning))
        if news.grid_map:
            publish(self._outputs["planning_map"], map_message(news.grid_map, self.stamp()))
        for visit in news.visits:
            assert self._motion.frame_id
            *action, pose = visit_messages(visit, self._motion.frame_id)
            for message in action:
                publish(self._outputs["action"], message)
            publish(self._outputs["pose"], pose)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; returns the exit status."""
    return serve("discretiser_node", DiscretiserNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
