"""From a view's dataclass to the rclpy message with the same fields."""

from __future__ import annotations

from array import array
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from bnirl_ros.views.messages import Message


@cache
def message_class(type_name: str) -> Any:
    """The rclpy class of a message type such as "geometry_msgs/msg/Pose".

    Raises:
        ImportError: its package isn't installed, or has no such message.
    """
    package, kind, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.{kind}"), name)
    except AttributeError as error:
        raise ImportError(f"{package} has no message {name}") from error


def is_installed(type_name: str) -> bool:
    """Whether there is an rclpy class of a message type."""
    try:
        message_class(type_name)
    except (ImportError, ValueError):
        return False
    return True


def to_ros(view: Message) -> Any:
    """The rclpy message that says what a view says."""
    message = message_class(view.TYPE)()
    for field in fields(view):  # type: ignore[arg-type]
        setattr(message, field.name, _value(getattr(view, field.name), message, field.name))
    return message


def _value(value: Any, message: Any, name: str) -> Any:
    if is_dataclass(value):
        return to_ros(value)  # type: ignore[arg-type]
    if isinstance(value, np.ndarray):
        # rclpy looks at every element of anything but an array of the right type.
        kind = getattr(message, name)
        return array(kind.typecode, value.tobytes()) if isinstance(kind, array) else value.tolist()
    if isinstance(value, list | tuple):
        return [to_ros(item) if is_dataclass(item) else item for item in value]  # type: ignore[arg-type]
    if isinstance(getattr(message, name), bytes):
        return bytes([value])  # the type `byte`, as of a diagnostic level
    return value
