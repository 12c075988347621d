"""Maps drawn as text, and the choice of a reader by the file's suffix."""

from __future__ import annotations

from pathlib import Path

import pytest

from bnirl_ros.errors import InputError
from bnirl_ros.maps import load_map, read_text_grid


def write(folder: Path, content: bytes) -> Path:
    path = folder / "grid.txt"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "content",
    [b"#..\n...", b"#..\n...\n", b"#..\r\n...\r\n", b"#..\n...\n\n\n", b"\xef\xbb\xbf#..\n..."],
    ids=["bare", "newline", "carriage returns", "empty lines at the end", "byte order mark"],
)
def test_the_last_line_is_y_0(tmp_path, content):
    grid_map = read_text_grid(write(tmp_path, content))
    assert grid_map.free.tolist() == [[True, True, True], [False, True, True]]
    assert (grid_map.resolution, grid_map.origin) == (1.0, (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"...\n.x.\n", "line 2, column 2 is 'x'"),
        (b"...\n. .\n", "line 2, column 2 is ' '"),
        (b"...\n..\n...\n", "line 2 ends after column 2, line 1 after column 3"),
        (b"...\n\n...\n", "line 2 ends after column 0, line 1 after column 3"),
        (b"..\n...\n", "line 2 ends after column 3, line 1 after column 2"),
        (b"", "0 x 1 cells"),
        (b"##\n##\n", "no cell of the map is free"),
        (b"\xff\xfe.\x00", "no text file"),
    ],
)
def test_a_drawing_that_is_no_map_is_refused_with_its_place(tmp_path, content, says):
    path = write(tmp_path, content)
    with pytest.raises(InputError) as caught:
        read_text_grid(path)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ")
    assert says in sentence
    assert not sentence.endswith(".")


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.txt: the map cannot be read \(No such file"):
        read_text_grid(tmp_path / "none.txt")


def test_load_map_reads_a_text_grid_by_its_suffix(tmp_path):
    assert load_map(str(write(tmp_path, b".#\n"))).free.tolist() == [[True, False]]


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".YAML"])
def test_load_map_reads_a_nav2_map_by_its_suffix(tmp_path, suffix):
    (tmp_path / "map.pgm").write_bytes(b"P5\n2 1\n255\n\xff\x00")
    path = tmp_path / f"map{suffix}"
    path.write_text(
        "{image: map.pgm, resolution: 1, origin: [0, 0, 0], negate: 0,"
        " occupied_thresh: 0.65, free_thresh: 0.25}"
    )
    assert load_map(path).free.tolist() == [[True, False]]


def test_load_map_refuses_another_suffix(tmp_path):
    with pytest.raises(InputError, match=r"map\.pgm: a map is .*; name one of them$"):
        load_map(tmp_path / "map.pgm")
