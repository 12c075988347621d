"""Goal values: the grid world, the finite MDP and plain value iteration agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label
from scipy.sparse import csr_array

from bnirl_ros.mdp import reward_values
from bnirl_ros.mdp.actions import ACTION_NAMES, STEPS, action_of_name, action_of_step
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.goals import Goals
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.mdp.parts import connected_parts
from reference import grid_transitions, optimal_values


@st.composite
def grid_worlds(draw: st.DrawFn) -> GridWorld:
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    cells = draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width))
    free = np.array(cells).reshape(height, width)
    free.flat[draw(st.integers(0, free.size - 1))] = True
    return GridWorld(
        free,
        moves=draw(st.sampled_from([4, 8])),
        success=draw(st.floats(0.01, 1.0)),
        discount=draw(st.floats(0.0, 0.99)),
    )


@given(grid_worlds())
def test_parts_of_a_map_are_scipys(world: GridWorld) -> None:
    parts, _ = label(world.free)
    np.testing.assert_array_equal(connected_parts(world.free), parts)


@settings(max_examples=60)
@given(grid_worlds())
def test_three_ways_to_the_values_of_goals_agree(world: GridWorld) -> None:
    steps = [(int(dx), int(dy)) for dx, dy in STEPS[world.actions]]
    transitions = grid_transitions(world.free, steps, world.success)
    states = np.arange(world.state_count)
    goals = np.flatnonzero(world.free)
    plain = np.stack(
        [optimal_values(transitions, 1.0 * (states == goal), world.discount) for goal in goals],
        axis=-1,
    )
    on_grid = goal_values(world, goals, states)
    on_mdp = goal_values(FiniteMDP.from_transitions(transitions, world.discount), goals, states)
    np.testing.assert_allclose(on_grid[world.free.reshape(-1)], plain[goals], rtol=0, atol=2e-8)
    np.testing.assert_allclose(on_mdp, plain, rtol=0, atol=2e-8)


@settings(max_examples=40)
@given(grid_worlds(), st.data())
def test_values_of_any_rewards_and_of_sets_of_goals_agree_with_plain_ones(
    world: GridWorld, data: st.DataObject
) -> None:
    steps = [(int(dx), int(dy)) for dx, dy in STEPS[world.actions]]
    transitions = grid_transitions(world.free, steps, world.success)
    free = np.flatnonzero(world.free)
    drawn = data.draw(
        st.lists(st.floats(-3.0, 3.0), min_size=2 * len(free), max_size=2 * len(free))
    )
    rewards = np.zeros((world.state_count, 2))
    rewards[free] = np.reshape(drawn, (-1, 2))
    subsets = st.lists(st.sampled_from(free.tolist()), min_size=1, unique=True)
    goals = Goals.of_sets(data.draw(st.lists(subsets, min_size=1, max_size=3)))
    rewards = np.column_stack([rewards, goals.rewards(range(len(goals)), world.state_count)])
    plain = np.stack(
        [optimal_values(transitions, reward, world.discount) for reward in rewards.T], axis=-1
    )
    for mdp in (world, FiniteMDP.from_transitions(transitions, world.discount)):
        values = reward_values.optimal_values(mdp, rewards)
        of_actions = reward_values.action_values(mdp, rewards, values, free)
        np.testing.assert_allclose(of_actions, plain[free], rtol=0, atol=2e-8)
        np.testing.assert_allclose(
            goal_values(mdp, goals, free), plain[free][..., 2:], rtol=0, atol=2e-8
        )
        again = reward_values.optimal_values(mdp, rewards, start=values + 1e-3)
        np.testing.assert_allclose(again[free], values[free], rtol=0, atol=2e-8)


def test_a_goal_of_one_state_is_that_state() -> None:
    world = GridWorld(np.ones((5, 6), dtype=bool))
    states = np.arange(30)
    np.testing.assert_array_equal(
        goal_values(world, Goals.of_sets([[7], [29]]), states), goal_values(world, [7, 29], states)
    )


def test_goals_of_several_states_keep_their_places_among_single_ones() -> None:
    world = GridWorld(np.ones((4, 4), dtype=bool))
    sets = [[3], [0, 1, 4], [9], [15, 14]]
    together = goal_values(world, Goals.of_sets(sets), [2, 5])
    apart = [goal_values(world, Goals.of_sets([states]), [2, 5]) for states in sets]
    np.testing.assert_allclose(together, np.concatenate(apart, axis=2), atol=2e-8)


def test_a_goal_without_states_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one state"):
        Goals.of_sets([[1], []])


def test_rewards_of_another_number_of_states_are_refused() -> None:
    world = GridWorld(np.ones((2, 2), dtype=bool))
    with pytest.raises(ValueError, match=r"must both be \(4, L\)"):
        reward_values.optimal_values(world, np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"must both be \(4, L\)"):
        reward_values.optimal_values(world, np.zeros((4, 1)), start=np.zeros((4, 2)))


def test_grid_world_gives_its_own_transitions() -> None:
    free = np.array([[1, 1, 0], [1, 1, 1]], dtype=bool)
    world = GridWorld(free, success=0.6)
    steps = [(int(dx), int(dy)) for dx, dy in STEPS]
    given_out = np.stack([layer.toarray() for layer in world.transitions()])
    np.testing.assert_allclose(given_out, grid_transitions(free, steps, 0.6), atol=1e-15)


def test_tolerance_bounds_the_error() -> None:
    world = GridWorld(np.ones((30, 30), dtype=bool))
    states = np.arange(900)
    exact = goal_values(world, [0, 465], states, tolerance=1e-12)
    for tolerance in (1e-2, 1e-5):
        rough = goal_values(world, [0, 465], states, tolerance)
        error = np.abs(rough - exact).max()
        assert 0.0 < error <= tolerance


def test_more_goals_than_fit_in_a_batch_are_as_one_by_one() -> None:
    world = GridWorld(np.ones((7, 7), dtype=bool))
    together = goal_values(world, np.arange(49), [3, 30])
    one_by_one = [goal_values(world, [goal], [3, 30]) for goal in range(49)]
    np.testing.assert_allclose(together, np.concatenate(one_by_one, axis=2), atol=2e-8)


def test_staying_at_the_goal_collects() -> None:
    # One free cell: the reward comes at every step, 1 / (1 - gamma) in all.
    values = goal_values(GridWorld(np.ones((1, 1), dtype=bool), discount=0.9), [0], [0])
    np.testing.assert_allclose(values, 10.0, atol=1e-8)


def test_a_goal_out_of_reach_is_worth_nothing() -> None:
    free = np.array([[1, 0, 1]], dtype=bool)
    values = goal_values(GridWorld(free), [2], [0, 2])
    assert (values[0] == 0.0).all()
    assert (values[1] > 1.0).all()


def test_a_diagonal_past_a_blocked_corner_is_blocked() -> None:
    free = np.array([[1, 0], [1, 1]], dtype=bool)  # (1, 0) is blocked
    outcomes = GridWorld(free).outcomes()
    start = 0
    assert outcomes[start, action_of_name("NE")] == start
    assert outcomes[start, action_of_name("N")] == 2
    assert GridWorld(np.ones((2, 2), dtype=bool)).outcomes()[0, action_of_name("NE")] == 3


def test_actions_have_the_order_of_the_contract() -> None:
    assert ACTION_NAMES == ("stay", "E", "NE", "N", "NW", "W", "SW", "S", "SE")
    assert action_of_step(-1.0, 1.0) == 4
    assert action_of_step(0.5, 0.0) is None
    assert action_of_step(float("nan"), 0.0) is None
    assert [ACTION_NAMES[a] for a in GridWorld(np.ones((1, 1), dtype=bool), moves=4).actions] == [
        "stay",
        "E",
        "N",
        "W",
        "S",
    ]


def test_finite_mdp_takes_every_sparse_form() -> None:
    world = GridWorld(np.ones((2, 3), dtype=bool), moves=4)
    layers = world.transitions()
    dense = np.stack([layer.toarray() for layer in layers])
    forms = [layers, dense, list(dense)]
    try:
        from scipy.sparse import coo_array

        forms.append(coo_array(dense))
    except ValueError:
        pass  # scipy before 1.15 has no three-dimensional arrays
    expected = goal_values(world, [4], np.arange(6))
    for transitions in forms:
        mdp = FiniteMDP.from_transitions(transitions, world.discount)
        np.testing.assert_allclose(goal_values(mdp, [4], np.arange(6)), expected, atol=2e-8)


def test_finite_mdp_gives_its_own_transitions() -> None:
    generator = np.random.default_rng(0)
    transitions = generator.random((3, 5, 5)) * (generator.random((3, 5, 5)) < 0.5)
    transitions[:, :, 2] += 0.1
    transitions /= transitions.sum(axis=2, keepdims=True)
    layers = FiniteMDP.from_transitions(transitions, 0.9).transitions()
    assert len(layers) == 3
    np.testing.assert_array_equal(np.stack([layer.toarray() for layer in layers]), transitions)


@pytest.mark.parametrize(
    ("transitions", "words"),
    [
        (np.full((1, 2, 2), 0.4), "sum to 0.8"),
        (np.array([[[1.5, -0.5], [0.0, 1.0]]]), "not negative"),
        (np.ones((2, 2)), "shape"),
        ([csr_array(np.ones((1, 2)))], "shape"),
    ],
)
def test_finite_mdp_refuses_what_is_no_transition_array(transitions: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FiniteMDP.from_transitions(transitions, 0.9)


@pytest.mark.parametrize(
    "wrong",
    [{"moves": 6}, {"success": 0.0}, {"success": 1.1}, {"discount": 1.0}, {"discount": -0.1}],
)
def test_grid_world_refuses_parameters_out_of_range(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        GridWorld(np.ones((2, 2), dtype=bool), **wrong)  # type: ignore[arg-type]


def test_states_of_no_mdp_are_refused() -> None:
    with pytest.raises(ValueError, match="goal lies outside"):
        goal_values(GridWorld(np.ones((2, 2), dtype=bool)), [4], [0])
