"""CSV demonstrations: what is read, and the sentence for every way to get it wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bnirl_ros.demonstrations.csv_file import read_csv
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap

FREE = np.ones((3, 4), dtype=bool)
FREE[1, 1] = False
MAP = GridMap(FREE)
HEADER = "episode,x,y,action\n"


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "demo.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_rows_of_an_episode_keep_their_order(tmp_path: Path) -> None:
    path = written(tmp_path, HEADER + "7,0,0,E\n-1,3,2,SW\n7,1,0,stay\n-1,2,2,W\n")
    demonstration = read_csv(path, MAP)
    assert demonstration.observations.tolist() == [
        [-1, 3, 2, 6],
        [-1, 2, 2, 5],
        [7, 0, 0, 1],
        [7, 1, 0, 0],
    ]
    assert len(demonstration.last_cells) == 0


def test_columns_in_any_order_with_spaces_windows_lines_and_a_mark(tmp_path: Path) -> None:
    text = "\ufeffaction, y, x, episode, comment\r\nN, 2, 3, 0, fine\r\n"
    assert read_csv(written(tmp_path, text), MAP).observations.tolist() == [[0, 3, 2, 3]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEADER + "0,0,0,E\n0,1,0,up\n", r"line 3: action is 'up'; it must be one of stay, E"),
        (HEADER + "0,0,0,\n", r"line 2: action is ''"),
        (HEADER + "0,0.5,0,E\n", r"line 2: x is '0.5'; it must be a whole number"),
        (HEADER + "0,0\n", r"line 2: y is ''"),
        (HEADER + "0,9,0,E\n", r"line 2: cell \(9, 0\) is outside the map of 4 x 3 cells"),
        (HEADER + "0,-1,0,E\n", r"line 2: cell \(-1, 0\) is outside"),
        (HEADER + "0,1,1,E\n", r"line 2: cell \(1, 1\) is blocked"),
        (HEADER + "9" * 30 + ",1,0,E\n", r"line 2: episode is '9+'"),
        (HEADER + "9" * 5000 + ",1,0,E\n", r"line 2: episode is '9+'"),
        ("episode,x,action\n0,0,E\n", r"line 1: no column y"),
        ("", r"line 1: no column episode, x, y, action"),
        (HEADER, r"has no rows"),
        (b"\xff\xfe\x00bad", r"is no CSV text"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(
    tmp_path: Path, text: str | bytes, words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_csv(written(tmp_path, text), MAP)
    assert "\n" not in str(caught.value)
    assert "demo.csv" in str(caught.value)


def test_diagonals_are_no_actions_with_four_moves(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'NE'; it must be one of stay, E, N, W, S$"):
        read_csv(written(tmp_path, HEADER + "0,0,0,NE\n"), MAP, moves=4)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_csv(path, MAP)
