"""The data files are found wherever the package is installed."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bnirl_ros import resources

PACKAGE = Path(resources.__file__).parent


def found_from(package_parent: Path) -> subprocess.CompletedProcess[str]:
    shutil.copytree(
        PACKAGE, package_parent / "bnirl_ros", ignore=shutil.ignore_patterns("__pycache__")
    )
    code = "from bnirl_ros.resources import share_folder; print(share_folder())"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=package_parent, capture_output=True, text=True
    )


@pytest.mark.parametrize(
    "site", ["lib/python3/site-packages", "lib/python3/dist-packages", "."], ids=str
)
def test_installed_files_are_found_beside_the_package(tmp_path: Path, site: str) -> None:
    prefix = tmp_path.resolve() / "prefix"
    share = prefix / "share" / "bnirl_ros"
    share.mkdir(parents=True)
    assert found_from(prefix / site).stdout.strip() == str(share)


def test_a_source_tree_is_its_own_share_folder(tmp_path: Path) -> None:
    (tmp_path / "package.xml").touch()
    assert found_from(tmp_path).stdout.strip() == str(tmp_path.resolve())


def test_a_lost_share_folder_is_said_in_words(tmp_path: Path) -> None:
    assert "install the package with pip or colcon" in found_from(tmp_path / "a").stderr
