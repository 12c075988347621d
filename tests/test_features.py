"""Feature subgoals: sets of cells with equal features, from the file to the result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from PIL import Image

from bnirl_ros import cli
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.filtering import SubgoalFilter
from bnirl_ros.inference.posterior import infer, model_of
from bnirl_ros.inference.prediction import log_predictive
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps import FeatureMap, GridMap, load_features, with_features
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.candidates import Candidates, candidates_of
from bnirl_ros.views.markers import subgoal_markers
from bnirl_ros.views.messages import Marker
from bnirl_ros.views.results import subgoals_document, subgoals_in

# Three rooms, side by side, 1 left and 3 right of a hall 2.
ROOMS = np.array([[1, 1, 1, 2, 2, 2, 2, 3, 3, 3]] * 5)
MAP = GridMap(np.ones(ROOMS.shape, dtype=bool), resolution=0.5, origin=(-1.0, 2.0, 0.0))
QUICK = Settings(sweeps=300, burn_in=100, chains=2)
PAPER = replace(QUICK, model="paper")
MODELS = pytest.mark.parametrize("settings", [QUICK, PAPER], ids=["sequential", "paper"])


def labelled(labels: npt.ArrayLike, names: dict[tuple[int, ...], str] | None = None) -> GridMap:
    """MAP with a label for each cell."""
    coordinates = np.asarray(labels)[:, :, np.newaxis]
    return replace(
        MAP, features=FeatureMap(coordinates, np.ones(MAP.free.shape, bool), names or {})
    )


def shuttle(episodes: int = 12, seed: int = 0) -> Demonstration:
    """From the hall into room 3, from there into room 1, each time into another of its cells.

    The nearest cell of the room's first column, without noise: no single cell is a subgoal.
    """
    generator = np.random.default_rng(seed)
    observations, last = [], []
    for episode in range(episodes):
        cell = np.array([5, int(generator.integers(5))])
        for goal_x in (7, 2):
            while cell[0] != goal_x:
                # straight or diagonal are equally short along x
                up = int(generator.integers(-1, 2))
                step = np.array([np.sign(goal_x - cell[0]), up])
                if not 0 <= cell[1] + up < 5:
                    step[1] = 0
                observations.append([episode, *cell, np.flatnonzero((step == STEPS).all(1))[0]])
                cell = cell + step
        last.append(cell)
    rows = np.array(observations)
    return Demonstration(rows[:, 0], rows[:, 1:3], rows[:, 3], np.arange(episodes), np.array(last))


@MODELS
@pytest.mark.parametrize("kind", ["visited", "free"])
def test_a_state_subgoal_is_a_feature_subgoal_with_indicator_features(
    settings: Settings, kind: str
) -> None:
    settings = replace(settings, candidates=kind, sweeps=120, burn_in=20)
    demonstration = shuttle()
    # One number for each cell, in their order: every feature is that of one cell alone.
    as_cells = infer(demonstration, MAP, settings)
    as_features = infer(demonstration, labelled(np.arange(50).reshape(5, 10)), settings)
    for name in ("subgoal_of", "partition_of", "log_joint", "parameters"):
        np.testing.assert_array_equal(
            getattr(as_features.draws, name), getattr(as_cells.draws, name)
        )
    np.testing.assert_array_equal(as_features.mode.subgoal_of, as_cells.mode.subgoal_of)
    x, y = as_cells.candidates.coordinates.T
    np.testing.assert_array_equal(as_features.candidates.coordinates[:, 0], 10 * y + x)
    cells = summarise(as_cells, MAP).subgoals
    features = summarise(as_features, labelled(np.arange(50).reshape(5, 10))).subgoals
    assert [replace(each, feature=None, cells=()) for each in features] == list(cells)


@MODELS
def test_rooms_are_found_where_no_single_cell_is_a_subgoal(settings: Settings) -> None:
    grid_map = labelled(ROOMS, {(3,): "pantry"})
    posterior = infer(shuttle(), grid_map, settings)
    summary = summarise(posterior, grid_map)
    assert {subgoal.feature for subgoal in summary.subgoals} == {(1,), (3,)}
    assert all(subgoal.probability > 0.99 for subgoal in summary.subgoals)
    order = {subgoal.feature: subgoal.visit_order for subgoal in summary.subgoals}
    assert order == {(3,): (1,), (1,): (2,)}
    by_feature = {subgoal.feature: subgoal for subgoal in summary.subgoals}
    assert by_feature[3,].cells == tuple((x, y) for y in range(5) for x in (7, 8, 9))
    assert by_feature[3,].cell == (8, 2)
    assert by_feature[3,].name == "pantry"
    np.testing.assert_array_equal(summary.cell_probability[ROOMS == 3], 1.0)
    assert (summary.cell_probability[ROOMS == 2] < 0.5).all()


def test_arrival_in_a_room_is_where_its_first_cell_is_entered() -> None:
    grid_map = labelled(ROOMS)
    summary = summarise(infer(shuttle(), grid_map, QUICK), grid_map)
    for pursuit in summary.pursuits:
        assert pursuit.arrived
    # and with a radius, of a cell of half a metre, one cell before it
    demonstration, settings = shuttle(), replace(QUICK, arrival_radius=0.5)
    candidates, model = model_of(demonstration, grid_map, settings)
    visited = np.unique(GridWorld(MAP.free).states_of(demonstration.cells))
    in_x = visited % 10
    near = {(1,): in_x <= 3, (2,): (in_x >= 2) & (in_x <= 7), (3,): in_x >= 6}
    for index, feature in enumerate(map(tuple, candidates.coordinates.tolist())):
        np.testing.assert_array_equal(model.arrived[:, index], near[feature])  # type: ignore[union-attr]


def test_equal_features_in_two_parts_of_the_map_are_two_subgoals_of_the_sequential_model() -> None:
    free = MAP.free.copy()
    free[:, 5] = False
    grid_map = replace(
        labelled(np.where(np.arange(10) < 5, 7, 7) * np.ones((5, 1), int)), free=free
    )
    world = GridWorld(free)
    left, right = np.array([[0, 0], [1, 0]]), np.array([[8, 2], [9, 2]])
    cells = np.concatenate([left, right])
    both = Demonstration(
        np.array([0, 0, 1, 1]),
        cells,
        np.array([1, 1, 1, 1]),
        np.empty(0, int),
        np.empty((0, 2), int),
    )
    features = grid_map.features
    apart = candidates_of("visited", both, world, features, by_part=True)
    assert apart.coordinates.tolist() == [[7], [7]]
    assert apart.goals.sizes.tolist() == [25, 20]
    together = candidates_of("visited", both, world, features)
    assert together.coordinates.tolist() == [[7]]
    assert together.goals.sizes.tolist() == [45]
    # To the letter of Definition 3 in the paper's model; and both models run.
    assert len(infer(both, grid_map, replace(PAPER, sweeps=20, burn_in=0)).candidates) == 1
    assert len(infer(both, grid_map, replace(QUICK, sweeps=20, burn_in=0)).candidates) == 2


def test_only_what_was_seen_is_a_candidate_unless_all_is_asked_for() -> None:
    in_the_hall = shuttle(1).of_episodes([0])
    in_the_hall = replace(
        in_the_hall,
        episode=np.array([0]),
        cells=np.array([[4, 2]]),
        action=np.array([1]),
        last_cells=np.array([[7, 2]]),
    )
    world, features = GridWorld(MAP.free), labelled(ROOMS).features
    seen = candidates_of("visited", in_the_hall, world, features)
    assert seen.coordinates.tolist() == [[2], [3]]  # 3 by the last pose alone
    every = candidates_of("free", in_the_hall, world, features)
    assert every.coordinates.tolist() == [[1], [2], [3]]
    assert every.cells_of(1).tolist() == [[x, y] for y in range(5) for x in range(3, 7)]


@examples(max_examples=50)
@given(st.data())
def test_cells_reached_are_those_within_the_radius(data: st.DataObject) -> None:
    world = GridWorld(np.ones((6, 7), dtype=bool))
    member = st.integers(0, 41)
    members = st.lists(member, min_size=1, max_size=9)
    goals = Goals.of_sets(data.draw(st.lists(members, min_size=1, max_size=4)))
    cells = world.cells_of(data.draw(st.lists(member, min_size=1, max_size=8)))
    radius = data.draw(st.sampled_from([0.0, 0.5, 1.0, 1.5, 3.0]))
    candidates = Candidates(np.zeros((len(goals), 1), int), goals, world.cells_of(goals.states))
    chosen = data.draw(st.lists(st.integers(0, len(goals) - 1), max_size=4))
    reached = candidates.take(chosen).reached_in(world, cells, radius)
    assert reached.shape == (len(cells), len(chosen))
    for row, cell in enumerate(cells):
        for column, goal in enumerate(chosen):
            apart = np.linalg.norm(world.cells_of(goals[goal]) - cell, axis=1).min()
            assert reached[row, column] == (apart <= radius)


def test_features_that_cover_nothing_visited_are_refused_with_a_sentence() -> None:
    nowhere = FeatureMap(ROOMS[:, :, np.newaxis], np.zeros(ROOMS.shape, dtype=bool))
    with pytest.raises(InputError, match="no visited cell has features; check that"):
        infer(shuttle(), replace(MAP, features=nowhere), QUICK)
    free = MAP.free.copy()
    free[:, 5] = False
    left_only = FeatureMap(ROOMS[:, :, np.newaxis], ROOMS == 1)
    both = replace(
        shuttle(1),
        episode=np.array([0, 1]),
        cells=np.array([[1, 1], [8, 1]]),
        action=np.array([1, 1]),
    )
    with pytest.raises(InputError, match=r"cell \(8, 1\): no candidate can be reached from it"):
        infer(both, replace(MAP, free=free, features=left_only), QUICK)


def test_watching_and_predicting_work_with_features() -> None:
    grid_map = labelled(ROOMS)
    posterior = infer(shuttle(), grid_map, QUICK)
    watching = SubgoalFilter(posterior, grid_map)
    index_of = {tuple(c): i for i, c in enumerate(posterior.candidates.coordinates.tolist())}
    east = next(i for i, step in enumerate(STEPS.tolist()) if step == [1, 0])
    watching.observe((5, 2), east)
    belief = watching.observe((6, 2), east)
    assert belief[index_of[3,]] > 0.9
    foreseen = log_predictive(posterior, shuttle(4, seed=9), grid_map)
    assert -foreseen.mean() < 1.5 < np.log(9)  # three of nine moves are as good as each other


@MODELS
def test_the_whole_set_of_cells_is_shown(settings: Settings, tmp_path: Path) -> None:
    grid_map = labelled(ROOMS, {(1,): "kitchen"})
    summary = summarise(infer(shuttle(), grid_map, settings), grid_map)
    shown = subgoal_markers(summary, grid_map, 0).markers
    for subgoal in summary.subgoals:
        (cells,) = (each for each in shown if each.ns == "cells" and each.id == subgoal.rank)
        assert cells.type == Marker.CUBE_LIST
        # The pose of the marker is the map's origin, from which the points are measured.
        points = [
            (cells.pose.position.x + point.x, cells.pose.position.y + point.y)
            for point in cells.points
        ]
        np.testing.assert_allclose(points, grid_map.centres_of(subgoal.cells), atol=1e-12)
        assert [each.ns for each in shown if each.id == subgoal.rank and each.ns != "cells"] == [
            "subgoal",
            "heading",
            "label",
        ]
    document = json.loads(json.dumps(subgoals_document(summary, grid_map, settings)))
    for entry in document["subgoals"]:
        assert entry["cell"] is None
        assert len(entry["cells"]) == np.count_nonzero(entry["feature"][0] == ROOMS)
    assert subgoals_in(document) == summary.subgoals


# Files


def write_rooms(folder: Path, mode: str = "L", **keys: object) -> Path:
    """ROOMS as a palette or grey image with a YAML file, its top row the highest y."""
    image = Image.fromarray(ROOMS[::-1].astype(np.uint8), mode="L")
    if mode == "P":
        image = Image.frombytes("P", image.size, image.tobytes())
        image.putpalette([0, 0, 0, 255, 0, 0, 0, 255, 0, 0, 0, 255])
    image.save(folder / "rooms.png")
    described = {"image": "rooms.png", "resolution": 0.5, "origin": [-1.0, 2.0, 0.0], **keys}
    path = folder / "rooms.yaml"
    path.write_text(json.dumps(described))  # which is YAML, too
    return path


@pytest.mark.parametrize("mode", ["L", "P"])
def test_labels_are_read_from_greys_and_from_palettes(tmp_path: Path, mode: str) -> None:
    layer = load_features(write_rooms(tmp_path, mode))
    features = with_features(MAP, layer).features
    assert features is not None
    np.testing.assert_array_equal(features.coordinates[:, :, 0], ROOMS)
    assert features.known.all()


def test_labels_lie_where_their_own_origin_says_and_need_not_have_the_maps_cells(
    tmp_path: Path,
) -> None:
    fine = GridMap(np.ones((30, 44), dtype=bool), resolution=0.125, origin=(-1.25, 1.75, 0.0))
    features = with_features(fine, load_features(write_rooms(tmp_path))).features
    assert features is not None
    centres = fine.centres_of([[x, y] for y in range(30) for x in range(44)])
    there = MAP.cells_of(centres)
    known = MAP.contains(there)
    np.testing.assert_array_equal(features.known.reshape(-1), known)
    np.testing.assert_array_equal(
        features.coordinates.reshape(-1)[known], ROOMS[there[known, 1], there[known, 0]]
    )


def test_a_16_bit_pgm_holds_any_label(tmp_path: Path) -> None:
    greys = (np.arange(6).reshape(2, 3) * 1000).astype(">u2")
    (tmp_path / "r.pgm").write_bytes(b"P5 3 2 65535\n" + greys.tobytes())
    path = tmp_path / "r.yaml"
    path.write_text('{"image": "r.pgm", "resolution": 1, "origin": [0, 0, 0]}')
    small = GridMap(np.ones((2, 3), dtype=bool))
    features = with_features(small, load_features(path)).features
    assert features is not None
    np.testing.assert_array_equal(features.coordinates[:, :, 0], greys[::-1].astype(int))


def test_a_table_of_numbers_has_the_maps_cells(tmp_path: Path) -> None:
    path = tmp_path / "rooms.txt"
    np.savetxt(path, ROOMS[::-1], fmt="%d")
    features = with_features(MAP, load_features(path)).features
    assert features is not None
    np.testing.assert_array_equal(features.coordinates[:, :, 0], ROOMS)
    with pytest.raises(InputError, match=r"rooms.txt: has 10 x 5 labels, the map 3 x 2 cells"):
        with_features(GridMap(np.ones((2, 3), dtype=bool)), load_features(path))


def test_features_of_places_are_manhattan_distances(tmp_path: Path) -> None:
    path = tmp_path / "places.yaml"
    # The centres of (0, 0) and, a little aside of it, of (9, 4)
    path.write_text("places:\n  dock: [-0.75, 2.25]\n  sink: [3.8, 4.3]\n")
    features = with_features(MAP, load_features(path)).features
    assert features is not None
    x, y = np.arange(10)[np.newaxis, :], np.arange(5)[:, np.newaxis]
    np.testing.assert_array_equal(features.coordinates[:, :, 0], x + y)
    np.testing.assert_array_equal(features.coordinates[:, :, 1], 9 - x + 4 - y)
    path.write_text("places:\n  dock: [-0.75, 2.25]\nstep: 1.5\n")
    features = with_features(MAP, load_features(path)).features
    assert features is not None
    np.testing.assert_array_equal(features.coordinates[:, :, 0], (x + y) // 3)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("f.csv", "1", "f.csv: features are a layer of labels"),
        ("f.txt", "1 2\n3", "f.txt: this is no table of whole numbers"),
        ("f.txt", "1 a", "f.txt: this is no table of whole numbers"),
        ("f.txt", "", "f.txt: holds no numbers"),
        ("f.txt", "99999999999999999999", "f.txt: this is no table of whole numbers"),
        ("f.yaml", "- 1", "f.yaml: this YAML holds no keys; features have either places"),
        ("f.yaml", "a: [", "f.yaml: this is not valid YAML at line"),
        ("f.yaml", "a: 1", "f.yaml: the key 'resolution' is missing"),
        ("f.yaml", "places: {}", "f.yaml: 'places' is {}"),
        ("f.yaml", "places: {a: [1]}", r"place a is \[1\]; it must be \[x, y\] in metres"),
        ("f.yaml", "places: {a: [1, .inf]}", r"place a is \[1, inf\]"),
        ("f.yaml", "places: {a: [1, 2]}\nstep: 0", "'step' is 0; it must be 1e-06 metres or more"),
    ],
)
def test_a_file_that_tells_no_features_is_refused_with_a_sentence(
    tmp_path: Path, name: str, content: str, sentence: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=sentence):
        load_features(tmp_path / name)


def test_labels_in_colours_or_stretched_greys_are_refused(tmp_path: Path) -> None:
    path = write_rooms(tmp_path)
    Image.new("RGB", (10, 5)).save(tmp_path / "rooms.png")
    with pytest.raises(InputError, match="has colours, or greys up to another than 255"):
        load_features(path)
    path = write_rooms(tmp_path, image="rooms.pgm")
    (tmp_path / "rooms.pgm").write_bytes(b"P5 2 1 3\n\x01\x03")
    with pytest.raises(InputError, match="has colours, or greys up to another than 255"):
        load_features(path)
    with pytest.raises(InputError, match="'labels' is"):
        load_features(write_rooms(tmp_path, labels=["kitchen"]))
    with pytest.raises(InputError, match="there is no image at"):
        load_features(write_rooms(tmp_path, image="none.png"))


@pytest.mark.parametrize("model", ["sequential", "paper"])
def test_the_command_finds_rooms(
    tmp_path: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.txt").write_text("\n".join(["." * 10] * 5) + "\n")
    np.savetxt(tmp_path / "rooms.txt", ROOMS[::-1], fmt="%d")
    names = ["stay", "E", "NE", "N", "NW", "W", "SW", "S", "SE"]
    rows = [f"{e},{x},{y},{names[a]}" for e, x, y, a in shuttle().observations.tolist()]
    (tmp_path / "walk.csv").write_text("episode,x,y,action\n" + "\n".join(rows) + "\n")
    given = ["infer", tmp_path / "walk.csv", "--map", tmp_path / "map.txt", "--model", model]
    given += ["--features", tmp_path / "rooms.txt", "--candidates", "free", "--sweeps", "200"]
    given += ["--burn-in", "50", "--out", tmp_path / "out"]
    assert cli.main([str(word) for word in given]) == 0
    table = capsys.readouterr().out
    assert "feature" in table.splitlines()[0]
    document = json.loads((tmp_path / "out" / "subgoals.json").read_text())
    assert {tuple(entry["feature"]) for entry in document["subgoals"]} == {(1,), (3,)}
    with np.load(tmp_path / "out" / "posterior.npz") as arrays:
        np.testing.assert_array_equal(arrays["candidates"], [[1], [2], [3]])
    assert (tmp_path / "out" / "subgoals.png").read_bytes().startswith(b"\x89PNG")
    given[given.index("--features") + 1] = tmp_path / "none.txt"
    assert cli.main([str(word) for word in given]) == 1
    assert "none.txt: the features cannot be read" in capsys.readouterr().err
