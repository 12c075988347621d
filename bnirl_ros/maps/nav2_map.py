"""Map files of Nav2: a YAML file beside an image, read as nav2_map_server reads them.

The rules follow nav2_map_server/src/map_io.cpp of ros-navigation/navigation2.
"""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.maps.occupancy import FREE, OCCUPIED, check_geometry, map_from_occupancy

UNKNOWN = -1
"""Occupancy of a cell about which the image says nothing."""

_MODES = ("trinary", "scale", "raw")


@dataclass(frozen=True)
class _MapFile:
    """What the YAML file says; fields are called as its keys, paths are resolved."""

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: str


@dataclass(frozen=True, eq=False)
class _Pixels:
    """An image as integers: channels (height, width, k), each in 0..brightest, row 0 on top.

    The channels are grey, or red, green and blue; `opacity` (height, width) is None for images
    without transparency.
    """

    channels: npt.NDArray[np.int32]
    opacity: npt.NDArray[np.int32] | None
    brightest: int


def read_nav2_map(yaml_path: str | Path) -> GridMap:
    """The planning map of a Nav2 map file, in the frame `map`.

    Args:
        yaml_path: the YAML file; a relative image path in it starts from its folder. The image
            is PGM, PNG or BMP, its top row the highest y.

    Raises:
        InputError: the YAML file or the image is missing, cannot be read, says something that no
            map can have, or leaves no cell free.
    """
    path = Path(yaml_path)
    settings = _read_settings(path)
    pixels = _read_pixels(settings, path)
    height, width = pixels.channels.shape[:2]
    return map_from_occupancy(
        _occupancy_of(pixels, settings)[::-1],
        width,
        height,
        settings.resolution,
        settings.origin,
        "map",
        source=str(path),
    )


def _read_settings(path: Path) -> _MapFile:
    import yaml

    try:
        content = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: the map file cannot be read ({error.strerror}); check the path"
        ) from None
    # PyYAML lets ValueError through for impossible dates, RecursionError for deep nesting.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise InputError(
            f"{path}: this is not valid YAML{place}; name the .yaml file that map_saver wrote"
        ) from None
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: this YAML holds no keys; a Nav2 map has image, resolution, origin, negate,"
            " occupied_thresh and free_thresh"
        )
    return _MapFile(
        image=_image_path(content, path),
        resolution=_number(content, "resolution", path),
        origin=_origin(content, path),
        negate=bool(_number(content, "negate", path)),
        occupied_thresh=_number(content, "occupied_thresh", path),
        free_thresh=_number(content, "free_thresh", path),
        mode=_mode(content, path),
    )


def _value(content: Mapping[str, Any], key: str, path: Path) -> Any:
    if key not in content:
        raise InputError(f"{path}: the key '{key}' is missing; add it as map_saver writes it")
    return content[key]


def _as_number(value: Any) -> float:
    """The finite number that a YAML value is, or NaN."""
    try:
        # YAML 1.1 reads 5e-2 as text; Nav2 reads it as a number.
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def _number(content: Mapping[str, Any], key: str, path: Path) -> float:
    value = _value(content, key, path)
    number = _as_number(value)
    if math.isnan(number):
        raise InputError(f"{path}: '{key}' is {value!r}; it must be a finite number")
    return number


def _origin(content: Mapping[str, Any], path: Path) -> tuple[float, float, float]:
    value = _value(content, "origin", path)
    numbers = [_as_number(item) for item in value] if isinstance(value, list) else []
    if len(numbers) != 3 or any(math.isnan(number) for number in numbers):
        raise InputError(
            f"{path}: 'origin' is {value!r}; it must be three finite numbers, [x, y, yaw]"
        )
    x, y, yaw = numbers
    return x, y, yaw


def _mode(content: Mapping[str, Any], path: Path) -> str:
    value = content.get("mode", "trinary")
    mode = str(value).lower()
    if mode not in _MODES:
        raise InputError(f"{path}: 'mode' is {value!r}; it must be one of {', '.join(_MODES)}")
    return mode


def _image_path(content: Mapping[str, Any], path: Path) -> Path:
    value = _value(content, "image", path)
    if not isinstance(value, str) or not value:
        raise InputError(f"{path}: 'image' is {value!r}; it must be the path of an image")
    return path.parent / value


def _read_pixels(settings: _MapFile, path: Path) -> _Pixels:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            # Only these: Pillow would run an interpreter for some other formats.
            with Image.open(settings.image, formats=("PPM", "PNG", "BMP")) as image:
                check_geometry(
                    image.width, image.height, settings.resolution, settings.origin, str(path)
                )
                return _pixels_of(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no image at {settings.image}; put it there or correct 'image'"
        ) from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(
            f"{path}: the image {settings.image} is too large; crop it or lower its resolution"
        ) from None
    # All of these are ways in which Pillow says that an image is broken.
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, struct.error):
        raise InputError(
            f"{path}: the image {settings.image} cannot be read; save it again as PGM, PNG or BMP"
        ) from None


def _pixels_of(image: Any) -> _Pixels:
    """Pixels of a Pillow image."""
    if image.mode.startswith("I"):  # 16 bits; Pillow scales a PGM with more than 8 to that.
        grey = np.clip(np.asarray(image, dtype=np.int32), 0, 65535)
        return _Pixels(grey[..., np.newaxis], None, 65535)
    if image.has_transparency_data:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.int32)
        return _Pixels(rgba[..., :3], rgba[..., 3], 255)
    if image.mode in ("1", "L"):
        grey = np.asarray(image.convert("L"), dtype=np.int32)
        return _Pixels(grey[..., np.newaxis], None, 255)
    return _Pixels(np.asarray(image.convert("RGB"), dtype=np.int32), None, 255)


def _occupancy_of(pixels: _Pixels, settings: _MapFile) -> npt.NDArray[np.int8]:
    """Occupancy (height, width) of an image, its row 0 on top: one table look-up for each cell."""
    level = pixels.channels.sum(axis=2, dtype=np.int32)
    count = pixels.channels.shape[2]
    if pixels.opacity is not None and settings.mode == "trinary":
        # Nav2 averages opacity in with the colours, so that transparent cells are darker.
        level = level + pixels.opacity
        count += 1
    highest = count * pixels.brightest
    occupancy = _occupancy_of_shade(np.arange(highest + 1) / highest, settings)[level]
    if pixels.opacity is not None and settings.mode == "scale":
        occupancy[pixels.opacity < pixels.brightest] = UNKNOWN
    return cast("npt.NDArray[np.int8]", occupancy)


def _occupancy_of_shade(
    shade: npt.NDArray[np.float64], settings: _MapFile
) -> npt.NDArray[np.int8]:
    """Occupancy of shades between 0 (black) and 1 (white), by the file's mode and thresholds."""
    if settings.mode == "raw":  # The pixel is the occupancy; Nav2 ignores `negate` here.
        value = np.floor(shade * 255 + 0.5)
        return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)
    darkness = shade if settings.negate else 1.0 - shade
    between = np.full(shade.shape, UNKNOWN)
    span = settings.occupied_thresh - settings.free_thresh
    if settings.mode == "scale" and span > 0:
        share = np.clip((darkness - settings.free_thresh) / span, 0.0, 1.0)
        between = np.rint(share * OCCUPIED).astype(np.int64)
    occupancy = np.where(darkness < settings.free_thresh, FREE, between)
    return np.where(settings.occupied_thresh < darkness, OCCUPIED, occupancy).astype(np.int8)
