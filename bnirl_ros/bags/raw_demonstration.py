"""A bag of what robots publish anyway - odometry, poses, tf, commands - as a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.bags.cdr import decode
from bnirl_ros.bags.demonstration import RecordedDemonstration
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.topics import Topic, absolute
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.frames import TransformBuffer, frame_name, moved
from bnirl_ros.demonstrations.messages import TOPIC_TYPES, map_of, stamp_of
from bnirl_ros.demonstrations.motion import Discretiser, record
from bnirl_ros.demonstrations.planning import on_opened, open_space_round, planning_map
from bnirl_ros.demonstrations.raw_messages import (
    COMMAND_TYPES,
    NO_MOTION,
    POSE_TYPES,
    TF,
    Command,
    command_of,
    pose_of,
)
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.demonstrations.velocity import CommandFollower, follow
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap

_SECOND = 1_000_000_000

_KINDS = (*POSE_TYPES, TF, *COMMAND_TYPES)
"""Message types that tell motion, in the order in which they are tried."""

_REMEDY = "; name another topic with --source, or the frames with --map-frame and --base-frame"


@dataclass(frozen=True, eq=False)
class _Told:
    """Poses as they were told, each in its own frame.

    Attributes:
        stamps: (P,) [ns].
        frames: (P,) names of their frames.
        points: (P, 4) homogeneous positions [m].
        headings: (P,) [rad].
        arrivals: (P,) log times [ns].
    """

    stamps: npt.NDArray[np.int64]
    frames: npt.NDArray[np.object_]
    points: npt.NDArray[np.float64]
    headings: npt.NDArray[np.float64]
    arrivals: npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Motion:
    """Motion in the frame of the map.

    Attributes:
        stamps: (P,) [ns].
        poses: (P, 3) x, y and heading [m, m, rad].
        arrivals: (P,) log times [ns].
        words: what tells it, for the report.
    """

    stamps: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]
    arrivals: npt.NDArray[np.int64]
    words: str


def motion_topics(topics: Iterable[Topic]) -> list[Topic]:
    """Those of a bag's topics that tell motion, in the order in which they are tried.

    That is by kind, and of a kind those with the most messages first.
    """
    found = [
        topic
        for topic in topics
        if topic.type_name in _KINDS
        and topic.messages
        and not topic.name.endswith((*NO_MOTION, "tf_static"))
    ]
    return sorted(found, key=lambda topic: (_KINDS.index(topic.type_name), -topic.messages))


def action_topics(topics: Iterable[Topic]) -> list[Topic]:
    """Those of a bag's topics that carry actions, also under another name, which is to be told.

    Nothing else is called so and of that type.
    """
    return [
        topic
        for topic in topics
        if topic.type_name == TOPIC_TYPES["action"] and topic.name.endswith("action")
    ]


def is_raw(
    path: str | Path,
    settings: Discretising,
    remappings: Mapping[str, str] = MappingProxyType({}),
) -> bool:
    """Whether a bag is to be discretised: a source is named, or only raw motion is in it.

    Args:
        path: the bag.
        settings: which may name a source.
        remappings: as of `read_demonstration`; who names a topic of poses or actions has them.

    Raises:
        InputError: the bag cannot be read.
    """
    if settings.source:
        return True
    if {"pose", "action"} & set(remappings):
        return False
    topics = Bag(path).topics()
    return not action_topics(topics) and bool(motion_topics(topics))


def read_raw_demonstration(
    path: str | Path,
    settings: Discretising,
    grid_map: GridMap | None = None,
    moves: int = 8,
    map_topic: str = "map",
) -> tuple[RecordedDemonstration, str]:
    """Read what a robot published while it was driven, and put it on a planning map.

    Args:
        path: the bag.
        settings: which topics to take, and how to discretise them.
        grid_map: the map; None takes the bag's or, where that has none, open space.
        moves: 4 or 8: which actions there are.
        map_topic: the recorded topic of the map.

    Returns:
        The demonstration, whose map is the planning map, and a sentence on what it was made of.
        Its episodes are told apart by gaps of more than `longest_silence`.

    Raises:
        InputError: the bag cannot be read, or tells no motion that can be brought into the frame
            of the map; the sentence tells why and what to do.
    """
    reading = _Reading(Bag(path), settings)
    if grid_map is None:
        grid_map = reading.last_map(absolute(map_topic))
    frame_id = settings.map_frame or (grid_map.frame_id if grid_map else "map")
    motion = reading.motion(frame_id)
    intent = absolute(settings.intent) if settings.intent else ""
    commands = list(reading.commands(intent)) if intent else []

    if grid_map is None:
        planning = open_space_round(
            motion.poses[:, :2], settings.planning_resolution, frame_id, str(path)
        )
        height, width = planning.free.shape
        reading.warnings.append(
            f"{path}: has no map, so that the robot's surroundings, {width} x {height} cells, are "
            "taken for open space; give one with --map"
        )
    else:
        try:
            planning, warning = planning_map(grid_map, settings)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        reading.warnings += [warning] if warning else []
    discretiser, recorder = Discretiser(planning, settings, moves), Recorder()
    recorder.map_arrived()
    heard = 0
    for stamp, pose, arrival in zip(
        motion.stamps.tolist(), motion.poses.tolist(), motion.arrivals.tolist(), strict=True
    ):
        while heard < len(commands) and commands[heard][0] <= arrival:
            command = commands[heard][1]
            discretiser.hear(command.forwards, command.left)
            heard += 1
        for visit in discretiser.follow(stamp, *pose):
            record(recorder, visit, frame_id)
    if grid_map and discretiser.opened:
        reading.warnings.append(
            on_opened(discretiser.opened, planning, motion.poses[:, :2], grid_map)
        )
    recording = recorder.snapshot()
    if not len(recording.actions):
        raise InputError(
            f"{path}: by {motion.words} the robot never leaves a cell of {planning.resolution:g} m"
            "; take smaller cells (planning_resolution), or another source"
        )
    words = (
        f"{len(recording.pose_stamps)} visits of cells of {planning.resolution:g} m from "
        f"{len(motion.stamps)} poses: {motion.words}"
    )
    if intent:
        words += f"; intent from {intent} ({len(commands)} commands)"
    demonstration = RecordedDemonstration(
        recording=recording,
        grid_map=discretiser.grid_map,
        faults=reading.faults + discretiser.faults,
        warnings=(*reading.bag.warnings, *reading.warnings),
        damage=reading.bag.damage,
        opened=tuple(discretiser.opened),
        map_is_assumed=grid_map is None,
    )
    return demonstration, words


class _Reading:
    """A bag that is being read: what was wrong with its messages is counted here."""

    def __init__(self, bag: Bag, settings: Discretising) -> None:
        self.bag = bag
        self.faults: Counter[str] = Counter()
        self.warnings: list[str] = []
        self._settings = settings
        self._transforms: TransformBuffer | None = None
        self._clock = np.zeros((0, 2), dtype=np.int64)

    def last_map(self, topic: str) -> GridMap | None:
        """The last map on a topic that can be used."""
        found = None
        kinds = {each.type_name for each in self.bag.topics() if each.name == topic}
        if kinds and kinds != {TOPIC_TYPES["map"]}:
            self.warnings.append(
                f"{self.bag.path}: topic {topic} is of type {', '.join(kinds)}, not "
                f"{TOPIC_TYPES['map']}; name the right one with --remap map:=/topic"
            )
            return None
        for _, message in self._messages(topic, TOPIC_TYPES["map"]):
            try:
                found = map_of(message, f"{self.bag.path}, topic {topic}")
            except InputError as error:
                self.faults[str(error)] += 1
        return found

    def motion(self, frame_id: str) -> _Motion:
        """The motion that the wanted source tells, or the first one that can be used."""
        sources = motion_topics(self.bag.topics())
        if self._settings.source:
            wanted = absolute(self._settings.source)
            sources = [topic for topic in sources if topic.name == wanted]
        refusals = []
        for topic in sources:
            faults: Counter[str] = Counter()
            try:
                motion = self._motion_of(topic, frame_id, faults)
            except InputError as refusal:
                refusals.append(str(refusal))
            else:
                self.faults += faults
                self.warnings += [f"{self.bag.path}: {refusal}" for refusal in refusals]
                return motion
        if refusals:
            told = [refusal.removesuffix(_REMEDY) for refusal in refusals]
            remedy = _REMEDY if told != refusals else ""  # once is enough
            raise InputError(f"{self.bag.path}: {'; '.join(told)}{remedy}")
        there = ", ".join(f"{topic.name} ({topic.type_name})" for topic in self.bag.topics())
        raise InputError(
            f"{self.bag.path}: {self._settings.source or 'no topic'} tells no motion; there are "
            f"{there or 'no topics'}; name one of {', '.join(_KINDS)} with --source"
        )

    def commands(self, topic: str) -> Iterator[tuple[int, Command]]:
        """The velocity commands on a topic, each with its log time [ns]."""
        types = {each.name: each.type_name for each in self.bag.topics()}
        if types.get(topic) not in COMMAND_TYPES:
            raise InputError(
                f"{self.bag.path}: has no velocity commands ({' or '.join(COMMAND_TYPES)}) on "
                f"{topic}; name another topic with --intent, or none"
            )
        for log_time, message in self._messages(topic, types[topic]):
            yield log_time, command_of(message)

    def _motion_of(self, topic: Topic, frame_id: str, faults: Counter[str]) -> _Motion:
        """The motion that a topic tells.

        Raises:
            InputError: it tells none that can be used; the sentence names the topic.
        """
        if topic.type_name in COMMAND_TYPES:
            return self._followed(topic)
        told = self._told_by_tf() if topic.type_name == TF else self._told(topic)
        poses = np.full((len(told.stamps), 3), np.nan)
        moved_from = []
        for frame in dict.fromkeys(told.frames.tolist()):
            here = told.frames == frame
            matrices = self._tf().look_up(frame_id, frame, told.stamps[here])
            if matrices is None:
                where = f"frame {frame!r}, which tf does not join to {frame_id!r}"
                faults[f"pose of {topic.name} in {where}"] += int(np.count_nonzero(here))
                continue
            if frame != frame_name(frame_id):
                moved_from.append(frame)
            poses[here] = moved(matrices, told.points[here], told.headings[here])
            unknown = int(np.count_nonzero(np.isnan(matrices[:, 0, 0])))
            if unknown:
                faults[f"pose of {topic.name} at a time of which tf tells nothing"] += unknown
        lost = ~np.isfinite(told.points).all(axis=1) | ~np.isfinite(told.headings)
        if lost.any():
            faults["pose with a coordinate that is not finite"] += int(np.count_nonzero(lost))
        known = np.isfinite(poses).all(axis=1)
        if not known.any():
            reasons = ", ".join(f"{count} x {fault}" for fault, count in faults.items())
            fault = f"{topic.name} tells no pose that can be used ({reasons or 'it has none'})"
            raise InputError(fault + _REMEDY)
        words = f"{topic.name} ({topic.type_name})"
        if moved_from:
            words += f", brought from {' and '.join(moved_from)} to {frame_id} by tf"
        return _Motion(told.stamps[known], poses[known], told.arrivals[known], words)

    def _told(self, topic: Topic) -> _Told:
        arrivals, poses = [], []
        for log_time, message in self._messages(topic.name, topic.type_name):
            arrivals.append(log_time)
            poses.append(pose_of(message))
        return _Told(
            stamps=np.array([pose.stamp for pose in poses], dtype=np.int64),
            frames=np.array([pose.frame_id for pose in poses], dtype=np.object_),
            points=np.array([(*pose.position, 1.0) for pose in poses]).reshape(-1, 4),
            headings=np.array([pose.heading for pose in poses], dtype=np.float64),
            arrivals=np.array(arrivals, dtype=np.int64),
        )

    def _told_by_tf(self) -> _Told:
        """The robot's own frame, in which it is at the origin, whenever tf tells of it."""
        frame = frame_name(self._settings.base_frame)
        stamps = self._tf().stamps_of(frame)
        if not len(stamps):
            frames = ", ".join(self._tf().frames)
            raise InputError(
                f"tf does not tell how {frame!r} moves; name one of {frames} with --base-frame"
            )
        return _Told(
            stamps=stamps,
            frames=np.full(len(stamps), frame, dtype=np.object_),
            points=np.tile([0.0, 0.0, 0.0, 1.0], (len(stamps), 1)),
            headings=np.zeros(len(stamps)),
            arrivals=np.interp(stamps, *self._clock.T).astype(np.int64),
        )

    def _followed(self, topic: Topic) -> _Motion:
        """Where velocity commands alone lead."""
        if not self._settings.start:
            raise InputError(
                f"{topic.name} has velocity commands, which tell no place; give the pose from "
                "which they are followed with --start x,y,heading"
            )
        commands = []
        for log_time, message in self._messages(topic.name, topic.type_name):
            stamped = topic.type_name == COMMAND_TYPES[0]
            commands.append((stamp_of(message) if stamped else log_time, command_of(message)))
        settings = self._settings
        follower = CommandFollower(
            settings.start_pose, settings.command_hold, settings.longest_silence
        )
        poses = follow(sorted(commands, key=itemgetter(0)), follower)
        self.faults += follower.faults
        if not poses:
            raise InputError(f"{topic.name} has no velocity command that can be used")
        stamps = np.array([pose.stamp for pose in poses], dtype=np.int64)
        x, y, heading = settings.start_pose
        words = f"{topic.name} ({topic.type_name}), followed from ({x:g}, {y:g}), {heading:g} rad"
        return _Motion(stamps, np.array(poses)[:, 1:], stamps, words)

    def _tf(self) -> TransformBuffer:
        """All transforms of the bag."""
        if self._transforms is None:
            self._transforms = TransformBuffer()
            clock = []
            for topic in self.bag.topics():
                if topic.type_name == TF:
                    static = topic.name.endswith("tf_static")
                    for log_time, message in self._messages(topic.name, TF):
                        self._transforms.add(message, static)
                        clock += [
                            (stamp_of(each), log_time) for each in message.transforms if not static
                        ]
            self._clock = np.array(sorted(clock), dtype=np.int64).reshape(-1, 2)
            self.faults += self._transforms.faults
        return self._transforms

    def _messages(self, topic: str, type_name: str) -> Iterator[tuple[int, Any]]:
        """The messages on a topic, each with its log time [ns]; what cannot be read is counted."""
        for raw in self.bag.messages([topic]):
            try:
                yield raw.log_time, decode(type_name, raw.data)
            except InputError as error:
                self.faults[str(error)] += 1
