"""Losses of predictions, and the predictions without a model: by hand."""

from __future__ import annotations

import numpy as np
import pytest

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.inference.posterior import grid_world
from bnirl_ros.inference.scoring import WITHOUT_MODEL, all_alike, always_stay, frequency, losses
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap
from test_prediction import seen

CORRIDOR = GridMap(np.array([[True, True, False]]))
WORLD = grid_world(CORRIDOR, Settings())


def in_corridor(*steps: tuple[int, str]) -> Demonstration:
    """Observations (x, action) in the corridor of two cells."""
    return seen(*((0, x, 0, name) for x, name in steps))


LEARNT = in_corridor((0, "E"), (1, "stay"), (1, "N"), (1, "E"), (1, "W"))
HELD_OUT = in_corridor((0, "E"), (0, "stay"), (1, "S"), (1, "W"))
"""In each cell staying, by whatever blocked move, and the move to the other one."""


def test_frequencies_are_those_of_what_was_done() -> None:
    foreseen = frequency(LEARNT, HELD_OUT, WORLD)
    # Staying is shared by eight actions: all but the move to the other cell.
    left, right = [0.5 / 2 / 8] * 9, [3.5 / 5 / 8] * 9
    left[1], right[5] = 1.5 / 2, 1.5 / 5
    np.testing.assert_allclose(foreseen, [left, left, right, right])
    told = losses(foreseen, HELD_OUT, WORLD)
    np.testing.assert_allclose(np.exp(-told.log), [1.5 / 2, 0.5 / 2, 3.5 / 5, 1.5 / 5])
    assert told.zero_one.tolist() == [0.0, 1.0, 0.0, 1.0]


def test_where_all_is_alike_every_second_guess_is_right() -> None:
    told = losses(all_alike(LEARNT, HELD_OUT, WORLD), HELD_OUT, WORLD)
    np.testing.assert_allclose(told.log, np.log(2.0))
    np.testing.assert_allclose(told.zero_one, 0.5)


def test_to_always_stay_rules_moves_out() -> None:
    told = losses(always_stay(LEARNT, HELD_OUT, WORLD), HELD_OUT, WORLD)
    assert told.log.tolist() == [np.inf, 0.0, 0.0, np.inf]
    assert told.zero_one.tolist() == [1.0, 0.0, 0.0, 1.0]


def test_a_blocked_move_counts_as_staying() -> None:
    # The move is the most probable action, and yet it is likelier to stay, by whichever.
    probability = np.full((2, 9), 0.6 / 8)
    probability[:, 1] = 0.4
    told = losses(probability, in_corridor((0, "SW"), (0, "E")), WORLD)
    np.testing.assert_allclose(np.exp(-told.log), [0.6, 0.4])
    assert told.zero_one.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("name", WITHOUT_MODEL)
def test_predictions_without_a_model_are_distributions(name: str) -> None:
    open_map = GridMap(np.ones((3, 3), dtype=bool))
    learnt = seen((0, 1, 1, "E"), (0, 2, 1, "E"), (0, 2, 1, "stay"))
    held_out = seen((0, 0, 0, "N"), (0, 1, 1, "N"), (0, 2, 1, "W"))
    for moves in (4, 8):
        world = grid_world(open_map, Settings(moves=moves))
        foreseen = WITHOUT_MODEL[name](learnt, held_out, world)
        assert foreseen.shape == (3, len(world.actions))
        np.testing.assert_allclose(foreseen.sum(axis=1), 1.0)
