"""Where compiled kernels are kept, so that they are compiled once and not at each start.

numba keeps them beside the source, or, where it cannot write there, in the user's cache folder; or
wherever the environment's NUMBA_CACHE_DIR says. Where none of these is writable it would not
import a kernel at all.
"""

from __future__ import annotations

import os
import stat
import sys
import warnings
from pathlib import Path

_VARIABLE = "NUMBA_CACHE_DIR"


def ensure_kernel_cache() -> None:
    """See to it that kernels can be kept somewhere: at worst in the folder for temporary files."""
    package = Path(__file__).parent
    given = os.environ.get(_VARIABLE)
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    places = [package / "__pycache__", user / "numba"]
    if given:
        places.insert(0, Path(given))
    if any(map(_is_writable, places)):
        return
    import tempfile  # here, since it is rarely needed

    folder = temporary_folder(Path(tempfile.gettempdir()))
    os.environ[_VARIABLE] = str(folder)
    if "numba" in sys.modules:  # it has read the environment already
        from numba.core import config

        config.CACHE_DIR = str(folder)
    warnings.warn(
        f"compiled kernels are kept in {folder}, as neither {package} nor {user} can be written "
        f"to; set {_VARIABLE} to a folder that lasts, or they may be compiled at every start",
        RuntimeWarning,
        stacklevel=2,
    )


def temporary_folder(parent: Path) -> Path:
    """A folder that nobody else writes to: whoever does could have us run anything."""
    folder = parent / f"bnirl_ros-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    others = stat.S_IWGRP | stat.S_IWOTH
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & others:
        return folder
    import tempfile

    return Path(tempfile.mkdtemp(prefix="bnirl_ros-", dir=parent))


def _is_writable(folder: Path) -> bool:
    """Whether files can be made there; the folder is made, as numba would."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
