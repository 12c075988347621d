"""CDR bytes: there and back, the same as rclpy's, and never a surprise from bad ones."""

import importlib
import random
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bag_support import messages, same
from bnirl_ros.bags.cdr import decode, encode
from bnirl_ros.bags.definitions import known_types
from bnirl_ros.errors import InputError
from bnirl_ros.views.messages import (
    ColorRGBA,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    KeyValue,
    Marker,
    MarkerArray,
    Message,
    OccupancyGrid,
    Path,
    Point,
    PoseStamped,
    Time,
)

EXAMPLES: list[Message] = [
    MarkerArray([Marker(ns="a", points=[Point()] * 3, colors=[ColorRGBA()]), Marker(text="wp_1")]),
    OccupancyGrid(data=np.zeros(9, dtype=np.int8)),
    DiagnosticArray(status=[DiagnosticStatus(values=[KeyValue("sweeps", "1000")])]),
    Path(poses=[PoseStamped(), PoseStamped()]),
]


@pytest.mark.parametrize("name", known_types())
@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_decoding_undoes_encoding(name: str, data: st.DataObject) -> None:
    message = data.draw(messages(name))
    assert same(message, decode(name, encode(message)))


@pytest.mark.parametrize("name", known_types())
@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_rclpy_reads_our_bytes_and_we_read_its(name: str, data: st.DataObject) -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    serialization = importlib.import_module("rclpy.serialization")
    package, _, short = name.split("/")
    theirs = getattr(pytest.importorskip(f"{package}.msg"), short)
    message = data.draw(messages(name))
    encoded = encode(message)
    understood = serialization.deserialize_message(encoded, theirs)
    assert same(message, understood)
    assert same(message, decode(name, serialization.serialize_message(understood)))


def test_both_byte_orders_are_read() -> None:
    big = b"\0\0\0\0" + (7).to_bytes(4, "big") + (9).to_bytes(4, "big")
    assert same(Time(7, 9), decode("builtin_interfaces/msg/Time", big))


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_damaged_bytes_raise_input_error_only(message: Message) -> None:
    encoded = encode(message)
    generator = random.Random(0)
    for _ in range(2000):
        damaged = bytearray(encoded[: generator.randrange(len(encoded)) + 1])
        for _ in range(generator.randrange(4)):
            damaged[generator.randrange(len(damaged))] = generator.choice([0, 1, 127, 255])
        try:
            decode(message.TYPE, bytes(damaged))
        except InputError as fault:
            assert f"no {message.TYPE} in CDR" in str(fault)  # noqa: PT017


@pytest.mark.parametrize(
    "message",
    [
        Header(frame_id=None),
        Time(sec=2**31),
        Time(sec="now"),
        OccupancyGrid(data=[0, 1]),
        OccupancyGrid(data=np.zeros(4)),
    ],
    ids=repr,
)
def test_fields_of_a_wrong_type_are_named_as_such(message: Message) -> None:
    with pytest.raises(ValueError, match=f"This {message.TYPE} cannot be encoded"):
        encode(message)


def test_a_million_cells_take_milliseconds() -> None:
    grid = OccupancyGrid(data=np.full(1_000_000, -1, dtype=np.int8))
    encode(OccupancyGrid())  # the codec is made on first use
    begin = time.perf_counter()
    assert same(grid, decode(grid.TYPE, encode(grid)))
    assert time.perf_counter() - begin < 0.5
