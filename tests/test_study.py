"""The study counts as it says: by hand, on small cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bnirl_ros.experiments.study.intervals import ratio_interval, wilson
from bnirl_ros.experiments.study.part import MODELS, settings_of
from bnirl_ros.experiments.study.report import Table, share
from bnirl_ros.experiments.study.scores import (
    goes_round,
    matches,
    nearest_within,
    top_hits,
    visits,
)
from bnirl_ros.inference.settings import Settings

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
