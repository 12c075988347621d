"""Parameters of a node, declared from tables: type, default, range, description, changeable."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, fields, replace
from enum import Enum
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from bnirl_ros.errors import InputError
from bnirl_ros.inference.settings import Settings
from bnirl_ros.limits import Limits, limits_of

INFERRED = -1.0
"""Value of a parameter of the model that is not given: ROS has none for nothing."""


class Changeable(Enum):
    """When a parameter can be changed, in words for the reference."""

    NEVER = "at the start only"
    UNCONFIGURED = "while unconfigured"
    ALWAYS = "at any time"


@dataclass(frozen=True)
class NodeParameter:
    """A parameter of a node.

    Attributes:
        name: its name.
        default: its value where none is given; also fixes its type.
        limits: description and range.
        changeable: when it can be changed; most are taken when the node is configured.
        names_file: whether it names a file or folder; the empty text names none. What it is
            changed to while the node runs, which anybody on the network can do, stays inside one
            folder.
    """

    name: str
    default: Any
    limits: Limits
    changeable: Changeable = Changeable.UNCONFIGURED
    names_file: bool = False


def parameter_of(setting: Field[Any], changeable: Changeable = Changeable.ALWAYS) -> NodeParameter:
    """A parameter for a setting; one of the model that may be inferred has a value for that."""
    limits = limits_of(setting)
    if setting.default is not None:
        return NodeParameter(setting.name, setting.default, limits, changeable)
    described = f"{limits.description}; {INFERRED:g}: not given"
    limits = replace(limits, description=described, lowest=INFERRED, above=-math.inf)
    return NodeParameter(setting.name, INFERRED, limits, changeable)


def declare(node: Node, table: Sequence[NodeParameter]) -> dict[str, Any]:
    """Declare parameters with type, range and description; returns their values by name.

    Raises:
        InputError: a value that was given is of another type or out of its range.
    """
    return {entry.name: _declared(node, entry) for entry in table}


def declare_settings(node: Node, on_change: Callable[[Settings], None]) -> Settings:
    """Declare every setting of the inference; each can be changed while the node runs.

    A change that gives no valid settings is refused with the reason, and nothing is changed.

    Args:
        node: the node.
        on_change: called with the new settings after every change.

    Raises:
        InputError: as in `declare`.
    """
    table = [parameter_of(setting) for setting in fields(Settings)]
    names = {entry.name for entry in table}
    inferable = {setting.name for setting in fields(Settings) if setting.default is None}

    def settings_of(values: Mapping[str, Any]) -> Settings:
        given: dict[str, Any] = {
            name: None if name in inferable and value == INFERRED else value
            for name, value in values.items()
        }
        return Settings(**given)

    settings = settings_of(declare(node, table))

    def changed(parameters: Sequence[Parameter]) -> Settings:
        values = {entry.name: node.get_parameter(entry.name).value for entry in table}
        values.update({p.name: p.value for p in parameters if p.name in names})
        return settings_of(values)

    def check(parameters: Sequence[Parameter]) -> SetParametersResult:
        try:
            changed(parameters)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def apply(parameters: Sequence[Parameter]) -> None:
        if any(parameter.name in names for parameter in parameters):
            on_change(changed([]))

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(apply)
    return settings


def _declared(node: Node, entry: NodeParameter) -> Any:
    try:
        value = node.declare_parameter(entry.name, entry.default, _descriptor(entry)).value
    except InvalidParameterTypeException as error:
        raise InputError(
            f"parameter {entry.name}: must be of type {type(entry.default).__name__}, such as "
            f"{entry.default!r}"
        ) from error
    except InvalidParameterValueException as error:
        raise InputError(
            f"parameter {entry.name}: must be {entry.limits.range_in_words()}"
        ) from error
    fault = entry.limits.fault(entry.name, value)
    if fault:
        raise InputError(f"parameter {fault}")
    return value


def _descriptor(entry: NodeParameter) -> ParameterDescriptor:
    limits = entry.limits
    descriptor = ParameterDescriptor(
        description=limits.description,
        additional_constraints=(
            f"one of {', '.join(map(str, limits.choices))}"
            if limits.choices
            else limits.range_in_words()
        ),
        read_only=entry.changeable is Changeable.NEVER,
    )
    lowest, highest = max(limits.lowest, limits.above), min(limits.highest, limits.below)
    if isinstance(entry.default, float) and math.isfinite(max(lowest, -highest)):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=max(lowest, -_LARGEST_FLOAT), to_value=min(highest, _LARGEST_FLOAT)
            )
        ]
    elif isinstance(entry.default, int) and math.isfinite(max(lowest, -highest)):
        descriptor.integer_range = [
            IntegerRange(
                from_value=int(max(lowest, -_LARGEST_INTEGER)),
                to_value=int(min(highest, _LARGEST_INTEGER)),
                step=1,
            )
        ]
    return descriptor


_LARGEST_FLOAT = 1.7976931348623157e308
_LARGEST_INTEGER = 2**63 - 1
