"""The house keeps its order: later rooms import earlier ones, and ROS stays in `nodes`."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "bnirl_ros"

# Rooms of one row see each other and those of all rows before; see docs/architecture.md.
ORDER = [
    {
        *("confinement", "errors", "kernel_cache", "limits", "resources", "safe_yaml"),
        *("terminal_text", "threads"),
    },
    {"mdp"},
    {"maps"},
    {"demonstrations"},
    {"model"},
    {"inference"},
    {"baselines"},
    {"bags"},
    {"views"},
    {"fleet", "journal"},
    {"experiments"},
    {"nodes"},
    {"cli"},
    {"fuzzing"},
]
ROW = {room: row for row, rooms in enumerate(ORDER) for room in rooms}

# The package's own __init__ may gather what earlier rooms offer; nodes and cli are none of it.
ROW["__init__"] = ROW["nodes"]

FOLDERS = sorted(path.parent for path in PACKAGE.rglob("__init__.py"))
MODULES = sorted(PACKAGE.rglob("*.py"))


def label(path: Path) -> str:
    """How a path is named in the tests' output."""
    return str(path.relative_to(PACKAGE.parent))


def room_of(path: Path) -> str:
    """The folder or module directly under the package to which a file belongs."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(path: Path) -> Iterator[tuple[str, bool]]:
    """The dotted names that a module imports, each with whether it does so when it is loaded."""
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    later = {
        id(inner)
        for outer in ast.walk(tree)
        if isinstance(outer, functions)
        for inner in ast.walk(outer)
    }
    package = [PACKAGE.name, *path.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) not in later
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, node.module] if node.module else base
            for alias in node.names:
                yield ".".join([*base, alias.name]), id(node) not in later


def is_ros(name: str) -> bool:
    """Whether the name belongs to a package of a ROS installation."""
    package = name.partition(".")[0]
    return package.startswith(
        ("ament_", "launch", "message_filters", "rcl", "rmw_", "ros2", "rosbag2", "rosidl_", "tf2")
    ) or package.endswith(("_msgs", "_srvs", "_interfaces"))


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_room_has_its_place(path: Path) -> None:
    assert room_of(path) in ROW


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_imports_only_from_earlier_rooms(path: Path) -> None:
    here = room_of(path)
    for name, _ in imports_of(path):
        package, _, rest = name.partition(".")
        there = rest.partition(".")[0]
        # A name that is no room is an attribute of the package itself, such as __version__.
        if package == PACKAGE.name and there in ROW and there != here:
            assert ROW[there] <= ROW[here], f"{label(path)} imports {name}"


@pytest.mark.parametrize("path", [m for m in MODULES if room_of(m) == "baselines"], ids=label)
def test_baselines_know_nothing_of_the_method(path: Path) -> None:
    rooms = {name.split(".")[1] for name, _ in imports_of(path) if name.startswith(PACKAGE.name)}
    assert rooms <= {"errors", "mdp", "demonstrations", "baselines"}


@pytest.mark.parametrize("path", [m for m in MODULES if room_of(m) != "nodes"], ids=label)
def test_only_nodes_import_ros(path: Path) -> None:
    for name, when_loaded in imports_of(path):
        assert not is_ros(name), f"{label(path)} imports {name}"
        # Nodes import ROS as soon as they are loaded, so loading them waits for the need.
        assert not (name.startswith("bnirl_ros.nodes") and when_loaded), (
            f"{label(path)} imports {name} outside of a function"
        )


@pytest.mark.parametrize("folder", FOLDERS, ids=label)
def test_folder_says_what_lives_there(folder: Path) -> None:
    tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
    assert ast.get_docstring(tree)


def test_every_folder_is_a_package() -> None:
    assert {path.parent for path in MODULES} == set(FOLDERS)
