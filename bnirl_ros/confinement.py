"""Files that somebody else may name: they stay inside one folder, whatever they are called."""

from __future__ import annotations

import os
from pathlib import Path

from bnirl_ros.errors import InputError


def ros_folder() -> Path:
    """The folder of this package's files under ROS_HOME, or under `~/.ros` where that is unset."""
    home = os.environ.get("ROS_HOME") or "~/.ros"
    return Path(home).expanduser() / "bnirl_ros"


def inside(folder: Path, path: Path, what: str) -> Path:
    """Where a path leads, which is the folder or below it; open that, and not the path itself.

    Symbolic links and `..` are followed, those of the folder too. What is not there yet may be
    named. Relative paths start from the working directory.

    Args:
        folder: of which the path must not lead out.
        path: what somebody else named.
        what: named the path, for the error's sentence.

    Raises:
        InputError: it leads elsewhere, or nowhere.
    """
    try:
        base = folder.resolve()
        place = path.expanduser().resolve()
    # A RuntimeError is a link that leads to itself, or `~` of nobody; a ValueError a null byte.
    except (OSError, RuntimeError, ValueError):
        raise InputError(
            f"{what}: {str(path)!r} leads nowhere; name something in {folder}"
        ) from None
    if not place.is_relative_to(base):
        raise InputError(
            f"{what}: {str(path)!r} is outside of {folder}; name something in that folder"
        )
    return place
