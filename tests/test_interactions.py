"""Interactions with an effect are counted by cell, y up."""

from __future__ import annotations

from pathlib import Path

import pytest

from bnirl_ros.errors import InputError
from bnirl_ros.experiments.interactions import main, shares
from bnirl_ros.experiments.overcooked import read_interactions

ROWS = ["0,0,1,1,I,1", "0,1,1,1,I,0", "0,2,2,1,I,1", "0,3,1,1,I,1", "0,4,1,2,.,0"]


def write_recording(folder: Path, layout: str, columns: str, rows: list[str]) -> None:
    (folder / f"{layout}.grid.txt").write_text("XXXX\nX  X\nX  X\nXXXX\n", encoding="utf-8")
    (folder / f"{layout}.csv").write_text("\n".join([columns, *rows]), encoding="utf-8")


def test_cells_of_the_interactions_that_had_an_effect(tmp_path: Path) -> None:
    write_recording(tmp_path, "kitchen", "episode,t,x,y,action,interact_ok", ROWS)
    cells = read_interactions(tmp_path, "kitchen")
    assert cells.tolist() == [[1, 2], [2, 2], [1, 2]]
    assert shares(cells) == [((1, 2), 2 / 3), ((2, 2), 1 / 3)]


def test_recordings_without_the_column_are_refused(tmp_path: Path) -> None:
    write_recording(tmp_path, "kitchen", "episode,t,x,y,action", [row[:-2] for row in ROWS])
    with pytest.raises(InputError, match=r"kitchen\.csv, line 1: no column interact_ok"):
        read_interactions(tmp_path, "kitchen")


def test_missing_recordings_are_said_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--overcooked", str(tmp_path)]) == 1
    assert "random3.grid.txt: cannot be read" in capsys.readouterr().err
