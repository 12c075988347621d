"""The study counts as it says: by hand, on small cases."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.overcooked import LAYOUTS
from bnirl_ros.experiments.paper.courses import RIVAL_NAMES
from bnirl_ros.experiments.study import (
    cost,
    intent,
    kitchens,
    next_action,
    reliability,
    robustness,
    turtle,
)
from bnirl_ros.experiments.study.__main__ import PARTS, main
from bnirl_ros.experiments.study.intervals import ratio_interval, wilson
from bnirl_ros.experiments.study.part import MODELS, Part, settings_of
from bnirl_ros.experiments.study.report import Table, share
from bnirl_ros.experiments.study.scores import (
    apart,
    goes_round,
    matches,
    nearest_within,
    top_hits,
    visits,
)
from bnirl_ros.experiments.study.simulated import (
    Demonstrator,
    Leg,
    demonstrate,
    itinerary,
    random_map,
    random_subgoals,
)
from bnirl_ros.inference.posterior import grid_world
from bnirl_ros.inference.scoring import WITHOUT_MODEL, losses
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Pursuit, Subgoal, Summary, nothing_found
from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES, STEPS
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.pursuits import PursuitModel, pursuit_model

# What is found against what is true


def test_top_hits_count_true_cells_among_as_many_first_ones() -> None:
    truth = [(0, 0), (1, 1), (2, 2)]
    assert top_hits([(0, 0), (9, 9), (2, 2), (1, 1)], truth) == 2
    assert top_hits([(1, 1)], truth) == 1
    assert top_hits([], truth) == 0


def test_matches_within_reach_count_once() -> None:
    truth = [(2, 2), (8, 2)]
    assert matches(truth, [(2, 2), (3, 3), (5, 2)], 0) == 1
    assert matches(truth, [(3, 3), (2, 3), (7, 1)], 0) == 0
    assert matches(truth, [(3, 3), (2, 3), (7, 1)], 1) == 2
    assert matches(truth, [], 1) == 0
    assert matches([], [(0, 0)], 1) == 0


def test_nearest_place_within_reach() -> None:
    places = [(0.0, 0.0), (1.0, 0.0)]
    positions = [(0.1, 0.0), (1.0, 0.75), (1.0, 0.76), (0.6, 0.0)]
    assert nearest_within(positions, places, 0.75) == [0, 1, None, 1]
    assert nearest_within([], places, 0.75) == []


def test_visits_are_places_without_repeats_in_a_row() -> None:
    assert visits([None, 2, None, 2, 3, 3, 2, None]) == [2, 3, 2]


@pytest.mark.parametrize(
    ("visited", "goes"),
    [
        ([], True),
        ([3], True),
        ([0, 1, 2, 3], True),
        ([2, 3, 0, 1, 2, 3, 0], True),
        ([3, 0, 2], True),  # 1 was not found
        ([0, 2, 1, 3], False),
        ([0, 1, 0, 2, 3], False),
        ([0, 1, 2, 3, 0, 2], False),  # found in the first lap, passed over in the second
    ],
)
def test_order_up_to_rotation(visited: list[int], goes: bool) -> None:
    assert goes_round(visited, range(4)) is goes


# Intervals


def test_wilson_is_the_published_interval() -> None:
    # Newcombe (1998), table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29.
    for successes, trials, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)
    assert wilson(20, 20)[1] == 1.0


def test_ratio_interval_covers_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        chance = generator.beta(8, 2, size=60)  # demonstrations differ
        wholes = generator.integers(1, 6, size=60)
        low, high = ratio_interval(generator.binomial(wholes, chance), wholes, generator)
        covered += low <= 0.8 <= high
    assert 180 <= covered <= 199


def test_ratio_interval_of_certainty_is_a_point() -> None:
    interval = ratio_interval([2, 3], [2, 3], np.random.default_rng(0))
    assert interval == (1.0, 1.0)


def test_tables_are_markdown() -> None:
    rows = (("a", share(0.934, (0.9, 0.957))), ("b", "1"))
    table = Table(title="Title", text="Text.", header=("model", "found"), rows=rows)
    assert table.markdown() == (
        "### Title\n\nText.\n\n| model | found |\n| --- | :-: |\n| a | 93 (90-96) |\n| b | 1 |\n"
    )


def test_the_settings_are_the_shipped_ones_but_for_the_chains() -> None:
    for model in MODELS:
        assert replace(settings_of(model), chains=Settings().chains) == Settings(model=model)
    # The sequential model's parameters are inferred, so that nobody tunes anything.
    assert settings_of("sequential").fixed == {}
    assert settings_of("paper").fixed == {"alpha": 50.0, "eta": 1.0}
    given = {"eta": 2.0, "slip": 0.0}
    assert settings_of("sequential", **given).fixed == given
    assert settings_of("paper", eta=2.0).fixed == {"alpha": 50.0, "eta": 2.0}


def shortly(monkeypatch: pytest.MonkeyPatch, part: ModuleType) -> None:
    """Let the cases of a part sweep for a short while."""

    def short(model: str, **others: Any) -> Settings:
        return settings_of(model, **(others | {"sweeps": 60, "burn_in": 20}))

    monkeypatch.setattr(part, "settings_of", short)


# The turtle


def turtle_summary(*cells: tuple[int, int], pursued: Sequence[int] = ()) -> Summary:
    """Subgoals in these cells of 0.5 m, visited by rank, or pursued as said."""
    grid_map = GridMap(np.ones((23, 23), dtype=bool), 0.5)
    positions = grid_map.centres_of(np.array(cells))
    return replace(
        nothing_found(grid_map),
        subgoals=tuple(
            Subgoal(rank, cell, (float(x), float(y)), 1.0, 1, ())
            for rank, (cell, (x, y)) in enumerate(zip(cells, positions, strict=True), start=1)
        ),
        visit_sequence=tuple(range(1, len(cells) + 1)),
        pursuits=tuple(Pursuit(0, rank, 0, 0, True) for rank in pursued),
    )


def test_score_of_the_turtle() -> None:
    # Centres (4.25, 5.25), (3.75, 5.75), (0.25, 0.25), (1.25, 1.75), (2.25, 9.25) [m].
    cells = [(8, 10), (7, 11), (0, 0), (2, 3), (4, 18)]
    score = turtle.score(turtle_summary(*cells))
    assert (score.found, score.strays, score.duplicates) == (3, 1, 1)
    assert (score.visited, score.in_order) == ([0, 1, 2], True)
    # Rank 3 is at no waypoint, rank 2 at that of rank 1.
    score = turtle.score(turtle_summary(*cells, pursued=(5, 1, 3, 2, 4, 5, 1)))
    assert (score.visited, score.in_order) == ([2, 0, 1, 2, 0], True)
    score = turtle.score(turtle_summary(*cells, pursued=(5, 1, 4, 1)))
    assert (score.visited, score.in_order) == ([2, 0, 1, 0], False)


def test_the_turtle_is_told_of_every_model_and_seed() -> None:
    cases = turtle.cases(Path())
    assert [case.model for case in cases] == [each for each in MODELS for _ in range(10)]
    assert [case.seed for case in cases] == [*range(10)] * len(MODELS)


def test_the_table_of_the_turtle(monkeypatch: pytest.MonkeyPatch) -> None:
    shortly(monkeypatch, turtle)
    results = [turtle.run(turtle.Case(model, seed=3)) for model in MODELS]
    for model, result in zip(MODELS, results, strict=True):
        assert (result["model"], result["seed"]) == (model, 3)
        found = result["found"] + result["strays"] + result["duplicates"]
        assert len(result["positions"]) == found
    rows = turtle.table(results).rows
    assert [row[:2] for row in rows] == [
        (model, f"{result['found']} of 6") for model, result in zip(MODELS, results, strict=True)
    ]
    # Least and most of several seeds.
    other = results[0] | {"seed": 4, "found": 2, "strays": 9, "in_order": True}
    result = results[0] | {"found": 6, "strays": 1, "in_order": False}
    ((model, found, strays, _, in_order),) = turtle.table([result, other]).rows
    assert (model, found, strays, in_order) == (MODELS[0], "2-6 of 6", "1-9", "1 of 2 times")


# The kitchens


def test_true_cells_have_their_share_of_the_interactions() -> None:
    interactions = np.repeat([[1, 1], [2, 1], [3, 1]], [64, 3, 33], axis=0)
    assert kitchens.true_cells(interactions) == {(1, 1), (2, 1), (3, 1)}
    interactions = np.repeat([[1, 1], [2, 1], [3, 1]], [65, 2, 33], axis=0)
    assert kitchens.true_cells(interactions) == {(1, 1), (3, 1)}


def test_rankings_without_a_model(tmp_path: Path) -> None:
    rows = ["0,0,1,1,.,0", "0,1,1,1,E,0", "0,2,2,1,I,1", "0,3,2,1,W,0", "0,4,1,1,.,0"]
    rows += ["1,0,1,1,E,0", "1,1,2,1,E,0", "1,2,3,1,I,0", "1,3,3,1,I,1", "1,4,3,1,.,0"]
    csv = "\n".join(["episode,t,x,y,action,interact_ok", *rows])
    (tmp_path / "tiny.csv").write_text(csv, encoding="utf-8")
    (tmp_path / "tiny.grid.txt").write_text("XXXXX\nX   X\nXXXXX\n", encoding="utf-8")
    # (1, 1): 4 steps, 3 entries; (2, 1): 3 and 2; (3, 1): 3 and 1.
    assert kitchens.rank_by_dwell(tmp_path, "tiny") == [(1, 1), (2, 1), (3, 1)]
    assert kitchens.rank_by_visits(tmp_path, "tiny") == [(1, 1), (2, 1), (3, 1)]
    assert kitchens.rank_by_stays(tmp_path, "tiny") == [(3, 1), (2, 1)]
    result = kitchens.run(kitchens.Case(tmp_path, "tiny", "visits"))
    assert (result["true"], result["hits"]) == ([(2, 1), (3, 1)], 1)


def test_an_episodes_first_cell_is_entered() -> None:
    paths = np.array([[0, 1, 1], [0, 1, 1], [0, 2, 1], [1, 2, 1], [1, 1, 1]])
    assert kitchens.entries(paths).tolist() == [[1, 1], [2, 1], [2, 1], [1, 1]]


@pytest.mark.parametrize("part", [kitchens.PART, next_action.PART, intent.PART])
def test_parts_without_their_recordings_say_so(part: Part, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"random3.*cannot be read|there is no such folder"):
        part.cases(tmp_path / "nowhere")


# The next action

CORRIDOR = GridMap(np.array([[True, True, False]]))


def in_corridor(*steps: tuple[int, int, str]) -> Demonstration:
    """Observations (episode, x, action) in the corridor of two cells."""
    episode, x, names = zip(*steps, strict=True)
    return Demonstration(
        episode=np.array(episode),
        cells=np.column_stack([x, np.zeros(len(x), dtype=np.int64)]),
        action=np.array([ACTION_NAMES.index(name) for name in names]),
        last_episode=np.empty(0, dtype=np.int64),
        last_cells=np.empty((0, 2), dtype=np.int64),
    )


def test_every_model_has_a_simulator() -> None:
    assert list(reliability.SIMULATORS) == list(MODELS)


def test_a_trials_actions_are_drawn_together() -> None:
    loss, trial = np.array([1.0, 1.0, 1.0, 0.0, 0.0]), np.array([4, 4, 4, 9, 9])
    mean, low, high = next_action.of_trials(loss, trial) or (-1.0, -1.0, -1.0)
    # Drawn again are both trials, or one of them twice: a quarter of the time each.
    assert (mean, low, high) == (0.6, 0.0, 1.0)
    assert next_action.of_trials(np.array([1.0, np.inf]), trial[:2]) is None


TO_THE_RIGHT = ((0, "E"), (1, "stay"), (1, "stay"))


@pytest.mark.parametrize("learner", [*MODELS, *RIVAL_NAMES, next_action.NO_MODEL])
def test_every_learner_is_measured_on_what_it_has_not_seen(
    learner: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if RIVAL_NAMES.get(learner) == "abbeel_ng":
        pytest.importorskip("clarabel")
    quick = dict(sweeps=30, burn_in=10, chains=1)
    monkeypatch.setattr(
        next_action, "settings_of", lambda model, **other: Settings(model=model, **quick, **other)
    )
    learnt = in_corridor(*[(number, *step) for number in range(5) for step in TO_THE_RIGHT])
    held_out = in_corridor((2, 0, "E"), (2, 1, "W"))
    world = grid_world(CORRIDOR, Settings(moves=4))
    told = next_action.foreseen_by(learner, learnt, held_out, CORRIDOR)
    for probability in told.values():
        assert probability.shape == (2, 5)
        np.testing.assert_allclose(probability.sum(axis=1), 1.0)
        log = losses(probability, held_out, world).log
        if learner != next_action.NO_MODEL:
            assert log[0] < log[1]
    expected = {
        next_action.NO_MODEL: list(WITHOUT_MODEL),
        **{model: [f"{model}, predictive", f"{model}, (19)"] for model in MODELS},
    }
    assert list(told) == expected.get(learner, [learner])


def test_a_rivals_confidence_is_the_one_that_suits_what_it_learnt_from() -> None:
    # Q* tells in the left cell only, where it is 2 better to go; seen is E three times of four.
    learnt = in_corridor(*[(0, 0, name) for name in ("E", "E", "stay", "E")], (0, 1, "stay"))
    held_out = in_corridor((2, 0, "E"), (2, 1, "W"))
    world = grid_world(CORRIDOR, Settings(moves=4))
    values = np.zeros((3, 5))
    values[0, 1] = 2.0
    told = next_action.predict_by_values(values, learnt, held_out, world)
    # Going and staying are what can be done, each one action however it is done.
    expected = [[0.25 / 4, 0.75, *[0.25 / 4] * 3], [0.5 / 4] * 3 + [0.5, 0.5 / 4]]
    np.testing.assert_allclose(told, expected, atol=1e-3)
    # Where no action is better than another, none is more probable.
    alike = next_action.predict_by_values(np.zeros((3, 5)), learnt, held_out, world)
    np.testing.assert_allclose(alike[0], [0.5 / 4, 0.5, *[0.5 / 4] * 3])


def test_the_table_has_both_losses_of_every_prediction() -> None:
    results = [
        {
            "layout": layout,
            "held_out": 10,
            "trials": 2,
            "loss": {
                "one": {"log": (0.5, 0.4, 0.6), "0-1": (0.25, 0.2, 0.3)},
                "other": {"log": None, "0-1": (0.5, 0.5, 0.5)},
            },
        }
        for layout in LAYOUTS
    ]
    rows = next_action.table(results).rows
    assert rows[0] == ("one", "log", *["0.500 (0.400-0.600)"] * 3)
    assert rows[1] == ("other", "log", *["infinite"] * 3)
    assert rows[2] == ("one", "0-1 [%]", *["25.0 (20.0-30.0)"] * 3)


# What is gone for now


def test_legs_lead_from_one_arrival_to_the_next() -> None:
    walked = in_corridor(
        *[(3, 0, "E"), (3, 1, "W"), (3, 0, "stay"), (3, 0, "stay"), (3, 0, "E"), (3, 1, "W")],
        *[(3, 0, "E"), (3, 1, "stay")],
        *[(4, 0, "E"), (4, 1, "W"), (4, 0, "E")],
    )
    arrivals = [(2, 0), (3, 0), (7, 1), (10, 1)]
    # The second stay is no leg. Who arrives by a move leaves with the next one.
    assert intent.legs_between(walked, arrivals) == [
        intent.Leg(first=0, steps=2, goal=0),
        intent.Leg(first=4, steps=3, goal=1),
        intent.Leg(first=8, steps=2, goal=1),
    ]
    passing = intent.legs_between(walked, [(4, 0), (6, 1)])
    assert passing[1] == intent.Leg(first=4, steps=2, goal=1)


def test_a_goal_is_named_for_good_after_the_last_doubt() -> None:
    course = intent.Course(0, right=[0.6, 0.2, 0.4, 0.3], wrong=[0.1, 0.6, 0.4, 0.2])
    assert [course.named(step) for step in range(4)] == [True, False, False, True]
    assert course.named_after == 3
    assert intent.Course(0, [0.2, 0.7], [0.1, 0.1]).named_after == 0
    assert intent.Course(0, [0.6, 0.4], [0.1, 0.5]).named_after == 2  # never
    assert [course.step_at(moment) for moment in (0.0, 0.25, 0.5, 0.75, 1.0)] == [0, 1, 2, 3, 3]
    assert intent.Course(0, [0.5] * 3, [0.5] * 3).step_at(0.5) == 1


def test_courses_tell_the_belief_on_the_way() -> None:
    held_out = in_corridor((0, 0, "E"), (0, 1, "W"), (0, 0, "E"), (0, 1, "stay"))
    watched = intent.Watched(
        learnt=held_out,
        held_out=held_out,
        grid_map=CORRIDOR,
        legs=[intent.Leg(first=1, steps=2, goal=1)],
        places=[{(1, 0)}, {(0, 0), (5, 5)}],
        group=[7],
        settings=Settings(),
    )
    before = np.array([[0.5, 0.5], [0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])
    after = np.array([[0.6, 0.4], [0.75, 0.25], [0.9, 0.1], [1.0, 0.0]])
    (course,) = intent.courses_of(watched, [(0, 0), (1, 0)], before, after)
    assert course == intent.Course(7, right=[0.1, 0.75], wrong=[0.9, 0.25])
    # A place where no subgoal was found is never told.
    (course,) = intent.courses_of(watched, [(2, 0), (1, 0)], before, after)
    assert course == intent.Course(7, right=[0.0, 0.0], wrong=[0.9, 0.75])


def test_the_turtle_arrives_at_its_waypoints_in_order() -> None:
    ends = np.array(intent.WAYPOINTS)
    way = np.concatenate([ends[:2], ends[3:4], ends[2:], ends[:2] + 0.5])
    arrivals = intent.waypoint_arrivals(way)
    assert arrivals == [(0, 0), (1, 1), (3, 2), (4, 3), (5, 4), (6, 5), (7, 0), (8, 1)]


@pytest.mark.parametrize("source", list(intent.SOURCES)[:2])
def test_what_the_turtle_goes_for_is_measured(
    source: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = dict(sweeps=200, burn_in=100, chains=1)
    monkeypatch.setattr(intent, "settings_of", lambda model: Settings(model=model, **quick))
    result = intent.run(intent.Case(Path(), source))
    courses = [intent.Course(**course) for course in result["courses"]]
    assert len(courses) == (9 if source.endswith("drive") else 3)
    assert sum(len(course.right) for course in courses) <= 134
    for course in courses:
        assert 0.0 <= min(course.right) <= max(course.right) <= 1.0
        assert course.right[-1] > course.right[0]  # it comes to know
    told = intent.table([{**result, "source": name} for name in intent.SOURCES]).markdown()
    assert f"| legs |{f' {len(courses)} |' * len(intent.SOURCES)}" in told
    assert told.count("\n| its probability ") == len(intent.MOMENTS)
    assert told.count("\n|") == 2 + 2 + len(intent.MEASURES)


def test_a_mean_over_legs_is_drawn_again_by_groups() -> None:
    sure, never = intent.Course(1, [0.9, 0.9], [0.0, 0.0]), intent.Course(2, [0.1], [0.9])
    value, (low, high) = intent.mean([sure, sure, sure, never], lambda course: course.right[0])
    assert value == pytest.approx(0.7)
    assert (low, high) == (0.1, 0.9)


def test_kitchens_are_watched_where_nobody_learnt(tmp_path: Path) -> None:
    # Four episodes, two trials: from one end to the other, to interact there, and back.
    (tmp_path / "hall.grid.txt").write_text("XXXXXX\nX    X\nXXXXXX\n")
    there = [(x, "E") for x in (1, 2, 3)] + [(4, "I")]
    back = [(x, "W") for x in (4, 3, 2)] + [(1, "I")]
    rows = [
        f"{episode},{time},{x},1,{action},{int(action == 'I')}"
        for episode in range(4)
        for time, (x, action) in enumerate(there + back)
    ]
    header = "episode,t,x,y,action,interact_ok"
    (tmp_path / "hall.csv").write_text("\n".join([header, *rows]))
    watched = intent.of_kitchen(tmp_path, "hall")
    assert set(watched.learnt.episode) == {0, 1}
    assert set(watched.held_out.episode) == {2, 3}
    assert watched.places == [{(1, 1)}, {(4, 1)}]
    assert watched.legs == [
        intent.Leg(first, 3, goal) for first, goal in ((0, 1), (4, 0), (8, 1), (12, 0))
    ]
    assert watched.group == [1, 1, 1, 1]


def test_players_of_a_trial_stay_together() -> None:
    demonstration = in_corridor(*((episode, 0, "E") for episode in range(7)))
    demonstration = replace(demonstration, last_episode=np.array([1, 2]), last_cells=np.eye(2))
    learnt, held_out = next_action.split_trials(demonstration)
    assert (learnt.episode.tolist(), held_out.episode.tolist()) == ([0, 1, 4, 5], [2, 3, 6])
    assert (learnt.last_episode.tolist(), held_out.last_episode.tolist()) == ([1], [2])


# Simulated demonstrators


@pytest.mark.parametrize("seed", range(5))
def test_every_free_cell_of_a_random_map_is_within_reach(seed: int) -> None:
    grid_map = random_map(np.random.default_rng(seed))
    world = grid_world(grid_map, Settings())
    free = np.flatnonzero(world.free)
    values = goal_values(world, free, free)
    assert 0.6 * grid_map.free.size <= len(free) < grid_map.free.size
    assert (values.max(axis=1) > 0.0).all()


def test_random_subgoals_lie_apart() -> None:
    generator = np.random.default_rng(0)
    grid_map = random_map(generator)
    subgoals = random_subgoals(grid_map, generator)
    assert len(set(subgoals)) == 4
    assert grid_map.is_free(subgoals).all()
    assert all(apart(one, other) >= 4 for one, other in combinations(subgoals, 2))


def legs_of(demonstrator: Demonstrator, subgoals: list[tuple[int, int]]) -> list[Leg]:
    """The legs of many episodes on an open map."""
    generator = np.random.default_rng(0)
    grid_map = GridMap(np.ones((15, 15), dtype=bool))
    return [
        leg for _ in range(200) for leg in itinerary(demonstrator, subgoals, grid_map, generator)
    ]


def test_habits_show_in_the_legs() -> None:
    subgoals = [(0, 0), (7, 0), (0, 7), (7, 7)]
    plain = legs_of(Demonstrator(), subgoals)
    assert len(plain) == 2400
    assert all(leg.target == leg.subgoal and leg.share == np.inf for leg in plain)
    counts = np.array([sum(leg.subgoal == subgoal for leg in plain) for subgoal in subgoals])
    assert (np.diff(counts) < 0).all()  # those with more weight more often
    episode = plain[:12]
    assert all(one.subgoal != other.subgoal for one, other in pairwise(episode))

    detours = legs_of(Demonstrator(detours=0.3), subgoals)
    assert 0.27 < sum(leg.subgoal is None for leg in detours) / 2400 < 0.33
    minds = legs_of(Demonstrator(changes_of_mind=0.3), subgoals)
    assert 0.27 < sum(leg.share == 0.5 for leg in minds) / 2400 < 0.33
    sloppy = legs_of(Demonstrator(sloppiness=1), subgoals)
    assert {leg.target for leg in sloppy if leg.subgoal == (0, 0)} == {
        (x, y) for x in (0, 1) for y in (0, 1)
    }


@pytest.mark.parametrize(
    "demonstrator",
    [
        Demonstrator(),
        Demonstrator(success=1.0, noise=0.0),
        Demonstrator(detours=0.3, pauses=0.1, changes_of_mind=0.3, sloppiness=1),
    ],
)
def test_demonstrations_are_walks_that_end_where_they_say(demonstrator: Demonstrator) -> None:
    generator = np.random.default_rng(3)
    grid_map = random_map(generator)
    demonstration, truth = demonstrate(demonstrator, grid_map, generator)
    assert grid_map.is_free(demonstration.cells).all()
    assert demonstration.last_episode.tolist() == [0, 1, 2]
    world = grid_world(grid_map, Settings())
    for episode in range(3):
        cells = demonstration.cells[demonstration.episode == episode]
        path = world.states_of(np.concatenate([cells, demonstration.last_cells[[episode]]]))
        assert (path[1:, None] == world.outcomes()[path[:-1]]).any(axis=1).all()
    assert 1 <= len(truth) <= 4
    if not demonstrator.sloppiness:
        everywhere = np.concatenate([demonstration.cells, demonstration.last_cells]).tolist()
        assert all(list(cell) in everywhere for cell in truth)


def test_standing_still_is_all_that_a_pause_adds() -> None:
    grid_map = GridMap(np.ones((15, 15), dtype=bool))
    still = Demonstrator(success=1.0, noise=0.0, pauses=0.2)
    demonstration, _ = demonstrate(still, grid_map, np.random.default_rng(0))
    stays = demonstration.action == ACTION_NAMES.index("stay")
    steps = np.diff(demonstration.cells, axis=0)
    within = np.diff(demonstration.episode) == 0
    np.testing.assert_array_equal(
        STEPS[demonstration.action[:-1]][within], steps[within]
    )  # with success 1 every action leads where it points
    # A fifth of the steps are preceded by 3 to 6 of standing still.
    assert 0.35 < stays.mean() < 0.6


@pytest.mark.parametrize("model", MODELS)
def test_a_case_of_the_robustness_table(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    monkeypatch.setattr(robustness, "SWEEPS", {"sweeps": 60, "burn_in": 20})
    case = robustness.Case(model, "as assumed", 0)
    result = robustness.run(case)
    assert result == robustness.run(case)
    assert result["exact"] <= result["near"] <= min(result["true"], result["found"])
    ((name, told, *cells),) = robustness.table([result]).rows
    assert (name, told, len(cells)) == ("as assumed", model, 5)
    assert cells[0].startswith(f"{100 * result['exact'] / result['true']:.0f} (")


# What is stated, and what it costs


def test_bins_and_their_bands_by_hand() -> None:
    stated = np.array([0.9, 0.9, 0.9, 0.02, 1.0])
    true = np.array([True, True, False, False, True])
    bins = reliability.bins_of(stated, true, np.array([0, 0, 1, 0, 1]))
    claimed = bins[reliability.CLAIMED]
    assert (claimed.statements, claimed.stated) == (3, pytest.approx(0.9))
    assert claimed.observed == pytest.approx(2 / 3)
    z = 2.5758293035489
    # True less stated: 0.2 in the first demonstration, -0.9 in the second.
    assert claimed.band == pytest.approx(z * np.sqrt(0.2**2 + 0.9**2) / 3)
    assert claimed.band_if_independent == pytest.approx(z * np.sqrt(3 * 0.09) / 3)
    assert claimed.holds
    assert [each.statements for each in bins] == [1, *[0] * 8, 3, 1]
    assert all(each.holds for each in bins)


def statements(
    generator: np.random.Generator, bias: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Statements of 0.9, two a demonstration, both true or both not, less often by `bias`."""
    true = np.repeat(generator.random(500) < 0.9 - bias, 2)
    return np.full(1000, 0.9), true, np.repeat(np.arange(500), 2)


def test_the_band_holds_where_statements_depend_on_each_other() -> None:
    generator = np.random.default_rng(0)
    right = [reliability.reliability(*statements(generator, 0.0)) for _ in range(400)]
    assert 0.975 <= np.mean([each.holds for each in right]) <= 1.0
    # As if they were independent, the band would be too narrow.
    alone = [abs(each.observed - 0.9) <= each.band_if_independent for each in right]
    assert np.mean(alone) < 0.96
    wrong = [reliability.reliability(*statements(generator, 0.1)) for _ in range(20)]
    assert not any(each.holds for each in wrong)


def test_the_papers_simulated_prior_is_the_urns() -> None:
    generator = np.random.default_rng(0)
    sizes = []
    for _ in range(300):
        demonstration, grid_map, truth = reliability.simulate_exchangeable(generator)
        assert len(demonstration) == 40
        assert grid_map.is_free(np.concatenate([demonstration.cells, truth])).all()
        sizes.append(len(truth))
    # 4.28 partitions on average, sum of 1 / i, some of which share a subgoal by chance.
    partitions = (1.0 / np.arange(1, 41)).sum()
    assert partitions * 0.8 < np.mean(sizes) < partitions


def fix_parameters(monkeypatch: pytest.MonkeyPatch, **values: float) -> None:
    """Let the prior of some parameters be a single value."""

    class Value:
        def __init__(self, value: float) -> None:
            self.value = value

        def draw(self, generator: np.random.Generator) -> float:
            return self.value

    def fixed_model(*arguments: Any) -> PursuitModel:
        model = pursuit_model(*arguments)
        return replace(
            model, priors=model.priors | {name: Value(each) for name, each in values.items()}
        )

    monkeypatch.setattr(reliability, "pursuit_model", fixed_model)


ALL_AT_ONCE = {"switch_on_arrival": 1.0, "switch_at_subgoal": 1.0, "switch_elsewhere": 1.0}
SURELY = {"alpha": 1e3, "slip": 0.0, "switch_on_arrival": 1.0, "switch_elsewhere": 0.0}


def test_the_simulated_prior_of_the_sequential_model_is_the_urns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fix_parameters(monkeypatch, eta=1.0, slip=0.0, **ALL_AT_ONCE)
    generator = np.random.default_rng(0)
    sizes = [len(reliability.simulate_in_sequence(generator)[2]) for _ in range(100)]
    # A draw at each of 80 observations, some of the partitions sharing a subgoal by chance.
    partitions = (1.0 / np.arange(1, 81)).sum()
    assert partitions * 0.8 < np.mean(sizes) < partitions


@pytest.mark.parametrize("seed", range(10))
def test_the_truth_of_a_simulated_sequence_is_what_was_pursued(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    # Who does not err, and goes on until it is there, takes the best action for one of the true
    # subgoals, each of which explains some.
    fix_parameters(monkeypatch, eta=2.0, switch_at_subgoal=1.0, **SURELY)
    demonstration, grid_map, truth = reliability.simulate_in_sequence(np.random.default_rng(seed))
    assert len(demonstration) == 80
    assert demonstration.episode.tolist() == [0] * 40 + [1] * 40
    assert grid_map.is_free(np.concatenate([demonstration.cells, truth])).all()
    world = grid_world(grid_map, Settings())
    steps = np.diff(world.states_of(demonstration.cells))
    assert np.isin(np.delete(steps, 39), [0, *world.offsets]).all()
    best = best_actions(demonstration, truth, world)
    assert best.any(axis=1).all()
    assert best.any(axis=0).all()
    # It arrives at each but perhaps the last of an episode.
    visited = {tuple(cell) for cell in demonstration.cells.tolist()}
    assert len(set(truth) - visited) <= 2


def best_actions(
    demonstration: Demonstration, subgoals: list[tuple[int, int]], world: GridWorld
) -> npt.NDArray[np.bool_]:
    """(N, J) whether each action is, nearly, a best one for each subgoal."""
    states = world.states_of(demonstration.cells)
    values = goal_values(world, world.states_of(subgoals), states)
    chosen = values[np.arange(len(states)), np.searchsorted(world.actions, demonstration.action)]
    return chosen > values.max(axis=1) * 0.999


def test_one_subgoal_is_pursued_again_and_again_where_eta_is_tiny(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fix_parameters(monkeypatch, eta=1e-12, switch_at_subgoal=0.5, **SURELY)
    demonstration, grid_map, truth = reliability.simulate_in_sequence(np.random.default_rng(0))
    assert len(truth) == 1
    assert best_actions(demonstration, truth, grid_world(grid_map, Settings())).all()


@pytest.mark.parametrize("seed", range(5))
def test_who_never_switches_pursues_one_subgoal_an_episode(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    never = SURELY | {"switch_on_arrival": 0.0, "switch_at_subgoal": 0.0}
    fix_parameters(monkeypatch, eta=1e12, **never)
    demonstration, grid_map, truth = reliability.simulate_in_sequence(np.random.default_rng(seed))
    best = best_actions(demonstration, truth, grid_world(grid_map, Settings()))
    of_episodes = [best[:40].all(axis=0), best[40:].all(axis=0)]
    assert 1 <= len(truth) <= 2
    assert all(whole.any() for whole in of_episodes)
    assert np.any(of_episodes, axis=0).all()


def test_a_simulated_demonstrator_stays_as_long_as_its_switches_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # It leaves as it arrives, after one action there, or never.
    fix_parameters(monkeypatch, eta=1e12, switch_at_subgoal=1.0, **SURELY)
    passing = stays_of_simulations()
    fix_parameters(
        monkeypatch, eta=1e12, switch_at_subgoal=1.0, **(SURELY | {"switch_on_arrival": 0.0})
    )
    pausing = stays_of_simulations()
    fix_parameters(
        monkeypatch, eta=1e12, switch_at_subgoal=0.0, **(SURELY | {"switch_on_arrival": 0.0})
    )
    resting = stays_of_simulations()
    assert passing < 0.05 < pausing < 0.45 < resting


def stays_of_simulations() -> float:
    """Share of staying among the actions of some simulated demonstrations."""
    simulated = [
        reliability.simulate_in_sequence(np.random.default_rng(seed))[0] for seed in range(10)
    ]
    actions = np.concatenate([demonstration.action for demonstration in simulated])
    return float((actions == ACTION_NAMES.index("stay")).mean())


def test_what_only_slips_pursued_is_no_subgoal(monkeypatch: pytest.MonkeyPatch) -> None:
    fix_parameters(monkeypatch, slip=1.0)
    demonstration, _, truth = reliability.simulate_in_sequence(np.random.default_rng(0))
    assert (len(demonstration), truth) == (80, [])


@pytest.mark.parametrize("model", MODELS)
def test_a_case_of_the_reliability_table(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    short = reliability.SAMPLING | {"sweeps": 100, "burn_in": 20}
    monkeypatch.setattr(reliability, "SAMPLING", short)
    result = reliability.run(reliability.Case(model, 0))
    assert result == reliability.run(reliability.Case(model, 0))
    assert len(result["stated"]) == len(result["true"])
    assert 1 <= sum(result["true"]) < len(result["true"])
    table = reliability.table([result])
    assert len(table.rows) == len(reliability.EDGES) - 1
    assert all(row[0] == model for row in table.rows)


def test_the_demonstration_for_the_cost_is_as_long_as_said() -> None:
    demonstration = cost.long_demonstration()
    assert len(demonstration) == 10_000
    assert cost.MAP.free.sum() == 200
    assert (demonstration.last_episode < demonstration.episode[-1]).all()


# The command


def test_the_command_writes_tables_and_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(turtle, "SEEDS", 1)
    out = tmp_path / "deep" / "study.md"
    arguments = ["--only", "turtle", "--only", "overcooked", "--jobs", "1", "--out", str(out)]
    assert main([*arguments, "--overcooked", str(tmp_path / "nowhere")]) == 1
    printed = capsys.readouterr()
    assert "turtle: 1 of 2" in printed.out
    assert "turtle: 2 of 2" in printed.out
    assert printed.err.startswith("overcooked: left out: ")
    assert out.read_text(encoding="utf-8").startswith("### A turtle driven")
    numbers = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert [result["model"] for result in numbers["turtle"]] == list(MODELS)


def test_without_recordings_the_rest_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(turtle, "SEEDS", 1)
    two = {name: PARTS[name] for name in ("overcooked", "turtle")}
    monkeypatch.setattr("bnirl_ros.experiments.study.__main__.PARTS", two)
    arguments = ["--jobs", "1", "--out", str(tmp_path / "study.md")]
    assert main([*arguments, "--overcooked", str(tmp_path / "nowhere")]) == 0
    assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "study.md").read_text(encoding="utf-8").startswith("### A turtle driven")


def test_wrong_arguments_of_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--jobs", "0"], ["--only", "nothing"]):
        with pytest.raises(SystemExit, match=r"^2$"):
            main(arguments)
    assert "must be at least 1" in capsys.readouterr().err
