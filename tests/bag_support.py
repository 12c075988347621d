"""What the tests of bags share: where others' bags and definitions lie, and random messages."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from bnirl_ros.bags.definitions import typestore_with
from bnirl_ros.views.messages import MESSAGE_TYPES, Message

SHARED_BAGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "bags"

needs_shared_bags = pytest.mark.skipif(
    not SHARED_BAGS.is_dir(), reason="the bags of ../shared/data are not on this machine"
)


def ros_share(package: str) -> Path | None:
    """The share folder of an installed ROS package, where there is one."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    for prefix in filter(None, prefixes):
        share = Path(prefix) / "share" / package
        if (share / "package.xml").is_file():
            return share
    return None


needs_ros_definitions = pytest.mark.skipif(
    ros_share("nav_msgs") is None, reason="no ROS definitions are installed"
)

_INTEGERS = {
    f"{sign}int{bits}": st.integers(
        0 if sign else -(2 ** (bits - 1)), 2 ** (bits - (0 if sign else 1)) - 1
    )
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}
_VALUES: dict[str, st.SearchStrategy[object]] = {
    **_INTEGERS,
    "byte": st.integers(0, 127),  # rosbags takes it for signed; the levels are 0 to 3
    "bool": st.booleans(),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    # A string of ROS ends at its first NUL; CDR is UTF-8, which has no surrogates.
    "string": st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")),
}


def messages(type_name: str) -> st.SearchStrategy[Message]:
    """Random messages of a type: any value that its definition allows, but no NaN."""
    definition = typestore_with(type_name).fielddefs[type_name][1]
    return st.builds(
        MESSAGE_TYPES[type_name], **{name: _values(kind) for name, kind in definition}
    )


def _values(kind: tuple[Nodetype, object]) -> st.SearchStrategy[object]:
    node, detail = kind
    if node == Nodetype.NAME:
        return messages(detail)
    if node == Nodetype.BASE:
        return _VALUES[detail[0]]
    (inner, inner_detail), length = detail
    if inner == Nodetype.NAME:
        return st.lists(messages(inner_detail), max_size=3)
    fixed = length if node == Nodetype.ARRAY else 0
    numbers = st.lists(_VALUES[inner_detail[0]], min_size=fixed, max_size=fixed or 20)
    return numbers.map(lambda values: np.array(values, dtype=inner_detail[0]))


def same(mine: object, theirs: object) -> bool:
    """Whether a message of ours holds what another library's message holds."""
    if isinstance(mine, Message):
        return all(same(value, getattr(theirs, name)) for name, value in vars(mine).items())
    if isinstance(mine, np.ndarray):
        return np.array_equal(mine, np.asarray(theirs))
    if isinstance(mine, list):
        return len(mine) == len(theirs) and all(map(same, mine, theirs))
    if isinstance(theirs, bytes):  # the type `byte` in rclpy
        return bytes([mine]) == theirs
    return mine == theirs
