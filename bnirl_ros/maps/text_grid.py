"""Maps drawn as text: `#` blocked, `.` free, the last line y = 0."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.maps.occupancy import FREE, OCCUPIED, map_from_occupancy

_OCCUPANCY = {".": FREE, "#": OCCUPIED}


def read_text_grid(path: str | Path) -> GridMap:
    """The map that a text file draws, with cells of 1 m and its lower left corner at (0, 0).

    Lines end with a line feed, with or without a carriage return; empty lines at the end of the
    file are no rows of the map.

    Raises:
        InputError: the file cannot be read, holds no row, its lines differ in length, it has
            another character than `#` and `.`, or no cell is free.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: this is no text file; draw the map with '#' for blocked and '.' for free"
        ) from None
    except OSError as error:
        raise InputError(
            f"{path}: the map cannot be read ({error.strerror}); check the path"
        ) from None
    return parse_text_grid(text, str(path))


def parse_text_grid(text: str, source: str) -> GridMap:
    """The map that a text draws, as `read_text_grid` reads it.

    Args:
        text: the rows, the last one y = 0.
        source: the file or whatever holds the text, for the error's sentence.

    Raises:
        InputError: there is no row, the lines differ in length, there is another character than
            `#` and `.`, or no cell is free.
    """
    # str.splitlines would also split at form feeds and the like and miscount the lines.
    lines = text.rstrip("\n").split("\n")
    width = len(lines[0])
    for number, line in enumerate(lines, start=1):
        for column, character in enumerate(line, start=1):
            if character not in _OCCUPANCY:
                raise InputError(
                    f"{source}: line {number}, column {column} is {character!r};"
                    " write '#' for a blocked cell and '.' for a free one"
                )
        if len(line) != width:
            raise InputError(
                f"{source}: line {number} ends after column {len(line)}, line 1 after column"
                f" {width}; make all lines equally long"
            )
    occupancy = np.array([[_OCCUPANCY[character] for character in line] for line in lines[::-1]])
    return map_from_occupancy(
        occupancy, width, len(lines), 1.0, (0.0, 0.0, 0.0), "map", source=source
    )
