"""First-passage values along the wave are those of an exact solve, near the goal and far away."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import spsolve

from bnirl_ros.mdp.grid_world import GridWorld

ROUNDING = 1e-11  # of the exact solve


def exact(world: GridWorld, goal: int) -> npt.NDArray[np.float64]:
    """(S,) first-passage values by policy iteration, each policy solved by elimination."""
    states = np.arange(world.state_count)
    reachable = world.parts_of(states) == world.parts_of(np.array([goal]))[0]
    moving = reachable & (states != goal)
    layers = world.transitions()
    values = np.where(states == goal, 1.0, 0.0)
    # Begin with the shortest way; every policy of these reaches the goal.
    policy = np.zeros(world.state_count, dtype=np.int64)
    steps = np.where(states == goal, 0.0, np.inf)
    outcomes = world.outcomes()
    before = np.full(len(states), np.nan)
    while not np.array_equal(steps, before):
        before = steps
        steps = np.where(moving, np.minimum(steps, steps[outcomes].min(axis=1) + 1.0), steps)
    policy[moving] = (steps[outcomes] + 1.0).argmin(axis=1)[moving]
    while True:
        rows = sum(
            diags_array(((policy == action) & moving).astype(float)) @ layer
            for action, layer in enumerate(layers)
        )
        system = csr_array(eye_array(world.state_count) - world.discount * rows)
        values = spsolve(system.tocsc(), np.where(states == goal, 1.0, 0.0))
        means = np.stack([layer @ values for layer in layers], axis=1)
        better = means.max(axis=1) > (1.0 + ROUNDING) * means[states, policy]
        if not (better & moving).any():
            return np.where(reachable, values, 0.0)
        policy = np.where(better & moving, means.argmax(axis=1), policy)


def assert_within(world: GridWorld, goals: npt.NDArray[np.int64], tolerance: float) -> None:
    """Every value that is not zero is within a part of itself."""
    found = world.first_passage(goals, tolerance)
    for lane, goal in enumerate(goals.tolist()):
        np.testing.assert_allclose(found[:, lane], exact(world, goal), rtol=tolerance + ROUNDING)


@st.composite
def mazes(draw: st.DrawFn) -> GridWorld:
    seed = draw(st.integers(0, 2**32 - 1))
    shape = draw(st.integers(1, 14)), draw(st.integers(1, 14))
    free = np.random.default_rng(seed).random(shape) > draw(st.sampled_from([0.0, 0.2, 0.4]))
    free[0, 0] = True
    return GridWorld(
        free,
        moves=draw(st.sampled_from([4, 8])),
        success=draw(st.floats(0.25, 1.0)),
        discount=draw(st.floats(0.5, 0.999)),
    )


@settings(max_examples=60)
@given(mazes(), st.sampled_from([1e-3, 1e-6, 1e-9]))
def test_every_value_is_within_the_tolerance_of_itself(world: GridWorld, tolerance: float) -> None:
    goals = np.flatnonzero(world.free)
    assert_within(world, goals[:: max(1, len(goals) // 3)], tolerance)


@pytest.mark.parametrize("moves", [4, 8])
@pytest.mark.parametrize("success", [0.4, 0.7, 1.0])
def test_so_are_those_of_a_hall_with_pillars_and_notches(moves: int, success: float) -> None:
    rng = np.random.default_rng(7)
    free = np.ones((60, 80), dtype=bool)
    for x, y in rng.integers(2, 55, (25, 2)):
        free[y : y + rng.integers(1, 9), x : x + rng.integers(1, 9)] = False
    free[20:23, 30:60] = False
    free[21, 35:60] = True  # a dead end, one cell wide
    world = GridWorld(free, moves=moves, success=success)
    assert_within(world, np.flatnonzero(free)[[0, 1500, -1]], 1e-6)


def test_far_away_values_are_tiny_and_as_good_as_near_ones() -> None:
    world = GridWorld(np.ones((3, 400), dtype=bool), discount=0.9)
    found = world.first_passage(np.array([400]), 1e-6)
    assert 0.0 < found.min() < 1e-25
    assert_within(world, np.array([400]), 1e-6)


def test_values_too_small_for_floats_are_zero_or_tiny_but_never_wrong_nearby() -> None:
    world = GridWorld(np.ones((1, 3000), dtype=bool), discount=0.5)
    found = world.first_passage(np.array([0]), 1e-6)[:, 0]
    assert np.isfinite(found).all()
    assert found[-1] < 1e-280
    near = GridWorld(np.ones((1, 200), dtype=bool), discount=0.5)
    np.testing.assert_allclose(found[:150], exact(near, 0)[:150], rtol=1e-6)


def test_where_no_way_leads_to_the_goal_the_value_is_zero() -> None:
    free = np.ones((5, 9), dtype=bool)
    free[:, 4] = False
    found = GridWorld(free).first_passage(np.array([0, 8]), 1e-6).reshape(5, 9, 2)
    assert (found[:, :4, 0] > 0.0).all()
    assert not found[:, 4:, 0].any()
    assert (found[:, 5:, 1] > 0.0).all()
    assert not found[:, :5, 1].any()


def test_an_action_that_mostly_leads_elsewhere_is_no_obstacle() -> None:
    world = GridWorld(np.ones((6, 6), dtype=bool), success=0.05, discount=0.8)
    found = world.first_passage(np.array([14]), 1e-12)
    np.testing.assert_allclose(found[:, 0], exact(world, 14), rtol=0, atol=1e-9)


def corner_of(world: GridWorld, side: int) -> npt.NDArray[np.int64]:
    """The states of a square at the lower left that can be in."""
    states = np.flatnonzero(world.free)
    return states[(world.cells_of(states) < side).all(axis=1)]


@pytest.mark.parametrize("moves", [4, 8])
@pytest.mark.parametrize("success", [0.5, 0.7, 1.0])
def test_what_is_asked_in_a_corner_of_a_large_map_is_solved_there(
    moves: int, success: float
) -> None:
    free = np.random.default_rng(3).random((400, 400)) > 0.1
    free[:20, :20] = True
    world = GridWorld(free, moves=moves, success=success)
    asked = corner_of(world, 20)
    goals = asked[[0, 150, -1]]
    everywhere = world.first_passage(goals, 1e-12)
    found = world.first_passage(goals, 1e-6, states=asked)
    around = np.unique(world.outcomes()[asked])
    np.testing.assert_allclose(found[around], everywhere[around], rtol=1e-6)
    assert np.count_nonzero(found) < 0.1 * np.count_nonzero(everywhere)


def test_a_detour_beyond_the_margin_is_found_where_it_is_the_better_way() -> None:
    """A short way through a maze of pillars, on which the demonstrator is often held up, and a
    long one around it: the part that is solved has to grow until it has the long one in it."""
    free = np.ones((260, 260), dtype=bool)
    free[1:60:2, 10:40:2] = False  # every move among them that fails may be blocked
    world = GridWorld(free, success=0.35, discount=0.999)
    goals = np.array([30 * 260 + 2])
    asked = np.array([30 * 260 + 48])
    everywhere = world.first_passage(goals, 1e-12)[asked]
    np.testing.assert_allclose(
        world.first_passage(goals, 1e-9, states=asked)[asked], everywhere, rtol=1e-9
    )


def test_parts_of_a_map_that_are_asked_for_in_one_call_are_solved_each_by_itself() -> None:
    free = np.ones((300, 300), dtype=bool)
    free[:, 150] = False
    world = GridWorld(free)
    goals = np.array([5, 295])
    asked = world.states_of([[3, 3], [290, 4], [150, 7]])
    found = world.first_passage(goals, 1e-6, states=asked)
    everywhere = world.first_passage(goals, 1e-12)
    np.testing.assert_allclose(found[asked], everywhere[asked], rtol=1e-6)
    assert np.count_nonzero(found) < 0.2 * np.count_nonzero(everywhere)


@settings(max_examples=25)
@given(mazes(), st.integers(0, 2**32 - 1))
def test_goals_solved_together_are_those_solved_one_by_one(world: GridWorld, seed: int) -> None:
    goals = np.flatnonzero(world.free)
    goals = np.random.default_rng(seed).choice(goals, min(len(goals), 30))  # some of them twice
    together = world.first_passage(goals, 1e-9)
    for lane, goal in enumerate(goals):
        alone = world.first_passage(np.array([goal]), 1e-9)
        np.testing.assert_allclose(together[:, lane], alone[:, 0], rtol=2e-9)


def test_a_residual_is_enough_where_it_is_allowed() -> None:
    world = GridWorld(np.ones((40, 40), dtype=bool))
    found = world.first_passage(np.array([5]), 1e-30, residual=1e-7)[:, 0]
    means = world.expected_values(found[:, None], np.arange(1600))[:, :, 0].max(axis=1)
    change = np.delete(np.abs(world.discount * means / found - 1.0), 5)
    assert 1e-13 < change.max() <= 1e-7
