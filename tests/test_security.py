"""What comes from others stays what it is: text is text, values are values, paths stay inside."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from PIL import Image

from bnirl_ros.bags.inspection import inspect
from bnirl_ros.confinement import inside, ros_folder
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.demonstration_bag import write_demonstration
from bnirl_ros.experiments.scenarios import PAPER_LOOP, shipped_demonstration
from bnirl_ros.maps import load_map
from bnirl_ros.safe_yaml import SIZE_LIMIT, load_yaml
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.results import write_contents
from bnirl_ros.views.waypoint_files import read_waypoints
from cli_support import Command

if TYPE_CHECKING:
    from ros_support import NodeProcess

ROOT = Path(__file__).resolve().parent.parent

FORBIDDEN_MODULES = {"cloudpickle", "dill", "jsonpickle", "marshal", "pickle", "shelve"}
"""Their load functions run what they are told to."""

FORBIDDEN_CALLS = {
    *("compile", "eval", "exec", "__import__"),
    *("os.popen", "os.system", "tempfile.mktemp"),
    *("np.load", "numpy.load", "np.fromfile", "pandas.read_pickle"),
    *("yaml.full_load", "yaml.unsafe_load", "yaml.load_all", "yaml.load"),
}
"""They run code of others, read what may be pickled, or open what has just been looked for."""

ALLOWED = {
    ("bnirl_ros/safe_yaml.py", "yaml.load"),
    ("bnirl_ros/inference/checkpoint.py", "np.load"),
}
"""With a safe loader; without pickles, behind a digest. Nothing else does."""


def calls_in(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """All calls by dotted names, such as np.load."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def faults_of(tree: ast.AST, file: str) -> list[str]:
    """What a module has that it must not have."""
    faults = []
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        faults += [name for name in names if name.partition(".")[0] in FORBIDDEN_MODULES]
    for name, call in calls_in(tree):
        words = {word.arg: word.value for word in call.keywords}
        if name in FORBIDDEN_CALLS and (file, name) not in ALLOWED:
            faults.append(name)
        for word, value in words.items():
            is_false = isinstance(value, ast.Constant) and value.value is False
            if word in ("allow_pickle", "shell") and not is_false:
                faults.append(f"{name}({word}=...)")
    return faults


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from cloudpickle import loads",
        "import os\nos.system('ls')",
        "import yaml\nyaml.load(text, Loader=yaml.Loader)",
        "np.load(file, allow_pickle=True)",
        "np.lib.format.read_array(file, allow_pickle=True)",
        "subprocess.run(words, shell=True)",
        "eval(text)",
    ],
)
def test_forbidden_calls_are_found(code: str) -> None:
    assert faults_of(ast.parse(code), "bnirl_ros/module.py")


def test_nothing_is_unpickled_nor_run() -> None:
    files = sorted([*(ROOT / "bnirl_ros").rglob("*.py"), *(ROOT / "launch").glob("*.py")])
    assert len(files) > 100
    faults = {}
    for path in files:
        file = str(path.relative_to(ROOT))
        faults[file] = faults_of(ast.parse(path.read_text(encoding="utf-8")), file)
    assert {file: found for file, found in faults.items() if found} == {}


# YAML


def nested_aliases(levels: int) -> str:
    """A few lines that stand for 9 ** levels values."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    for level in range(1, levels):
        lines.append(f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (nested_aliases(9), "stand for too much"),
        ("&a [*a]", "stand for too much"),
        ("a: &a {b: *a}", "stand for too much"),
        ("k: &k " + "x" * 10_000 + "\nl: [" + "*k, " * 10_000 + "]", "stand for too much"),
        ("[" * 100_000, "nested more than 100 levels"),
        ("{a: " * 100_000, "nested more than 100 levels"),
        ("- " * 100_000, "nested more than 100 levels"),
        (" " * (SIZE_LIMIT + 1), "more than 16 MiB"),
        ("!!python/object/apply:os.system [echo]", "not valid YAML"),
        ("!!python/name:os.system", "not valid YAML"),
        ("!!bool perhaps", "not valid YAML"),
        ("!!int ''", "not valid YAML"),
        ("!!timestamp soon", "not valid YAML"),
        ("0000-01-01", "not valid YAML"),
        ("0x" + "f" * 5000, "not valid YAML"),
        ("1" + ":30" * 1_000_000, "not valid YAML"),
        ("? [a, b]\n: 1\n? {}", "not valid YAML"),
        ("*nobody", "not valid YAML"),
    ],
    ids=range(18),
)
def test_yaml_that_runs_or_explodes_is_refused_in_a_sentence(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_yaml(text)


def test_honest_yaml_is_read() -> None:
    text = "base: &base {x: 1.5, when: 2020-01-02}\nother: {<<: *base, y: [*base, *base]}"
    base = {"x": 1.5, "when": date(2020, 1, 2)}
    assert load_yaml(text) == {"base": base, "other": {**base, "y": [base, base]}}
    assert load_yaml(b"") is None


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda values: st.lists(values, max_size=4) | st.dictionaries(st.text(), values, max_size=4),
    max_leaves=20,
)


@given(json_values)
def test_yaml_comes_back(value: Any) -> None:
    assert load_yaml(yaml.safe_dump(value)) == value


@given(
    st.text(st.sampled_from("ab:-[]{}&*!|>'\"<\n #%@`,?0159.eETZ+~=xo_\t\x00\x85é"), max_size=60)
)
def test_any_text_is_yaml_or_refused(text: str) -> None:
    with contextlib.suppress(InputError):
        load_yaml(text)


# Files


def test_paths_stay_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, outside = tmp_path / "folder", tmp_path / "outside"
    for each in (folder / "deep", outside):
        each.mkdir(parents=True)
    (folder / "out").symlink_to(outside)
    (folder / "back").symlink_to(folder / "deep")
    (folder / "round").symlink_to(folder / "round")
    (tmp_path / "same").symlink_to(folder)
    monkeypatch.chdir(folder)
    for path, place in {
        ".": folder,
        "new/new": folder / "new" / "new",
        "deep/../deep": folder / "deep",
        "back": folder / "deep",
        str(tmp_path / "same" / "x"): folder / "x",
        "out/../folder/x": folder / "x",
    }.items():
        assert inside(folder, Path(path), "it") == place.resolve()
        assert inside(tmp_path / "same", Path(path), "it") == place.resolve()
    for path in ("..", "/", "/etc/passwd", "out", "out/x", "deep/../../outside", f"{folder}2"):
        with pytest.raises(InputError, match=r"it: .* is outside of"):
            inside(folder, Path(path), "it")
    for path in ("null\0byte", "~nobody_of_this_name/x", "round", "round/x"):
        with pytest.raises(InputError, match=r"it: .* leads nowhere"):
            inside(folder, Path(path), "it")


def test_the_file_folder_follows_ros_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_HOME", "/somewhere")
    assert ros_folder() == Path("/somewhere/bnirl_ros")
    monkeypatch.delenv("ROS_HOME")
    assert ros_folder() == Path.home() / ".ros" / "bnirl_ros"


def test_links_that_lie_where_results_go_are_not_written_through(tmp_path: Path) -> None:
    folder, victim = tmp_path / "folder", tmp_path / "victim"
    folder.mkdir()
    victim.write_text("mine")
    for name in ("result", ".partial-result"):
        (folder / name).symlink_to(victim)
    write_contents(folder, {"result": b"theirs"})
    assert victim.read_text() == "mine"
    assert not (folder / "result").is_symlink()
    assert (folder / "result").read_bytes() == b"theirs"
    assert {each.name for each in folder.iterdir()} == {".partial-result", "result"}


def test_an_image_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "map.png")
    keys = "resolution: 1, origin: [0, 0, 0], negate: 0, occupied_thresh: 0.65, free_thresh: 0.2"
    path = tmp_path / "map.yaml"
    path.write_text(f"{{image: map.png, {keys}}}")
    with pytest.raises(InputError, match=r"map\.png is no file"):
        load_map(path)


@pytest.mark.parametrize("name", ["../other/other_0.mcap", "{folder}/other/other_0.mcap"])
def test_a_bag_reads_no_files_but_its_own(tmp_path: Path, name: str) -> None:
    for each in ("bag", "other"):
        shutil.copytree(ROOT / "bags" / PAPER_LOOP.name, tmp_path / each)
    metadata = tmp_path / "bag" / "metadata.yaml"
    own = f"{PAPER_LOOP.name}_0.mcap"
    (tmp_path / "other" / own).rename(tmp_path / "other" / "other_0.mcap")
    metadata.write_text(metadata.read_text().replace(own, name.format(folder=tmp_path)))
    inspection = inspect(tmp_path / "bag")
    assert [file.name for file in inspection.files] == [own]
    assert any("names other_0.mcap, which is not there" in each for each in inspection.warnings)


# Text from bags


HURTING = "<b>\x1b[31mred\x07\r\n\u202e\u2028$\\frac$\x9b2J"
"""A name that is markup, a formula, and what a terminal, a log or a reader would be misled by."""

CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u202e]")


def hurting_bag(folder: Path) -> Path:
    """The paper's loop in a frame of that name, with a topic of that name and type."""
    grid_map = dataclasses.replace(PAPER_LOOP.grid_map, frame_id=HURTING)
    write_demonstration(folder / "plain", shipped_demonstration(PAPER_LOOP), grid_map, 0.2)
    (file,) = (folder / "plain").glob("*.mcap")
    bag = folder / f"{HURTING}.mcap"
    with file.open("rb") as source, bag.open("wb") as target:
        writer = Writer(target)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                of = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", of)
            times = message.log_time, message.publish_time
            writer.add_message(channels[channel.id], *(times[:1]), message.data, times[1])
        of = writer.register_schema(HURTING, "ros2msg", b"int32 x")
        hurting = writer.register_channel(f"/{HURTING}", "cdr", of)
        writer.add_message(hurting, message.log_time, b"\0\1\0\0\0\0\0\0", message.log_time)
        writer.finish()
    return bag


def test_names_from_bags_do_nothing_to_a_terminal(tmp_path: Path, bnirl: Command) -> None:
    bag, out = hurting_bag(tmp_path), tmp_path / f"out{HURTING}"
    height, width = PAPER_LOOP.grid_map.free.shape
    Image.new("L", (width, height), 1).save(tmp_path / "rooms.png")
    keys = {"image": "rooms.png", "resolution": 1.0, "origin": [0, 0, 0], "labels": {1: HURTING}}
    rooms = tmp_path / "rooms.yaml"
    rooms.write_text(yaml.safe_dump(keys))
    options = ["--out", out, "--sweeps", "4", "--burn-in", "2", "--report"]
    told = [
        bnirl("bag", "info", bag),
        bnirl("infer", bag, *options),
        bnirl("infer", bag, *options, "--features", rooms),
        bnirl("infer", bag, "--each", *options),
        bnirl("waypoints", out / "subgoals.json", "--out", out),
        bnirl("infer", tmp_path / f"none{HURTING}"),
        bnirl("infer", bag, "--source", HURTING),
    ]
    assert [each.status for each in told] == [0, 0, 0, 0, 0, 1, 1]
    for each in told:
        assert not CONTROL.search(each.out + each.err), each
    assert r"<b>\x1b[31mred\x07\r\n\u202e" in told[0].out
    assert (out / "report.html").is_file()
    # As values they are what they were, and come back.
    assert json.loads((out / "subgoals.json").read_text())["frame_id"] == HURTING
    assert read_waypoints(out / "waypoints.yaml").frame_id == HURTING
    assert json.loads((out / "waypoints.geojson").read_text())["frame_id"] == HURTING


@given(st.text())
def test_plain_text_has_nothing_that_acts(text: str) -> None:
    told = plain(text)
    assert not CONTROL.search(told)
    assert "\n" not in told
    told.encode()
    if text.isprintable():
        assert told == text


def test_names_from_bags_do_nothing_to_the_terminal_of_a_node(
    start: Callable[..., NodeProcess], tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    end = start("replay_node", hurting_bag(tmp_path), "--fast", "--wait", "0.1").end()
    assert end.status == 0
    assert not CONTROL.search((end.out + end.err).replace("\x1b[33m", "").replace("\x1b[0m", ""))
    assert r"\x1b[31mred\x07\r\n" in end.out
