"""Nav2 map files, read as nav2_map_server reads them, and every way in which one is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from bnirl_ros.errors import InputError
from bnirl_ros.experiments.restraint import limited_memory
from bnirl_ros.maps import GridMap, load_map, read_nav2_map

SHARED_MAPS = Path(__file__).resolve().parents[2] / "shared" / "data" / "maps"

SETTINGS = {
    "image": "map.png",
    "resolution": 0.5,
    "origin": [1.0, 2.0, 0.25],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.25,
}


def write_map(
    folder: Path, picture: Image.Image | None, without: str = "", **changes: object
) -> Path:
    settings = {key: value for key, value in (SETTINGS | changes).items() if key != without}
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(settings))
    if picture is not None:
        picture.save(folder / str(settings["image"]))
    return path


def grey(*rows: list[int]) -> Image.Image:
    return Image.fromarray(np.array(rows, dtype=np.uint8))


@pytest.mark.parametrize(
    ("name", "shape", "resolution", "origin", "free_from"),
    [
        # By the free_thresh of each; the depot's lets the grey of unknown cells (205) be free.
        ("depot", (307, 604), 0.05, (0.0, 0.0, 0.0), 192),
        ("tb3_sandbox", (384, 384), 0.05, (-10.0, -10.0, 0.0), 206),
        ("warehouse", (1674, 1006), 0.03, (-15.1, -25.0, 0.0), 230),
    ],
)
def test_the_maps_of_navigation2(name, shape, resolution, origin, free_from):
    path = SHARED_MAPS / f"{name}.yaml"
    if not path.is_file():
        pytest.skip("needs the Nav2 maps in ../shared/data/maps, which are not there")
    grid_map = load_map(path)
    assert grid_map.free.shape == shape
    assert (grid_map.resolution, grid_map.origin) == (resolution, origin)
    assert grid_map.frame_id == "map"
    pixels = np.asarray(Image.open(path.with_suffix(".pgm")))
    assert np.array_equal(grid_map.free, pixels[::-1] >= free_from)


def test_the_top_row_of_the_image_is_the_highest_y(tmp_path):
    grid_map = read_nav2_map(write_map(tmp_path, grey([255, 0, 0], [0, 0, 255])))
    assert grid_map.free.tolist() == [[False, False, True], [True, False, False]]
    assert (grid_map.resolution, grid_map.origin) == (0.5, (1.0, 2.0, 0.25))


@pytest.mark.parametrize("suffix", ["pgm", "png", "bmp"])
def test_each_kind_of_image(tmp_path, suffix):
    path = write_map(tmp_path, grey([255, 0]), image=f"map.{suffix}")
    assert read_nav2_map(path).free.tolist() == [[True, False]]


def free_of(tmp_path: Path, picture: Image.Image, **changes: object) -> list[bool]:
    grid_map: GridMap = read_nav2_map(write_map(tmp_path, picture, **changes))
    return list(grid_map.free[0])


def test_trinary_is_free_strictly_below_the_free_threshold(tmp_path):
    # The darkness of 51 is exactly 0.8, that of 52 just below.
    found = free_of(tmp_path, grey([0, 51, 52, 255]), free_thresh=0.8, occupied_thresh=0.9)
    assert found == [False, False, True, True]


def test_negate_makes_black_free(tmp_path):
    assert free_of(tmp_path, grey([0, 128, 255]), negate=1) == [True, False, False]
    assert free_of(tmp_path, grey([0, 128, 255]), negate=True) == [True, False, False]


def test_scale_spreads_what_lies_between_the_thresholds_over_0_to_100(tmp_path):
    # Between 0.2 and 0.6 occupancy passes 49.5, which rounds to blocked, at a darkness of 0.398.
    image = grey([255, 154, 153, 50])
    changes = {"mode": "scale", "free_thresh": 0.2, "occupied_thresh": 0.6}
    assert free_of(tmp_path, image, **changes) == [True, True, False, False]
    assert free_of(tmp_path, image, **(changes | {"mode": "trinary"})) == [
        True,
        False,
        False,
        False,
    ]


def test_scale_with_equal_thresholds_leaves_the_threshold_itself_unknown(tmp_path):
    changes = {"mode": "scale", "free_thresh": 0.8, "occupied_thresh": 0.8}
    assert free_of(tmp_path, grey([255, 51, 0]), **changes) == [True, False, False]


def test_raw_takes_the_pixel_for_the_occupancy_and_ignores_negate(tmp_path):
    image = grey([0, 49, 50, 100, 101, 255])
    expected = [True, True, False, False, False, False]
    assert free_of(tmp_path, image, mode="raw") == expected
    assert free_of(tmp_path, image, mode="Raw", negate=1) == expected


def test_colours_are_averaged(tmp_path):
    image = Image.new("RGB", (2, 1))
    image.putpixel((0, 0), (255, 255, 90))  # mean 200, darkness 0.2157
    image.putpixel((1, 0), (255, 255, 60))  # mean 190, darkness 0.2549
    assert free_of(tmp_path, image) == [True, False]


def test_transparency_is_darkness_in_trinary_and_unknown_in_scale(tmp_path):
    image = Image.new("RGBA", (3, 1), (255, 255, 255, 255))
    image.putpixel((1, 0), (255, 255, 255, 10))  # mean of the four 193.75, darkness 0.2402
    image.putpixel((2, 0), (255, 255, 255, 0))  # mean of the four 191.25, darkness exactly 0.25
    assert free_of(tmp_path, image) == [True, True, False]
    assert free_of(tmp_path, image, mode="scale") == [True, False, False]


def test_sixteen_bits(tmp_path):
    image = Image.fromarray(np.array([[65535, 52429, 40000, 0]], dtype=np.uint16))
    assert free_of(tmp_path, image) == [True, True, False, False]


def test_an_image_of_one_bit_and_one_with_a_palette(tmp_path):
    assert free_of(tmp_path, grey([255, 0]).convert("1")) == [True, False]
    assert free_of(tmp_path, grey([255, 0]).convert("P")) == [True, False]


def test_an_image_path_starts_from_the_folder_of_the_yaml_file(tmp_path, monkeypatch):
    folder = tmp_path / "maps"
    (folder / "images").mkdir(parents=True)
    write_map(folder, grey([255]), image="images/map.png")
    monkeypatch.chdir(tmp_path)
    assert read_nav2_map(Path("maps/map.yaml")).free.tolist() == [[True]]
    write_map(folder, None, image=str(folder / "images" / "map.png"))
    assert read_nav2_map(folder / "map.yaml").free.tolist() == [[True]]


def test_a_number_that_yaml_takes_for_text(tmp_path):
    path = write_map(tmp_path, grey([255]))
    path.write_text(path.read_text().replace("resolution: 0.5", "resolution: 5e-2"))
    assert read_nav2_map(path).resolution == 0.05


def refusal(path: Path) -> str:
    """The sentence with which a map file is refused; it names the file and is one line."""
    with pytest.raises(InputError) as caught:
        read_nav2_map(path)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ")
    assert not sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize("key", sorted(SETTINGS))
def test_a_missing_key_is_named(tmp_path, key):
    path = write_map(tmp_path, grey([255]) if key != "image" else None, without=key)
    assert f"the key '{key}' is missing" in refusal(path)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"resolution": 0}, "resolution is 0.0 m"),
        ({"resolution": "fine"}, "'resolution' is 'fine'; it must be a finite number"),
        ({"resolution": [1]}, "'resolution' is [1]"),
        ({"free_thresh": float("nan")}, "'free_thresh' is nan"),
        ({"origin": [0.0, 0.0]}, "'origin' is [0.0, 0.0]; it must be three finite numbers"),
        ({"origin": 3}, "'origin' is 3"),
        ({"origin": [0, 0, float("inf")]}, "three finite numbers"),
        ({"mode": "quaternary"}, "'mode' is 'quaternary'; it must be one of trinary, scale, raw"),
        ({"occupied_thresh": -1}, "no cell of the map is free"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(tmp_path, changes, says):
    assert says in refusal(write_map(tmp_path, grey([255]), **changes))


def test_an_image_that_is_no_text(tmp_path):
    assert "'image' is 7" in refusal(write_map(tmp_path, None, image=7))


def test_a_missing_yaml_file(tmp_path):
    assert "No such file" in refusal(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"image: [map.png\norigin: 3", "not valid YAML at line 2"),
        (b"\xff\xfe\x00\xd8 no text", "not valid YAML"),
        (b"when: 2020-13-45", "not valid YAML"),
        (b"[" * 1000, "nested more than 100 levels deep"),
        (b"a: !!bool perhaps", "not valid YAML"),
        (b"", "holds no keys"),
        (b"- image", "holds no keys"),
    ],
)
def test_what_is_no_map_file(tmp_path, content, says):
    path = tmp_path / "map.yaml"
    path.write_bytes(content)
    assert says in refusal(path)


def test_a_missing_image_is_named(tmp_path):
    path = write_map(tmp_path, None)
    assert f"there is no image at {tmp_path / 'map.png'}" in refusal(path)


def test_an_image_that_is_none(tmp_path):
    path = write_map(tmp_path, None)
    (tmp_path / "map.png").write_text("this is no image")
    assert f"the image {tmp_path / 'map.png'} cannot be read" in refusal(path)


@pytest.mark.parametrize("suffix", ["pgm", "png", "bmp"])
def test_an_image_cut_off_anywhere(tmp_path, suffix):
    path = write_map(tmp_path, grey(*[[255] * 64] * 64), image=f"map.{suffix}")
    image = tmp_path / f"map.{suffix}"
    whole = image.read_bytes()
    for length in range(0, len(whole) // 2, 7):
        image.write_bytes(whole[:length])
        assert "cannot be read" in refusal(path)


def test_an_image_that_would_fill_the_memory_is_refused_by_its_header(tmp_path):
    path = write_map(tmp_path, None, image="map.pgm")
    image = tmp_path / "map.pgm"
    for width, says in ((8_000, "8000 x 8000 cells, more than"), (40_000, "is too large")):
        image.write_bytes(b"P5\n%d %d\n255\n" % (width, width))
        assert says in refusal(path)


def test_a_length_in_an_image_that_its_file_does_not_have_reserves_no_memory(tmp_path):
    path = write_map(tmp_path, grey([255, 255, 0]))
    image = tmp_path / "map.png"
    whole = image.read_bytes()
    length_at = whole.index(b"IDAT") - 4
    image.write_bytes(whole[:length_at] + b"\xff\xff\xff\xf0" + whole[length_at + 4 :])
    with limited_memory() as grown:
        assert read_nav2_map(path).free.tolist() == [[True, True, False]]
    assert grown() < 2**28
