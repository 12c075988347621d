"""What all map files of Nav2 have in common: a YAML file with keys, and an image beside it."""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from bnirl_ros.confinement import inside
from bnirl_ros.errors import InputError
from bnirl_ros.maps.occupancy import check_geometry
from bnirl_ros.safe_yaml import load_yaml

_Content = TypeVar("_Content")


def read_keys(path: Path, remedy: str, needed: str) -> Mapping[str, Any]:
    """The keys of a YAML file.

    Args:
        path: the file.
        remedy: what to do where it is no YAML, for the error's sentence.
        needed: what such a file has, for the same.

    Raises:
        InputError: the file cannot be read, or holds no keys.
    """
    try:
        content = load_yaml(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: the file cannot be read ({error.strerror}); check the path"
        ) from None
    except InputError as fault:
        raise InputError(f"{path}: {fault}; {remedy}") from None
    if not isinstance(content, Mapping):
        raise InputError(f"{path}: this YAML holds no keys; {needed}")
    return content


def value_of(content: Mapping[str, Any], key: str, path: Path) -> Any:
    """The value of a key that must be there."""
    if key not in content:
        raise InputError(f"{path}: the key '{key}' is missing; add it as map_saver writes it")
    return content[key]


def as_number(value: Any) -> float:
    """The finite number that a YAML value is, or NaN."""
    try:
        # YAML 1.1 reads 5e-2 as text; Nav2 reads it as a number.
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def number_of(content: Mapping[str, Any], key: str, path: Path) -> float:
    """The finite number of a key."""
    value = value_of(content, key, path)
    number = as_number(value)
    if math.isnan(number):
        raise InputError(f"{path}: '{key}' is {value!r}; it must be a finite number")
    return number


def origin_of(content: Mapping[str, Any], path: Path) -> tuple[float, float, float]:
    """The origin (x, y, yaw) [m, m, rad]."""
    value = value_of(content, "origin", path)
    numbers = [as_number(item) for item in value] if isinstance(value, list) else []
    if len(numbers) != 3 or any(math.isnan(number) for number in numbers):
        raise InputError(
            f"{path}: 'origin' is {value!r}; it must be three finite numbers, [x, y, yaw]"
        )
    x, y, yaw = numbers
    return x, y, yaw


def image_path_of(content: Mapping[str, Any], path: Path, within: Path | None = None) -> Path:
    """Where the image lies; a relative path starts from the folder of the YAML file.

    Raises:
        InputError: that is no path, or leads out of the folder `within`, where one is given.
    """
    value = value_of(content, "image", path)
    if not isinstance(value, str) or not value:
        raise InputError(f"{path}: 'image' is {value!r}; it must be the path of an image")
    image_path = path.parent / value
    return image_path if within is None else inside(within, image_path, f"{path}: 'image'")


def read_image(
    image_path: Path,
    resolution: float,
    origin: tuple[float, float, float],
    path: Path,
    read: Callable[[Any], _Content],
) -> _Content:
    """What `read` makes of the opened Pillow image of a map file.

    Args:
        image_path: a PGM, PNG or BMP.
        resolution, origin: which have to be a map's.
        path: the YAML file, for the error's sentence.
        read: takes the image while it is open.

    Raises:
        InputError: the image is missing, too large or broken, or its geometry no map's.
    """
    from PIL import Image

    try:
        # A pipe would let us wait for ever.
        if image_path.exists() and not image_path.is_file():
            raise InputError(f"{path}: the image {image_path} is no file; correct 'image'")
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            # Only these: Pillow would run an interpreter for some other formats.
            with (
                _File(io.FileIO(image_path)) as file,
                Image.open(file, formats=("PPM", "PNG", "BMP")) as image,
            ):
                check_geometry(image.width, image.height, resolution, origin, str(path))
                return read(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no image at {image_path}; put it there or correct 'image'"
        ) from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(
            f"{path}: the image {image_path} is too large; crop it or lower its resolution"
        ) from None
    # All of these are ways in which Pillow says that an image is broken.
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, struct.error):
        raise InputError(
            f"{path}: the image {image_path} cannot be read; save it again as PGM, PNG or BMP"
        ) from None


class _File(io.BufferedReader):
    """A file of which no more is asked than it holds: a read reserves all that is asked."""

    def read(self, size: int | None = -1, /) -> bytes:
        """What there is of so many bytes; all for None or a negative number."""
        left = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))
