"""Where compiled kernels are kept, so that they are compiled once and not at each start.

numba keeps them beside the source, or, where it cannot write there, in the user's cache folder; or
wherever the environment's NUMBA_CACHE_DIR says. Where none of these is writable it would not
import a kernel at all.

It compiles a kernel again when the kernel's own file has changed, but not when one has that the
kernel calls. So kernels are forgotten when any source of the package has changed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import sys
import warnings
from pathlib import Path

_VARIABLE = "NUMBA_CACHE_DIR"
_STAMP = "bnirl_ros.stamp"  # which sources the kernels in a folder were compiled from


def ensure_kernel_cache() -> None:
    """See to it that kernels can be kept somewhere: at worst in the folder for temporary files.

    Those are forgotten that were compiled from other sources than there are now.
    """
    package = Path(__file__).parent
    given = os.environ.get(_VARIABLE)
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    places = [package / "__pycache__", user / "numba"]
    if given:
        places.insert(0, Path(given))
    place = next(filter(_is_writable, places), None)  # numba takes the first one, too
    if place:
        forget_stale_kernels(package, place)
        return
    import tempfile  # here, since it is rarely needed

    folder = temporary_folder(Path(tempfile.gettempdir()))
    os.environ[_VARIABLE] = str(folder)
    if "numba" in sys.modules:  # it has read the environment already
        from numba.core import config

        config.CACHE_DIR = str(folder)
    forget_stale_kernels(package, folder)
    warnings.warn(
        f"compiled kernels are kept in {folder}, as neither {package} nor {user} can be written "
        f"to; set {_VARIABLE} to a folder that lasts, or they may be compiled at every start",
        RuntimeWarning,
        stacklevel=2,
    )


def forget_stale_kernels(package: Path, place: Path) -> None:
    """Delete the indices of kernels that were compiled from other sources of this package.

    Args:
        package: its folder.
        place: inside of it, or a folder with kernels of any package, in folders that numba names
            after those of the sources.
    """
    sources = sorted(package.rglob("*.py"))
    found = [(str(source), source.stat().st_mtime_ns, source.stat().st_size) for source in sources]
    stamp = hashlib.sha1(repr(found).encode(), usedforsecurity=False).hexdigest()
    folders = sorted({source.parent for source in sources})
    if place.is_relative_to(package):
        kept = [folder / "__pycache__" for folder in folders]
    else:
        digests = [
            hashlib.sha1(str(folder).encode(), usedforsecurity=False).hexdigest()
            for folder in folders
        ]
        kept = [
            place / f"{folder.name}_{digest}"
            for folder, digest in zip(folders, digests, strict=True)
        ]
    told = kept[0] / _STAMP
    with contextlib.suppress(OSError):  # such as a full disk: numba will say what it makes of that
        if told.is_file() and told.read_text() == stamp:
            return
        for index in [index for folder in kept for index in folder.glob("*.nbi")]:
            index.unlink(missing_ok=True)  # another process may do the same
        told.parent.mkdir(exist_ok=True)
        told.write_text(stamp)


def temporary_folder(parent: Path) -> Path:
    """A folder that nobody else writes to: whoever does could have us run anything."""
    folder = parent / f"bnirl_ros-{os.getuid()}"
    # Its name is foretold, so that kernels are found again: somebody may have been there before.
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    others = stat.S_IWGRP | stat.S_IWOTH
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & others:
        return folder
    import tempfile  # makes a folder of a new name, for us alone

    return Path(tempfile.mkdtemp(prefix="bnirl_ros-", dir=parent))


def _is_writable(folder: Path) -> bool:
    """Whether files can be made there; the folder is made, as numba would."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
