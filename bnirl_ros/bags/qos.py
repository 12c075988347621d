"""Quality of service as bags record it, in the YAML of every rosbag2 version."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from bnirl_ros.errors import InputError
from bnirl_ros.safe_yaml import load_yaml

QOS_KEY, HASH_KEY = "offered_qos_profiles", "topic_type_hash"
"""Under which a channel's metadata have its publishers' QoS, and its type's hash."""

_HISTORIES = ("system_default", "keep_last", "keep_all", "unknown")
_RELIABILITIES = ("system_default", "reliable", "best_effort", "unknown", "best_available")
_DURABILITIES = ("system_default", "transient_local", "volatile", "unknown", "best_available")
_OVERRIDES = {
    "reliability": ("reliable", "best_effort"),
    "durability": ("volatile", "transient_local"),
    "history": ("keep_last", "keep_all"),
}
# What else rosbag2 takes there; nothing of ours has a deadline or a lifespan.
_NOT_OVERRIDDEN = (
    "deadline",
    "lifespan",
    "liveliness",
    "liveliness_lease_duration",
    "avoid_ros_namespace_conventions",
)


@dataclass(frozen=True)
class QosProfile:
    """What a publisher offers, in rosbag2's words.

    Attributes:
        reliability: reliable or best_effort.
        durability: volatile or transient_local.
        history: keep_last or keep_all.
        depth: number of messages kept, with keep_last.

    Bags also know `system_default`, `unknown` and `best_available` for the first three.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10

    def __str__(self) -> str:
        return f"{self.reliability} {self.durability} {self.history} {self.depth}"


RELIABLE = QosProfile(depth=40_000)
"""Loses nothing: deep enough for the bursts of a replay (see the topics' contract)."""

LATCHED = QosProfile(durability="transient_local", depth=1)
"""The last message is kept for subscribers that come later."""


def qos_to_yaml(profiles: Iterable[QosProfile]) -> str:
    """The YAML list that rosbag2 writes since its metadata version 9."""
    return "\n".join(_profile_to_yaml(profile) for profile in profiles)


def _profile_to_yaml(profile: QosProfile) -> str:
    # rosbag2's infinity is the largest number of nanoseconds in 64 bits.
    for_ever = "\n    sec: 9223372036\n    nsec: 854775807"
    return (
        f"- history: {profile.history}\n"
        f"  depth: {profile.depth}\n"
        f"  reliability: {profile.reliability}\n"
        f"  durability: {profile.durability}\n"
        f"  deadline:{for_ever}\n"
        f"  lifespan:{for_ever}\n"
        "  liveliness: automatic\n"
        f"  liveliness_lease_duration:{for_ever}\n"
        "  avoid_ros_namespace_conventions: false"
    )


@lru_cache(maxsize=256)
def qos_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """The profiles in a bag's YAML; policies are names or, up to metadata version 8, numbers.

    What is no list of profiles, as the empty text of early versions, gives no profiles: a bag's
    messages are worth more than its quality of service.
    """
    if not text.strip():
        return ()
    profiles = parse_yaml(text)
    if not isinstance(profiles, list):
        return ()
    return tuple(_profile(each) for each in profiles if isinstance(each, dict))


def read_overrides(path: Path) -> dict[str, dict[str, Any]]:
    """What a file of QoS overrides, as of `ros2 bag play`, says of each topic.

    Deadline, lifespan and liveliness are passed over.

    Raises:
        InputError: the file cannot be read, or says what cannot be.
    """
    try:
        values = parse_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError(
            f"{path}: the QoS overrides cannot be read ({fault}); check the path"
        ) from fault
    if not isinstance(values, dict):
        raise InputError(f"{path}: has no topics with QoS; write such as '/pose: {{depth: 10}}'")
    return {
        str(topic): _override(f"{path}: {topic}", policies) for topic, policies in values.items()
    }


def _override(place: str, policies: Any) -> dict[str, Any]:
    if not isinstance(policies, dict):
        raise InputError(f"{place}: has no QoS policies; write such as 'reliability: best_effort'")
    for name, value in policies.items():
        if name in _NOT_OVERRIDDEN:
            continue
        if name == "depth":
            if type(value) is not int or value < 1:
                raise InputError(f"{place}: depth must be a whole number above 0, not {value!r}")
        elif name not in _OVERRIDES:
            known = ", ".join([*_OVERRIDES, "depth", *_NOT_OVERRIDDEN])
            raise InputError(f"{place}: has no policy {name!r}; there are {known}")
        elif value not in _OVERRIDES[name]:
            raise InputError(
                f"{place}: {name} must be {' or '.join(_OVERRIDES[name])}, not {value!r}"
            )
    return {name: policies[name] for name in policies if name not in _NOT_OVERRIDDEN}


def parse_yaml(text: str) -> Any:
    """The value of a YAML text, or None where it is no YAML."""
    try:
        return load_yaml(text)
    except InputError:
        return None


def _profile(values: dict[str, Any]) -> QosProfile:
    depth = values.get("depth")
    return QosProfile(
        reliability=_policy(values.get("reliability"), _RELIABILITIES),
        durability=_policy(values.get("durability"), _DURABILITIES),
        history=_policy(values.get("history"), _HISTORIES),
        depth=depth if isinstance(depth, int) else 0,
    )


def _policy(value: object, names: tuple[str, ...]) -> str:
    if isinstance(value, int) and 0 <= value < len(names):
        return names[value]
    return value if isinstance(value, str) and value in names else "unknown"
