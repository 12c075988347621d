"""The steps that are written in vectors do what their plain numpy says."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from bnirl_ros.mdp.band import Law
from bnirl_ros.mdp.lanes import LANES, raised_row, relaxed_row


class Rows(NamedTuple):
    """Values of some rows, and rows beside each."""

    value: np.ndarray
    neighbours: np.ndarray
    rows_of_goals: np.ndarray


@njit
def relaxed(value, neighbours, row, rows_of_goals, law, omega, wanted):  # type: ignore[no-untyped-def]
    return relaxed_row(value, neighbours, row, rows_of_goals, law, omega, wanted)


@njit
def raised(value, neighbours, row, fades):  # type: ignore[no-untyped-def]
    raised_row(value, neighbours, row, fades)


def rows(generator: np.random.Generator, moves: int, shift: int) -> Rows:
    """Some rows, their values beginning anywhere in memory, some of them zero."""
    count = int(generator.integers(1, 12))
    value = np.empty(count * LANES + LANES)[shift:][: count * LANES]
    value[:] = generator.random(count * LANES) * generator.choice(
        [0.0, 1e-200, 1.0], count * LANES
    )
    neighbours = generator.integers(count, size=(count, moves)).astype(np.uint32)
    return Rows(value, neighbours, generator.integers(count, size=LANES))


def law(moves: int) -> Law:
    return Law(0.7, 0.03, 0.95, tuple(0.9 + 0.01 * move for move in range(moves)), 1.2)


@pytest.mark.parametrize("moves", [4, 8])
@settings(max_examples=150)
@given(
    seed=st.integers(0, 2**32 - 1), shift=st.integers(0, 7), wanted=st.sampled_from([1e-9, 0.5])
)
def test_a_row_is_relaxed_as_plain_numpy_does(
    moves: int, seed: int, shift: int, wanted: float
) -> None:
    generator = np.random.default_rng(seed)
    value, neighbours, rows_of_goals = rows(generator, moves, shift)
    row = int(generator.integers(len(neighbours)))
    if generator.random() < 0.3:  # where nothing changes it is settled
        value[:] = 0.0
    expected = value.copy()
    rest = neighbours, row, rows_of_goals, law(moves), 1.3, wanted
    assert relaxed(value, *rest) == relaxed_row(expected, *rest)
    np.testing.assert_array_equal(value, expected)


def test_a_row_is_settled_where_no_lane_changes_by_more_than_asked() -> None:
    """Each lane counts: the last one too."""
    value = np.ones(2 * LANES)
    neighbours = np.zeros((2, 4), dtype=np.uint32)
    no_goals = np.full(LANES, 7)
    keeps = Law(1.0, 0.0, 1.0, (1.0,) * 4, 1.0)
    assert not relaxed(value, neighbours, 1, no_goals, keeps, 1.0, 1e-3)
    for lane in range(LANES):
        value[:] = 1.0
        value[lane] = 1.01
        assert relaxed(value, neighbours, 1, no_goals, keeps, 1.0, 1e-3)
        assert not relaxed(value, neighbours, 1, no_goals, keeps, 1.0, 1e-3)


@pytest.mark.parametrize("moves", [4, 8])
@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), shift=st.integers(0, 7))
def test_a_row_is_raised_as_plain_numpy_does(moves: int, seed: int, shift: int) -> None:
    generator = np.random.default_rng(seed)
    value, neighbours, _ = rows(generator, moves, shift)
    row = int(generator.integers(len(neighbours)))
    expected = value.copy()
    raised(value, neighbours, row, law(moves).fades)
    raised_row(expected, neighbours, row, law(moves).fades)
    np.testing.assert_array_equal(value, expected)
