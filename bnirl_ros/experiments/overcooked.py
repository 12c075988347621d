"""Human play in Overcooked-AI, as a demonstration on a map.

The recordings are two text files for each layout, `<layout>.csv` and `<layout>.grid.txt`, taken
from the train split of the human-human trials in the PyPI package overcooked-ai 1.1.0. Each
episode is one player of one trial.

How a step of the game is read, by one rule for all layouts: a move that changed the player's cell
is an observation, and an interaction is one of staying. Steps without an action and pushes that
moved nobody, against furniture or the other player, are none: people stand about a great deal,
waiting for soup or for each other, and a push is how a player turns to what it faces. A push shows
by the cell of the next step. So the last step of an episode, which has no next one, is an
observation only where it is an interaction; otherwise its cell is the last pose.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES

LAYOUTS = ("random3", "asymmetric_advantages", "coordination_ring")
"""Layouts whose human play the project measures itself against."""

MOVES = 4
"""Players move to the sides only."""

STEP = 0.15
"""Time between two poses in a bag [s]: a step of the game. As no pose is there for the steps that
are left out, the time that a player waits is not in the bag."""

LICENCE = """\
This bag was converted from human play recorded with Overcooked-AI
(https://github.com/HumanCompatibleAI/overcooked_ai): the train split of the human-human trials in
its release 1.1.0. Of the players' steps those were kept in which a move changed the player's cell,
and those in which the player interacted, which became staying in place. Steps without an action
and moves that were blocked were left out, and the steps that were kept were spaced evenly in time.
The layout became the map, its floor free and its furniture blocked.

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
_ACTION_NAMES = {"N": "N", "S": "S", "E": "E", "W": "W", "I": "stay"}
_IDLE = -1  # in an action's place: the player pressed nothing
_ACTIONS = {".": _IDLE} | {code: ACTION_NAMES.index(name) for code, name in _ACTION_NAMES.items()}

_GET_THEM = (
    "it must hold <layout>.csv with the columns episode,t,x,y,action and <layout>.grid.txt, "
    "taken from the train split of the human-human trials in the PyPI package overcooked-ai 1.1.0"
)


def add_option(parser: argparse.ArgumentParser, without: str = "") -> None:
    """Add --overcooked, the folder with the recordings; `without`: what becomes of the command."""
    parser.add_argument(
        "--overcooked",
        type=Path,
        metavar="FOLDER",
        default=Path("../shared/data/overcooked"),
        help="human play: <layout>.csv, with a column interact_ok, and <layout>.grid.txt"
        f"{without} (%(default)s)",
    )


def read_overcooked(folder: Path, layout: str) -> tuple[Demonstration, GridMap]:
    """The demonstration and the map in `<layout>.csv` and `<layout>.grid.txt` of a folder.

    The map has the layout's floor free and all else blocked, cells of 1 m, and the frame `map`.
    The files' rows count from the top, our y from the bottom. Which steps are observations, the
    module's docstring says.

    Raises:
        InputError: a file is missing or no such recording; the sentence names file and line.
    """
    rows, grid_map = _read_recording(folder, layout)
    demonstration = _demonstration(rows)
    if not len(demonstration):
        raise InputError(
            f"{folder / f'{layout}.csv'}: nobody moves or interacts; record players at play"
        )
    return demonstration, grid_map


def read_paths(folder: Path, layout: str) -> npt.NDArray[np.int64]:
    """Episode and cell (N, 3) at every step of the recording, whatever the player did in it.

    In order of episode and time, y up.

    Raises:
        InputError: as in `read_overcooked`.
    """
    rows, _ = _read_recording(folder, layout)
    return rows[:, [0, 2, 3]]


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


def _read_recording(folder: Path, layout: str) -> tuple[npt.NDArray[np.int64], GridMap]:
    """Every step (N, 5) as in `_read_rows`, by episode and time without a gap, and the map."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; {_GET_THEM}")
    grid_map = _read_layout(folder / f"{layout}.grid.txt")
    path = folder / f"{layout}.csv"
    return _in_steps(_read_rows(path, grid_map), path), grid_map


def _read_rows(path: Path, grid_map: GridMap) -> npt.NDArray[np.int64]:
    """(N, 5) episode, t, x, y (up) and action index, or `_IDLE`, of each row of the CSV."""
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
    """Episode, t, x, y (up), action index or `_IDLE` of a row; `place` is for an error."""
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


def _in_steps(rows: npt.NDArray[np.int64], path: Path) -> npt.NDArray[np.int64]:
    """The rows (N, 5) by episode and time, which must be steps without a gap in every episode."""
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
    return rows


def _demonstration(rows: npt.NDArray[np.int64]) -> Demonstration:
    """The observations and last poses in steps (N, 5), by the rule of the module's docstring."""
    episode, cells, action = rows[:, 0], rows[:, 2:4], rows[:, 4]
    last = np.diff(episode, append=episode[-1] + 1) != 0
    moved = np.diff(cells, axis=0, append=cells[-1:]).any(axis=1) & ~last
    interacted = action == ACTION_NAMES.index("stay")
    observed = interacted | (moved & (action != _IDLE))
    ends = last & ~observed & np.isin(episode, episode[observed])
    return Demonstration(
        episode=episode[observed],
        cells=cells[observed],
        action=action[observed],
        last_episode=episode[ends],
        last_cells=cells[ends],
    )
