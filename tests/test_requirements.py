"""The lock of the packages that `make test` runs with is complete, and of nothing else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
LOCKS = sorted((ROOT / "requirements").iterdir())
ENTRY = re.compile(r"([\w.-]+)==([\w.!+]+)((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n")


def pinned(lock: Path) -> dict[str, Version]:
    """The versions by package."""
    return {
        canonicalize_name(name): Version(version)
        for name, version, _ in ENTRY.findall(lock.read_text())
    }


@pytest.mark.parametrize("lock", LOCKS, ids=lambda lock: lock.name)
def test_a_lock_has_versions_with_hashes_and_no_place(lock: Path) -> None:
    comment, _, rest = lock.read_text().partition("\n")
    assert comment.startswith("# ")
    assert ENTRY.sub("", rest) == ""
    assert pinned(lock)


@pytest.mark.parametrize("version", ["3.11", "3.12"])
def test_all_that_is_required_is_in_the_lock(
    setup_arguments: dict[str, Any], version: str
) -> None:
    versions = pinned(ROOT / "requirements" / f"python{version}.txt")
    venv = (ROOT / "scripts" / "venv").read_text()
    (extras,) = set(re.findall(r"--editable '\.\[([\w,]+)\]'", venv))
    required = list(setup_arguments["install_requires"])
    for extra in extras.split(","):
        required += setup_arguments["extras_require"][extra]
    for each in map(Requirement, required):
        assert versions[canonicalize_name(each.name)] in each.specifier, each
    numpy = Requirement(f"numpy{'<2' if version == '3.11' else '>=2'}")
    assert versions["numpy"] in numpy.specifier


def test_what_builds_is_one_version() -> None:
    first, *others = (pinned(lock)["setuptools"] for lock in LOCKS)
    assert set(others) == {first}
