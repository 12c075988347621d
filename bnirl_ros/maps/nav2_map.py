"""Map files of Nav2: a YAML file beside an image, read as nav2_map_server reads them.

The rules follow nav2_map_server/src/map_io.cpp of ros-navigation/navigation2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.maps.map_file import image_path_of, number_of, origin_of, read_image, read_keys
from bnirl_ros.maps.occupancy import FREE, OCCUPIED, map_from_occupancy

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
    pixels = read_image(settings.image, settings.resolution, settings.origin, path, _pixels_of)
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
    content = read_keys(
        path,
        "name the .yaml file that map_saver wrote",
        "a Nav2 map has image, resolution, origin, negate, occupied_thresh and free_thresh",
    )
    return _MapFile(
        image=image_path_of(content, path),
        resolution=number_of(content, "resolution", path),
        origin=origin_of(content, path),
        negate=bool(number_of(content, "negate", path)),
        occupied_thresh=number_of(content, "occupied_thresh", path),
        free_thresh=number_of(content, "free_thresh", path),
        mode=_mode(content, path),
    )


def _mode(content: Mapping[str, Any], path: Path) -> str:
    value = content.get("mode", "trinary")
    mode = str(value).lower()
    if mode not in _MODES:
        raise InputError(f"{path}: 'mode' is {value!r}; it must be one of {', '.join(_MODES)}")
    return mode


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
