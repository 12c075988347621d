"""Features of the cells of a map: rooms or zones from a layer of labels, distances to places.

They come from a file beside the map:

- a Nav2-style YAML file with `image`, `resolution` and `origin`, whose grey levels (or palette
  indices) are labels, and, if wanted, `labels: {1: kitchen, 2: hall}`; its cells need not be the
  map's;
- a text file of whole numbers, a row of the map a line, the last line y = 0;
- a YAML file with `places: {dock: [x, y], ...}` in metres in the map frame: the features are the
  Manhattan distances to them, in whole steps of `step` metres (by default a cell).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import FeatureMap, GridMap
from bnirl_ros.maps.map_file import (
    as_number,
    image_path_of,
    number_of,
    origin_of,
    read_image,
    read_keys,
)

_FARTHEST = 1e9  # [m] of a place, and
_SMALLEST_STEP = 1e-6  # [m] of distances to it, so that they can be counted


class FeatureLayer(Protocol):
    """Whatever tells features of the cells of any map."""

    def features_of(self, grid_map: GridMap) -> FeatureMap:
        """The features of a map's cells."""


@dataclass(frozen=True, eq=False)
class LabelLayer:
    """Labels on a grid of their own.

    Attributes:
        labels: (height, width) int64, indexed [y, x].
        grid: where the cells of the labels lie; None: they are the map's own.
        names: of labels.
        source: the file, for the error's sentence.
    """

    labels: npt.NDArray[np.int64]
    grid: GridMap | None
    names: Mapping[int, str]
    source: str

    def features_of(self, grid_map: GridMap) -> FeatureMap:
        """The label under the centre of each cell; cells outside the layer have none.

        Raises:
            InputError: the labels have no place of their own, and not the size of the map.
        """
        height, width = grid_map.free.shape
        names: dict[tuple[int, ...], str] = {(label,): name for label, name in self.names.items()}
        if self.grid is None:
            if self.labels.shape != grid_map.free.shape:
                rows, columns = self.labels.shape
                raise InputError(
                    f"{self.source}: has {columns} x {rows} labels, the map {width} x {height} "
                    "cells; write one label for each cell"
                )
            known = np.ones(grid_map.free.shape, dtype=np.bool_)
            return FeatureMap(self.labels[:, :, np.newaxis], known, names)
        y, x = np.divmod(np.arange(height * width), width)
        there = self.grid.cells_of(grid_map.centres_of(np.column_stack([x, y])))
        known = self.grid.contains(there)
        labels = np.zeros(height * width, dtype=np.int64)
        labels[known] = self.labels[there[known, 1], there[known, 0]]
        return FeatureMap(labels.reshape(height, width, 1), known.reshape(height, width), names)


@dataclass(frozen=True, eq=False)
class PlaceLayer:
    """Named places, to which cells are so and so far.

    Attributes:
        names: of the k places.
        positions: (k, 2) in the map frame [m].
        step: what counts as one [m]; None: an edge of the map's cells.
    """

    names: tuple[str, ...]
    positions: npt.NDArray[np.float64]
    step: float | None = None

    def features_of(self, grid_map: GridMap) -> FeatureMap:
        """Manhattan distance along the map's rows and columns to each place: equation (21)."""
        height, width = grid_map.free.shape
        cells = grid_map.cells_of(self.positions)
        along_x = np.abs(np.arange(width) - cells[:, :1])
        along_y = np.abs(np.arange(height) - cells[:, 1:])
        distance = np.moveaxis(along_y[:, :, np.newaxis] + along_x[:, np.newaxis, :], 0, -1)
        if self.step is not None:  # rounding must not put a distance below its own step
            distance = np.floor(distance * (grid_map.resolution / self.step) + 1e-9).astype(int)
        known = np.ones(grid_map.free.shape, dtype=np.bool_)
        return FeatureMap(distance.astype(np.int64), known)


def with_features(grid_map: GridMap, layer: FeatureLayer) -> GridMap:
    """The map with the features that a layer tells of its cells."""
    return replace(grid_map, features=layer.features_of(grid_map))


def load_features(path: str | Path, within: Path | None = None) -> FeatureLayer:
    """The features in a file of one of the three kinds.

    Args:
        path: the file.
        within: a folder out of which the file must not lead by naming an image.

    Raises:
        InputError: the file cannot be read, is none of the kinds, or leads out of the folder.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix == ".txt":
        return _read_numbers(file)
    if suffix not in (".yaml", ".yml"):
        raise InputError(
            f"{file}: features are a layer of labels (.yaml with an image, or .txt with numbers) "
            "or places (.yaml); name one of them"
        )
    content = read_keys(
        file,
        "write it as docs/features.md shows",
        "features have either places, or image, resolution and origin",
    )
    return _places(content, file) if "places" in content else _labels(content, file, within)


def _read_numbers(file: Path) -> LabelLayer:
    try:
        lines = file.read_text(encoding="utf-8-sig").rstrip().splitlines()
        rows = [[int(word) for word in line.split()] for line in lines[::-1]]
        labels = np.array(rows, dtype=np.int64)
    except OSError as error:
        raise InputError(
            f"{file}: the features cannot be read ({error.strerror}); check the path"
        ) from None
    except (ValueError, OverflowError):
        raise InputError(
            f"{file}: this is no table of whole numbers; write as many in each line as the map "
            "has columns, with spaces between them"
        ) from None
    if labels.ndim != 2 or labels.size == 0:
        raise InputError(f"{file}: holds no numbers; write one for each cell of the map")
    return LabelLayer(labels, None, {}, str(file))


def _labels(content: Mapping[str, Any], file: Path, within: Path | None) -> LabelLayer:
    resolution, origin = number_of(content, "resolution", file), origin_of(content, file)
    names = content.get("labels") or {}
    if not isinstance(names, Mapping) or not all(isinstance(label, int) for label in names):
        raise InputError(f"{file}: 'labels' is {names!r}; it must be like {{1: kitchen}}")
    image_path = image_path_of(content, file, within)
    labels = read_image(
        image_path, resolution, origin, file, lambda image: _grey_levels(image, image_path, file)
    )[::-1]
    grid = GridMap(np.ones(labels.shape, dtype=np.bool_), resolution, origin)
    return LabelLayer(
        labels, grid, {int(label): str(name) for label, name in names.items()}, str(file)
    )


def _grey_levels(image: Any, image_path: Path, file: Path) -> npt.NDArray[np.int64]:
    """The numbers that an image holds, its row 0 on top."""
    # Pillow stretches the greys of a PGM whose highest one is another to the full range.
    decoder, *_, details = image.tile[0]
    stretched = decoder in ("ppm", "ppm_plain") and details[-1] not in (255, 65535)
    if stretched or not (image.mode in ("L", "P") or image.mode.startswith("I")):
        raise InputError(
            f"{file}: the image {image_path} has colours, or greys up to another than 255 or "
            "65535; save the labels as the grey levels or palette indices of a PNG"
        )
    return np.asarray(image).astype(np.int64)


def _places(content: Mapping[str, Any], file: Path) -> PlaceLayer:
    places = content["places"]
    if not isinstance(places, Mapping) or not places:
        raise InputError(f"{file}: 'places' is {places!r}; it must be {{name: [x, y], ...}} [m]")
    positions = []
    for name, place in places.items():
        numbers = [as_number(item) for item in place] if isinstance(place, list) else []
        if len(numbers) != 2 or not (np.abs(numbers) <= _FARTHEST).all():
            raise InputError(
                f"{file}: place {name} is {place!r}; it must be [x, y] in metres, no farther away "
                f"than {_FARTHEST:g}"
            )
        positions.append(numbers)
    step = None
    if "step" in content:
        step = number_of(content, "step", file)
        if step < _SMALLEST_STEP:
            raise InputError(
                f"{file}: 'step' is {step:g}; it must be {_SMALLEST_STEP:g} metres or more"
            )
    return PlaceLayer(tuple(map(str, places)), np.array(positions), step)
