"""What `bnirl_ros` itself offers is there, and costs nothing until it is asked for."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys

import pytest

import bnirl_ros


@pytest.mark.parametrize("name", bnirl_ros.__all__)
def test_name_is_there(name: str) -> None:
    assert getattr(bnirl_ros, name).__name__ == name
    assert name in dir(bnirl_ros)


def test_type_checkers_are_told_the_same() -> None:
    tree = ast.parse(inspect.getsource(bnirl_ros))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    told = {
        alias.name: getattr(importlib.import_module(node.module or ""), alias.name)
        for node in imports
        if (node.module or "").startswith("bnirl_ros")
        for alias in node.names
    }
    assert told == {name: getattr(bnirl_ros, name) for name in bnirl_ros.__all__}


def test_other_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = bnirl_ros.nothing


def test_importing_the_package_loads_no_library() -> None:
    code = "import sys, bnirl_ros; print({'numba', 'numpy', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
