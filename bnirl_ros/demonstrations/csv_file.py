"""Demonstrations in CSV files: columns episode, x, y, action."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES, ACTION_SETS, action_of_name

COLUMNS = ("episode", "x", "y", "action")


def read_csv(path: Path, grid_map: GridMap, moves: int = 8) -> Demonstration:
    """The demonstration in a CSV file, checked against the map on which it was made.

    The rows of an episode are in order, whether or not they stand together. A CSV tells no last
    pose, only poses in which an action was chosen.

    Args:
        path: a file with the columns episode, x, y (whole numbers; cells of the map) and action
            (one of `ACTION_NAMES`), in any order; others are ignored.
        grid_map: the map.
        moves: 4 or 8: which actions there are.

    Raises:
        InputError: the file cannot be read, or a row is bad; the sentence names file and line.
    """
    rows = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            missing = [column for column in COLUMNS if column not in (reader.fieldnames or ())]
            if missing:
                raise InputError(
                    f"{path}, line 1: no column {', '.join(missing)}; "
                    f"the first line must name the columns {','.join(COLUMNS)}"
                )
            for row in reader:
                rows.append(_observation(row, f"{path}, line {reader.line_num}", grid_map, moves))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a CSV file") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is no CSV text ({error}); save it as UTF-8 CSV") from error
    if not rows:
        raise InputError(f"{path}: has no rows; each row is one observation {','.join(COLUMNS)}")
    observations = np.array(rows, dtype=np.int64)
    observations = observations[np.argsort(observations[:, 0], kind="stable")]
    return Demonstration(
        episode=observations[:, 0],
        cells=observations[:, 1:3],
        action=observations[:, 3],
        last_episode=np.empty(0, dtype=np.int64),
        last_cells=np.empty((0, 2), dtype=np.int64),
    )


def _observation(
    row: dict[str, str | None], place: str, grid_map: GridMap, moves: int
) -> tuple[int, int, int, int]:
    """(episode, x, y, action index) of a row; `place` is for the sentence on what is wrong."""
    numbers = []
    for column in COLUMNS[:3]:
        text = (row[column] or "").strip()
        try:
            number = int(text)
        except ValueError:
            number = -(2**63)
        if abs(number) >= 2**62:
            raise InputError(f"{place}: {column} is {text!r}; it must be a whole number")
        numbers.append(number)
    episode, x, y = numbers
    name = (row["action"] or "").strip()
    action = action_of_name(name)
    if action is None or action not in ACTION_SETS[moves]:
        names = ", ".join(ACTION_NAMES[index] for index in ACTION_SETS[moves])
        raise InputError(f"{place}: action is {name!r}; it must be one of {names}")
    if fault := grid_map.fault_of((x, y)):
        raise InputError(f"{place}: {fault}; correct it or give another map")
    return episode, x, y, action
