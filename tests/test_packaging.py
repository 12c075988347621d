"""What pip, colcon and rosdep are told of the package is complete, and they are told the same."""

from __future__ import annotations

import ast
import importlib
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import bnirl_ros

ROOT = Path(__file__).resolve().parent.parent

# The rosdep key of each requirement of setup.py; None for one that rosdep does not know.
ROSDEP_KEYS = {
    "lz4": None,
    "matplotlib": "python3-matplotlib",
    "mcap": None,
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pillow": "python3-pil",
    "pytransform3d": None,
    "pyyaml": "python3-yaml",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "zstandard": None,
}

# Requirements that are imported under another name; llvmlite is numba's own compiler.
REQUIREMENT_OF_MODULE = {"PIL": "pillow", "llvmlite": "numba", "yaml": "pyyaml"}

# Packages of a ROS installation that are no messages, by the name under which they are imported.
ROS_MODULES = {"ament_index_python", "launch", "launch_ros", "rclpy"}


@pytest.fixture
def package_xml() -> ElementTree.Element:
    """The root element of package.xml."""
    return ElementTree.parse(ROOT / "package.xml").getroot()


def texts(element: ElementTree.Element, tag: str) -> set[str]:
    """The texts of an element's children called `tag`."""
    return {child.text or "" for child in element.findall(tag)}


def names(requirements: list[str]) -> set[str]:
    """The names of the required packages, without their versions."""
    return {re.split(r"[^A-Za-z0-9._-]", requirement)[0].lower() for requirement in requirements}


def imported_packages(folder: Path) -> Iterator[str]:
    """The packages that the modules in `folder` import, anywhere in them."""
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules = [node.module or ""]
            else:
                continue
            yield from (module.partition(".")[0] for module in modules)


def is_ros(package: str) -> bool:
    """Whether a package belongs to a ROS installation."""
    return package in ROS_MODULES or package.endswith(("_msgs", "_srvs", "_interfaces"))


def test_package_xml_is_an_ament_python_package(package_xml: ElementTree.Element) -> None:
    assert package_xml.get("format") == "3"
    assert package_xml.findtext("name") == "bnirl_ros"
    assert package_xml.findtext("license") == "Apache-2.0"
    assert package_xml.findtext("export/build_type") == "ament_python"


def test_package_xml_declares_the_requirements_of_setup_py(
    setup_arguments: dict[str, Any], package_xml: ElementTree.Element
) -> None:
    required = names(setup_arguments["install_requires"])
    assert required == set(ROSDEP_KEYS)
    declared = {key for key in texts(package_xml, "exec_depend") if key.startswith("python3-")}
    assert declared == {key for key in ROSDEP_KEYS.values() if key}


def test_readme_names_the_requirements_that_rosdep_does_not_know(
    setup_arguments: dict[str, Any],
) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = [line for line in readme.splitlines() if line.startswith("pip install --user")]
    unknown = {name for name, key in ROSDEP_KEYS.items() if key is None}
    wanted = {r for r in setup_arguments["install_requires"] if names([r]) <= unknown}
    assert {name for line in lines for name in re.findall(r"'([^']+)'", line)} == wanted


def test_package_xml_declares_the_ros_packages_that_are_imported(
    package_xml: ElementTree.Element,
) -> None:
    imported = {*imported_packages(ROOT / "bnirl_ros"), *imported_packages(ROOT / "launch")}
    assert set(filter(is_ros, imported)) <= texts(package_xml, "exec_depend")


def test_setup_py_requires_what_is_imported(setup_arguments: dict[str, Any]) -> None:
    imported = {
        REQUIREMENT_OF_MODULE.get(package, package)
        for package in imported_packages(ROOT / "bnirl_ros")
        if package not in {*sys.stdlib_module_names, "bnirl_ros"} and not is_ros(package)
    }
    required = names(setup_arguments["install_requires"])
    extras = setup_arguments["extras_require"]
    wanted = (names(extras[name]) for name in ("campaigns", "dask", "paper"))
    assert imported == required.union(*wanted)


def test_there_is_one_version(
    setup_arguments: dict[str, Any], package_xml: ElementTree.Element
) -> None:
    assert setup_arguments["version"] == bnirl_ros.__version__
    assert package_xml.findtext("version") == bnirl_ros.__version__


@pytest.mark.parametrize(
    "name", ["bnirl", "discretiser_node", "record_node", "replay_node", "subgoal_node"]
)
def test_executables_start_at_a_function(name: str, setup_arguments: dict[str, Any]) -> None:
    scripts = setup_arguments["entry_points"]["console_scripts"]
    place = dict(re.split(r"\s*=\s*", script) for script in scripts)[name]
    module, _, function = place.partition(":")
    if module.startswith("bnirl_ros.nodes"):
        pytest.importorskip("rclpy")
    assert callable(getattr(importlib.import_module(module), function))


def test_all_packages_are_installed(setup_arguments: dict[str, Any]) -> None:
    folders = {path.parent for path in (ROOT / "bnirl_ros").rglob("*.py")}
    assert set(setup_arguments["packages"]) == {
        ".".join(folder.relative_to(ROOT).parts) for folder in folders
    }


def test_files_beside_the_modules_are_installed(setup_arguments: dict[str, Any]) -> None:
    beside = {
        path
        for path in (ROOT / "bnirl_ros").rglob("*.*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }
    assert beside
    assert beside == {
        path
        for package, patterns in setup_arguments["package_data"].items()
        for pattern in patterns
        for path in ROOT.joinpath(*package.split(".")).glob(pattern)
    }


def test_all_shared_files_are_installed(setup_arguments: dict[str, Any]) -> None:
    installed = {
        Path(folder, Path(file).name): ROOT / file
        for folder, files in setup_arguments["data_files"]
        for file in files
    }
    share = Path("share/bnirl_ros")
    expected = {
        Path("share/ament_index/resource_index/packages/bnirl_ros"): ROOT / "resource/bnirl_ros",
        share / "package.xml": ROOT / "package.xml",
    }
    for name in ("launch", "config", "rviz", "foxglove", "bags", "msg_schemas", "policies"):
        for path in (ROOT / name).rglob("*"):
            if path.is_file() and path.suffix != ".pyc":
                expected[share / path.relative_to(ROOT)] = path
    assert installed == expected
    assert all(path.is_file() for path in installed.values())
