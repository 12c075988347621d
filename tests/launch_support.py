"""A launch file evaluated without ROS: which nodes it starts, and how, for which arguments.

ROS's `launch` and `launch_ros` come with a ROS installation only. What stands in for them here has
the names and parameters of Jazzy's, does with them what those do, and has nothing but what our
launch file needs: any other name or parameter is refused.
"""

from __future__ import annotations

import runpy
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Union

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent

Arguments = Mapping[str, str]
"""Value of each launch argument so far."""

Text = Union[str, "Substitution", Iterable["Text"]]
"""What `launch` takes for a text; several are put together."""


class Substitution(ABC):
    """A text that depends on the launch arguments."""

    @abstractmethod
    def perform(self, given: Arguments) -> str: ...


def text(value: Text, given: Arguments) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, Substitution):
        return value.perform(given)
    return "".join(text(part, given) for part in value)


def truth(value: Text, given: Arguments) -> bool:
    word = text(value, given).lower()
    if word not in ("true", "1", "false", "0"):
        raise ValueError(f"neither true nor false: {word!r}")
    return word in ("true", "1")


def word(value: bool) -> str:
    return str(value).lower()


@dataclass
class LaunchConfiguration(Substitution):
    variable_name: str

    def perform(self, given: Arguments) -> str:
        if self.variable_name not in given:
            raise LookupError(f"launch argument {self.variable_name} is not declared before")
        return given[self.variable_name]


@dataclass
class NotEqualsSubstitution(Substitution):
    left: Text
    right: Text

    def perform(self, given: Arguments) -> str:
        return word(text(self.left, given) != text(self.right, given))


@dataclass
class NotSubstitution(Substitution):
    value: Text

    def perform(self, given: Arguments) -> str:
        return word(not truth(self.value, given))


@dataclass
class AndSubstitution(Substitution):
    left: Text
    right: Text

    def perform(self, given: Arguments) -> str:
        return word(truth(self.left, given) and truth(self.right, given))


@dataclass
class IfElseSubstitution(Substitution):
    condition: Text
    if_value: Text = ""
    else_value: Text = ""

    def perform(self, given: Arguments) -> str:
        return text(self.if_value if truth(self.condition, given) else self.else_value, given)


@dataclass
class PathJoinSubstitution(Substitution):
    substitutions: Sequence[str | Substitution]

    def perform(self, given: Arguments) -> str:
        return str(Path(*(text(part, given) for part in self.substitutions)))


@dataclass
class FindPackageShare(Substitution):
    package: str

    def perform(self, _: Arguments) -> str:
        if self.package != "bnirl_ros":
            raise LookupError(f"there is no package {self.package} in a source tree of bnirl_ros")
        return str(ROOT)


@dataclass
class IfCondition:
    predicate_expression: Text


class DeclareLaunchArgument:
    def __init__(
        self,
        name: str,
        *,
        default_value: Text | None = None,
        description: str | None = None,
        choices: Sequence[str] | None = None,
    ) -> None:
        self.name = name
        self.default_value = default_value
        self.description = description
        self.choices = choices


@dataclass(kw_only=True)
class Node:
    executable: str
    package: str | None = None
    namespace: Text | None = None
    output: str = "log"
    parameters: Sequence[Text | Mapping[str, Any]] | None = None
    remappings: Sequence[tuple[Text, Text]] | None = None
    arguments: Sequence[Text] | None = None
    condition: IfCondition | None = None


@dataclass
class LaunchDescription:
    initial_entities: Sequence[DeclareLaunchArgument | Node]


MODULES: dict[str, Sequence[type]] = {
    "launch": (LaunchDescription,),
    "launch.actions": (DeclareLaunchArgument,),
    "launch.conditions": (IfCondition,),
    "launch.substitutions": [
        kind for kind in Substitution.__subclasses__() if kind is not FindPackageShare
    ],
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.substitutions": (FindPackageShare,),
}


@dataclass(frozen=True)
class Started:
    """A node that is started, with what it is given; a later remapping of a name is void."""

    package: str | None
    executable: str
    namespace: str
    arguments: list[str]
    parameter_files: list[Path]
    parameters: dict[str, Any]
    remappings: list[tuple[str, str]]


def described(path: Path) -> LaunchDescription:
    """What a launch file describes."""
    with pytest.MonkeyPatch.context() as patch:
        for name, members in MODULES.items():
            module = ModuleType(name)
            module.__dict__.update({member.__name__: member for member in members})
            patch.setitem(sys.modules, name, module)
        description: LaunchDescription = runpy.run_path(str(path))["generate_launch_description"]()
    return description


def declared(path: Path) -> list[DeclareLaunchArgument]:
    """The arguments of a launch file, in their order."""
    entities = described(path).initial_entities
    return [each for each in entities if isinstance(each, DeclareLaunchArgument)]


def started(path: Path, given: Arguments) -> list[Started]:
    """The nodes that a launch file starts for these arguments, in their order."""
    values: dict[str, str] = dict(given)
    nodes = []
    for entity in described(path).initial_entities:
        if isinstance(entity, DeclareLaunchArgument):
            _declare(entity, values)
        elif entity.condition is None or truth(entity.condition.predicate_expression, values):
            nodes.append(_start(entity, values))
    return nodes


def _declare(argument: DeclareLaunchArgument, values: dict[str, str]) -> None:
    if argument.name not in values:
        if argument.default_value is None:
            raise LookupError(f"launch argument {argument.name} was not given")
        values[argument.name] = text(argument.default_value, values)
    if argument.choices is not None and values[argument.name] not in argument.choices:
        raise ValueError(f"{argument.name} must be one of {argument.choices}")


def _start(node: Node, values: Arguments) -> Started:
    files, parameters = [], {}
    for each in node.parameters or ():
        if isinstance(each, Mapping):  # values are read as YAML
            parameters |= {name: yaml.safe_load(text(v, values)) for name, v in each.items()}
        else:
            files.append(Path(text(each, values)))
    return Started(
        package=node.package,
        executable=node.executable,
        namespace=text(node.namespace or "", values),
        arguments=[text(each, values) for each in node.arguments or ()],
        parameter_files=files,
        parameters=parameters,
        remappings=[(text(old, values), text(new, values)) for old, new in node.remappings or ()],
    )
