"""Transforms are looked up as tf2 would: over any chain, between stamps, and not beyond them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bnirl_ros.demonstrations.frames import TransformBuffer
from bnirl_ros.views.messages import (
    Header,
    Quaternion,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Vector3,
)

SECOND = 1_000_000_000


def transform(
    parent: str, child: str, time: float, x: float, y: float, yaw: float, sign: float = 1.0
) -> TFMessage:
    """Where a frame is in another one, as a message; both signs mean the same turn."""
    half = yaw / 2
    return TFMessage(
        [
            TransformStamped(
                Header(Time(*divmod(round(time * SECOND), SECOND)), parent),
                child,
                Transform(
                    Vector3(x, y), Quaternion(z=sign * math.sin(half), w=sign * math.cos(half))
                ),
            )
        ]
    )


def buffer_of(*moving: TFMessage, static: tuple[TFMessage, ...] = ()) -> TransformBuffer:
    buffer = TransformBuffer()
    for message in static:
        buffer.add(message, static=True)
    for message in moving:
        buffer.add(message, static=False)
    return buffer


def planar(x: float, y: float, yaw: float) -> npt.NDArray[np.float64]:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


def stamps(*times: float) -> npt.NDArray[np.int64]:
    return np.array([round(time * SECOND) for time in times], dtype=np.int64)


numbers = st.floats(-20, 20)
poses = st.tuples(numbers, numbers, st.floats(-3, 3))


@given(poses, poses, poses)
@settings(max_examples=30)
def test_a_chain_is_joined_in_both_directions(
    first: tuple[float, float, float],
    second: tuple[float, float, float],
    third: tuple[float, float, float],
) -> None:
    buffer = buffer_of(
        transform("map", "odom", 5.0, *first),
        transform("odom", "base_link", 5.0, *second),
        static=(transform("base_link", "laser", 0.0, *third),),
    )
    expected = planar(*first) @ planar(*second) @ planar(*third)
    found = buffer.look_up("map", "/laser", stamps(5.0))
    assert found is not None
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    back = buffer.look_up("laser", "map", stamps(5.0))
    assert back is not None
    np.testing.assert_allclose(back[0] @ found[0], np.eye(4), atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_transforms_are_interpolated_and_turn_the_short_way(sign: float) -> None:
    epoch = 1_700_000_000.0
    buffer = buffer_of(
        transform("odom", "base_link", epoch + 2.0, 3.0, 0.0, -3.1, sign),
        transform("odom", "base_link", epoch, 1.0, 0.0, 3.1),
    )
    found = buffer.look_up("odom", "base_link", stamps(epoch + 0.5, epoch, epoch + 2.0))
    assert found is not None
    np.testing.assert_allclose(found[1], planar(1.0, 0.0, 3.1), atol=1e-6)
    np.testing.assert_allclose(found[2], planar(3.0, 0.0, -3.1), atol=1e-6)
    yaw = math.atan2(found[0, 1, 0], found[0, 0, 0])
    assert yaw == pytest.approx(3.1 + (2 * math.pi - 6.2) / 4, abs=1e-6)
    assert found[0, 0, 3] == pytest.approx(1.5, abs=0.01)


def test_nothing_is_told_beyond_the_stamps_and_of_frames_apart() -> None:
    buffer = buffer_of(
        transform("odom", "base_link", 1.0, 1.0, 0.0, 0.0),
        transform("odom", "base_link", 2.0, 2.0, 0.0, 0.0),
        transform("sea", "boat", 1.0, 0.0, 0.0, 0.0),
    )
    found = buffer.look_up("odom", "base_link", stamps(0.9, 1.0, 1.5, 2.0, 2.1))
    assert found is not None
    assert np.isnan(found[:, 0, 0]).tolist() == [True, False, False, False, True]
    assert buffer.look_up("map", "base_link", stamps(1.0)) is None
    assert buffer.look_up("odom", "boat", stamps(1.0)) is None
    itself = buffer.look_up("moon", "moon", stamps(1.0, 9.0))
    assert itself is not None
    assert itself.shape == (2, 4, 4)
    assert buffer.frames == ["base_link", "boat", "odom", "sea"]
    assert TransformBuffer().look_up("map", "odom", stamps(1.0)) is None


def test_a_frames_stamps_are_those_of_what_moves_it() -> None:
    buffer = buffer_of(
        transform("odom", "base_link", 2.0, 1.0, 0.0, 0.0),
        transform("odom", "base_link", 1.0, 1.0, 0.0, 0.0),
        transform("odom", "base_link", 1.0, 1.0, 0.0, 0.0),
        transform("map", "odom", 7.0, 1.0, 0.0, 0.0),
        static=(transform("base_link", "footprint", 0.0, 0.0, 0.0, 0.0),),
    )
    assert buffer.stamps_of("footprint").tolist() == stamps(1.0, 2.0).tolist()
    assert buffer.stamps_of("map").tolist() == []


def test_what_is_no_transform_is_counted() -> None:
    buffer = buffer_of(
        transform("odom", "base_link", 1.0, math.nan, 0.0, 0.0),
        transform("odom", "odom", 1.0, 0.0, 0.0, 0.0),
        transform("odom", "base_link", 1.0, 0.0, 0.0, 0.0, sign=0.0),
    )
    assert buffer.faults == {"transform that is none": 3}
    assert buffer.frames == []
