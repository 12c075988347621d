"""The dataclasses are the ROS messages: the same fields, order, defaults and constants."""

import dataclasses
from typing import ClassVar

import numpy as np
import pytest

from bag_support import same
from bnirl_ros.bags.definitions import known_types, typestore_with
from bnirl_ros.views.messages import (
    MESSAGE_TYPES,
    ColorRGBA,
    DiagnosticStatus,
    Marker,
    Message,
    OccupancyGrid,
    Point,
    Pose,
)

TYPES = sorted(MESSAGE_TYPES)


def field_names(kind: type[Message]) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


def constants(kind: type[Message]) -> dict[str, object]:
    return {name: value for name, value in vars(kind).items() if name.isupper() and name != "TYPE"}


def ros_class(type_name: str) -> type:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    package, _, name = type_name.split("/")
    return getattr(pytest.importorskip(f"{package}.msg"), name)


def test_every_definition_has_its_dataclass() -> None:
    assert list(known_types()) == TYPES


@pytest.mark.parametrize("name", TYPES)
def test_fields_and_constants_are_those_of_the_definition(name: str) -> None:
    fixed, fields = typestore_with(name).fielddefs[name]
    assert field_names(MESSAGE_TYPES[name]) == [field for field, _ in fields]
    assert constants(MESSAGE_TYPES[name]) == {constant: value for constant, _, value in fixed}


@pytest.mark.parametrize("name", TYPES)
def test_fields_and_defaults_are_those_of_the_installed_ros(name: str) -> None:
    theirs = ros_class(name)
    assert field_names(MESSAGE_TYPES[name]) == list(theirs.get_fields_and_field_types())
    assert same(MESSAGE_TYPES[name](), theirs())


@pytest.mark.parametrize("kind", [Marker, DiagnosticStatus])
def test_constants_are_those_of_the_installed_ros(kind: type[Message]) -> None:
    theirs = ros_class(kind.TYPE)
    for name, value in constants(kind).items():
        assert same(value, getattr(theirs, name)), name


def test_messages_are_compared_by_value() -> None:
    grid = OccupancyGrid(data=np.arange(4, dtype=np.int8))
    assert grid == OccupancyGrid(data=np.arange(4, dtype=np.int8))
    assert grid != OccupancyGrid(data=np.zeros(4, dtype=np.int8))
    assert Marker(points=[Point(1.0)]) == Marker(points=[Point(1.0)])
    assert Point() != ColorRGBA()
    assert Pose() != None  # noqa: E711


def test_messages_do_not_share_their_parts() -> None:
    first, second = Marker(), Marker()
    first.points.append(Point())
    first.pose.position.x = 1.0
    assert second == Marker()


def test_types_are_class_attributes() -> None:
    assert Message.__annotations__["TYPE"] in (ClassVar[str], "ClassVar[str]")
    with pytest.raises(TypeError):
        hash(Point())
