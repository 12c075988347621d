"""Maps: occupancy, Nav2 map files, text grids and features; cells, metres and the earth.

A map knows which cells are free, where they lie and what features they have; what anybody does on
it is not its business.
"""

from pathlib import Path

from bnirl_ros.errors import InputError
from bnirl_ros.maps.features import FeatureLayer, load_features, with_features
from bnirl_ros.maps.grid_map import FeatureMap, GridMap
from bnirl_ros.maps.nav2_map import read_nav2_map
from bnirl_ros.maps.occupancy import map_from_occupancy, occupancy_of, yaw_of
from bnirl_ros.maps.text_grid import parse_text_grid, read_text_grid

__all__ = [
    "FeatureLayer",
    "FeatureMap",
    "GridMap",
    "load_features",
    "load_map",
    "map_from_occupancy",
    "occupancy_of",
    "parse_text_grid",
    "read_nav2_map",
    "read_text_grid",
    "with_features",
    "yaw_of",
]

_READERS = {".yaml": read_nav2_map, ".yml": read_nav2_map, ".txt": read_text_grid}


def load_map(path: str | Path) -> GridMap:
    """The map in a file: Nav2's for .yaml and .yml, a text grid for .txt.

    Raises:
        InputError: another suffix, or what the reader of that kind of file refuses.
    """
    reader = _READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: a map is a Nav2 map file (.yaml) or a text grid (.txt); name one of them"
        )
    return reader(path)
