"""Human play in Overcooked-AI, as a demonstration on a map.

The recordings are two text files for each layout, `<layout>.csv` and `<layout>.grid.txt`, taken
from the train split of the human-human trials in the PyPI package overcooked-ai 1.1.0. Each
episode is one player of one trial.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES

STEP = 0.15
"""Time between two actions of a player [s]."""

LICENCE = """\
This bag was converted from human play recorded with Overcooked-AI
(https://github.com/HumanCompatibleAI/overcooked_ai): the train split of the human-human trials in
its release 1.1.0. Positions and actions of the players were kept, an interaction became staying in
place; the layout became the map, its floor free and its furniture blocked.

Overcooked-AI is under the MIT License:

MIT License

Copyright (c) 2019 HumanCompatibleAI

Permission is hereby granted, free of charge, to any person obtaining a copy
of this software and associated documentation files (the "Software"), to deal
in the Software without restriction, including without limitation the rights
to use, copy, modify, merge, publish, distribute, sublicense, and/or sell
copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all
copies or substantial portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM,
OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
SOFTWARE.
"""
"""What has to go with every copy of the recordings, and what was changed. Release 1.1.0 carries no
licence file to copy; its repository is under the MIT License. The copyright line names the
repository's owner and the year of its paper."""

COLUMNS = ("episode", "t", "x", "y", "action")
EFFECT_COLUMN = "interact_ok"

FLOOR = " "
"""Where players walk in a layout; its other characters are furniture."""

# Interacting leaves the player in its cell, as staying does. N is up on the screen, and our y is
# up as well: the names need no turning round, only the rows do.
_ACTION_NAMES = {"N": "N", "S": "S", "E": "E", "W": "W", ".": "stay", "I": "stay"}
_ACTIONS = {code: ACTION_NAMES.index(name) for code, name in _ACTION_NAMES.items()}

_GET_THEM = (
    "it must hold <layout>.csv with the columns episode,t,x,y,action and <layout>.grid.txt, "
    "taken from the train split of the human-human trials in the PyPI package overcooked-ai 1.1.0"
)


def read_overcooked(folder: Path, layout: str) -> tuple[Demonstration, GridMap]:
    """The demonstration and the map in `<layout>.csv` and `<layout>.grid.txt` of a folder.

    The map has the layout's floor free and all else blocked, cells of 1 m, and the frame `map`.
    The files' rows count from the top, our y from the bottom.

    Raises:
        InputError: a file is missing or no such recording; the sentence names file and line.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; {_GET_THEM}")
    grid_map = _read_layout(folder / f"{layout}.grid.txt")
    path = folder / f"{layout}.csv"
    rows = _read_rows(path, grid_map)
    return _demonstration(rows, path), grid_map


def read_interactions(folder: Path, layout: str) -> npt.NDArray[np.int64]:
    """Cells (M, 2) from which interactions that had an effect were made, in the file's order.

    A further column, `interact_ok`, marks them by 1; no bag needs it.

    Raises:
        InputError: as in `read_overcooked`, or there is no such column.
    """
    grid_map = _read_layout(folder / f"{layout}.grid.txt")
    path = folder / f"{layout}.csv"
    reader = csv.DictReader(_read_text(path).splitlines())
    if EFFECT_COLUMN not in (reader.fieldnames or ()):
        raise InputError(
            f"{path}, line 1: no column {EFFECT_COLUMN}; it tells which interactions had an effect"
        )
    cells = [
        _observation(row, f"{path}, line {reader.line_num}", grid_map)[2:4]
        for row in reader
        if row[EFFECT_COLUMN] == "1"
    ]
    return np.array(cells, dtype=np.int64).reshape(-1, 2)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the folder with the recordings: "
            f"{_GET_THEM}"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no text; {_GET_THEM}") from None


def _read_layout(path: Path) -> GridMap:
    rows = _read_text(path).rstrip("\n").split("\n")
    if len({len(row) for row in rows}) != 1:
        raise InputError(f"{path}: its lines differ in length; draw every row of the layout whole")
    free = np.array([[character == FLOOR for character in row] for row in rows[::-1]])
    if not free.any():
        raise InputError(f"{path}: has no floor; draw each free cell as a space")
    return GridMap(free)


def _read_rows(path: Path, grid_map: GridMap) -> npt.NDArray[np.int64]:
    """(N, 5) episode, t, x, y (up) and action index of each row of the CSV, in its order."""
    reader = csv.DictReader(_read_text(path).splitlines())
    missing = [column for column in COLUMNS if column not in (reader.fieldnames or ())]
    if missing:
        raise InputError(
            f"{path}, line 1: no column {', '.join(missing)}; "
            f"the first line must name the columns {','.join(COLUMNS)}"
        )
    rows = [_observation(row, f"{path}, line {reader.line_num}", grid_map) for row in reader]
    if not rows:
        raise InputError(f"{path}: has no rows; each row is one step of a player")
    return np.array(rows, dtype=np.int64)


def _observation(
    row: dict[str, str | None], place: str, grid_map: GridMap
) -> tuple[int, int, int, int, int]:
    """Episode, t, x, y (up) and action index of a row; `place` is for the error's sentence."""
    height, width = grid_map.free.shape
    try:
        episode, time, x, from_top = (int(row[column] or "") for column in COLUMNS[:4])
    except ValueError:
        raise InputError(
            f"{place}: {','.join(COLUMNS[:4])} must be whole numbers; correct the row"
        ) from None
    action = _ACTIONS.get(row["action"] or "")
    if action is None:
        raise InputError(
            f"{place}: action is {row['action']!r}; it must be one of {' '.join(_ACTIONS)}"
        )
    y = height - 1 - from_top
    if not (0 <= x < width and 0 <= y < height and grid_map.free[y, x]):
        raise InputError(
            f"{place}: (x, y) = ({x}, {from_top}) is no floor of the layout; "
            "give the .grid.txt of the same layout"
        )
    return episode, time, x, y, action


def _demonstration(rows: npt.NDArray[np.int64], path: Path) -> Demonstration:
    """The demonstration in rows (N, 5), which must be steps without a gap in every episode."""
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    change = np.diff(rows, axis=0)
    is_step = (change[:, 1] == 1) & (np.abs(change[:, 2:4]).max(axis=1, initial=0) <= 1)
    broken = np.flatnonzero((change[:, 0] == 0) & ~is_step)
    if len(broken):
        episode, time = rows[broken[0], :2]
        raise InputError(
            f"{path}: episode {episode} breaks off after t = {time}; t must count up by one and "
            "the player must move by one cell at most"
        )
    return Demonstration(
        episode=rows[:, 0],
        cells=rows[:, 2:4],
        action=rows[:, 4],
        last_episode=np.empty(0, dtype=np.int64),
        last_cells=np.empty((0, 2), dtype=np.int64),
    )
