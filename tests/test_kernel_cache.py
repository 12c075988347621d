"""Compiled kernels find a place, wherever the package lies."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bnirl_ros
from bnirl_ros.kernel_cache import temporary_folder

PROGRAM = """
import numpy as np
from bnirl_ros.mdp.parts import connected_parts
assert connected_parts(np.ones((2, 2), dtype=bool)).sum() == 4
print(sum(connected_parts.stats.cache_hits.values()), connected_parts.stats.cache_path)
"""


@pytest.fixture
def read_only(tmp_path: Path) -> Path:
    """The parent of a package beside whose sources nothing can be kept, not even by root."""
    package = tmp_path / "site" / "bnirl_ros"
    shutil.copytree(
        Path(bnirl_ros.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    for folder in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()
    return package.parent


def run(site: Path, home: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    without = ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
    environment = {name: value for name, value in os.environ.items() if name not in without}
    environment |= {"PYTHONPATH": str(site), "HOME": str(home)} | variables
    return subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=site,  # which comes first on the path
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )


def test_where_the_package_cannot_be_written_to_the_users_cache_folder_is(
    read_only: Path, tmp_path: Path
) -> None:
    first, second = (run(read_only, tmp_path / "home") for _ in range(2))
    assert [first.stderr, second.stderr] == ["", ""]
    hits, place = second.stdout.split()
    assert (first.stdout.split()[0], hits) == ("0", "1")
    assert Path(place).is_relative_to(tmp_path / "home" / ".cache" / "numba")


def test_where_nothing_can_be_written_to_kernels_are_kept_with_temporary_files_and_it_is_told(
    read_only: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    first, second = (
        run(read_only, tmp_path / "file" / "home", TMPDIR=str(tmp_path)) for _ in "12"
    )
    hits, place = second.stdout.split()
    assert (first.stdout.split()[0], hits) == ("0", "1")
    assert Path(place).parent == tmp_path / f"bnirl_ros-{os.getuid()}"
    for told in (first.stderr, second.stderr):
        assert "set NUMBA_CACHE_DIR to a folder that lasts" in told
        assert "Traceback" not in told


@pytest.mark.parametrize("elsewhere", [False, True])
def test_kernels_are_forgotten_when_any_source_has_changed(
    tmp_path: Path, elsewhere: bool
) -> None:
    """numba looks at a kernel's own file only; what it calls may be in another one."""
    site = tmp_path / "site"
    source = Path(bnirl_ros.__file__).parent
    shutil.copytree(source, site / "bnirl_ros", ignore=shutil.ignore_patterns("__pycache__"))
    variables = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")} if elsewhere else {}

    def hits() -> str:
        done = run(site, tmp_path / "home", **variables)
        assert done.stderr == ""
        return done.stdout.split()[0]

    assert [hits(), hits()] == ["0", "1"]
    with (site / "bnirl_ros" / "mdp" / "wave.py").open("a") as other:
        other.write("\n")
    assert [hits(), hits()] == ["0", "1"]


def test_a_folder_that_others_write_to_is_not_trusted(tmp_path: Path) -> None:
    mine = temporary_folder(tmp_path)
    assert temporary_folder(tmp_path) == mine
    mine.chmod(0o777)
    another = temporary_folder(tmp_path)
    assert another != mine
    assert another.stat().st_mode & 0o077 == 0
    mine.rmdir()
    mine.symlink_to(another)
    assert temporary_folder(tmp_path) not in (mine, another)
    # What leads nowhere, and what is no folder, may have been put there as well.
    mine.unlink()
    mine.symlink_to(tmp_path / "nowhere")
    assert temporary_folder(tmp_path) not in (mine, tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    mine.unlink()
    mine.touch()
    assert temporary_folder(tmp_path).is_dir()
