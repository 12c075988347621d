"""Where the files lie that come with the package but are no Python: definitions, maps, bags."""

from __future__ import annotations

from functools import cache
from pathlib import Path


@cache
def share_folder() -> Path:
    """The folder that holds msg_schemas/, bags/, launch/ and the like.

    In a source tree that is the repository root, otherwise `share/bnirl_ros` of the installation:
    of pip's (also with --user and --target), a virtual environment's or colcon's.

    Raises:
        FileNotFoundError: the package was copied somewhere without its data files.
    """
    package = Path(__file__).resolve().parent
    if (package.parent / "package.xml").is_file():
        return package.parent
    for parent in package.parents:
        share = parent / "share" / "bnirl_ros"
        if share.is_dir():
            return share
    raise FileNotFoundError(
        f"The data files of bnirl_ros are not installed: no folder above {package} has a "
        "share/bnirl_ros; install the package with pip or colcon instead of copying it."
    )
