"""The algorithms that the paper compares with: each against known answers of small cases."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize

from bnirl_ros.baselines import RIVALS, AbbeelNg, MaximumMarginPlanning, Observed, PolicyWalk
from bnirl_ros.baselines.abbeel_ng import SMALLEST_MARGIN, expected_difference, maximum_margin
from bnirl_ros.baselines.linear_rewards import LinearRewards
from bnirl_ros.baselines.max_margin import plan
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.mdp.grid_world import GridWorld
from reference import optimal_values

FloatArray = npt.NDArray[np.float64]
Process = GridWorld | FiniteMDP

MAKERS: dict[str, Callable[[Process, Observed, FloatArray], Any]] = {
    "abbeel_ng": AbbeelNg,
    "max_margin": MaximumMarginPlanning,
    "policy_walk": lambda *given: PolicyWalk(*given, np.random.default_rng(5)),
}


def dense_transitions(mdp: Process) -> FloatArray:
    """T (A, S, S)."""
    return np.stack([layer.toarray() for layer in mdp.transitions()])


def random_mdp(
    seed: int, state_count: int = 4, action_count: int = 3, discount: float = 0.9
) -> FiniteMDP:
    """A process in which a third of the transitions do not occur."""
    generator = np.random.default_rng(seed)
    shares = generator.random((action_count, state_count, state_count))
    shares[generator.random(shares.shape) < 1 / 3] = 0.0
    shares[:, np.arange(state_count), np.arange(state_count)] += 0.1
    return FiniteMDP.from_transitions(shares / shares.sum(axis=2, keepdims=True), discount)


def demonstrated(
    mdp: Process,
    values: FloatArray,
    starts: list[int],
    lengths: list[int],
    generator: np.random.Generator,
) -> Observed:
    """Episodes of a demonstrator who takes the best action under Q* (S, A)."""
    transitions = dense_transitions(mdp)
    states, actions, episode, last = [], [], [], []
    for number, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        state = start
        for _ in range(length):
            action = int(values[state].argmax())
            states.append(state)
            actions.append(action)
            episode.append(number)
            state = int(generator.choice(len(values), p=transitions[action, state]))
        last.append(state)
    return Observed(*map(np.array, (states, actions, episode, last)))


def distances(world: GridWorld, cells: list[tuple[int, int]]) -> FloatArray:
    """(S, k) Manhattan distance from each of the cells, as in section 4.2."""
    places = world.cells_of(np.arange(world.state_count))
    return np.abs(places[:, None] - np.array(cells)).sum(axis=2).astype(np.float64)


def distance_case(seed: int, size: int = 7) -> tuple[GridWorld, Observed, FloatArray]:
    """Section 4.2 in small: a linear reward of three distances, and who is optimal under it."""
    generator = np.random.default_rng(seed)
    world = GridWorld(np.ones((size, size), dtype=bool), discount=0.9)
    cells = [(int(x), int(y)) for x, y in generator.integers(0, size, (3, 2))]
    features = distances(world, cells)
    # On the default grid of PolicyWalk, and none of them 0.
    levels = generator.integers(1, 6, 3) * np.sign(generator.uniform(-1.0, 1.0, 3))
    reward = features @ (levels / 5.0 / features.max(axis=0))
    values = optimal_values(dense_transitions(world), reward, world.discount)
    starts = [int(start) for start in generator.integers(0, world.state_count, 5)]
    return world, demonstrated(world, values, starts, [8] * 5, generator), features


def policy_loss(values: FloatArray, observed: Observed) -> int:
    """0-1 policy loss of section 4.2; as good as the best counts as chosen."""
    of_states = values[observed.states]
    chosen = of_states[np.arange(len(observed)), observed.actions]
    return int((chosen < of_states.max(axis=1) - 1e-6).sum())


# What is observed


def test_observed_of_a_demonstration() -> None:
    world = GridWorld(np.ones((3, 4), dtype=bool), moves=4)
    demonstration = Demonstration(
        episode=np.array([2, 2, 5]),
        cells=np.array([[0, 0], [1, 0], [3, 2]]),
        action=np.array([1, 3, 7]),
        last_episode=np.array([2]),
        last_cells=np.array([[1, 1]]),
    )
    observed = Observed.of(demonstration, world)
    assert observed.states.tolist() == [0, 1, 11]
    assert observed.actions.tolist() == [1, 2, 4]
    assert observed.last_states.tolist() == [5]
    assert observed.first.tolist() == [0, 2]
    assert observed.lengths.tolist() == [2, 1]
    np.testing.assert_allclose(observed.weights(0.5), [0.4, 0.2, 0.4])
    diagonal = Demonstration(
        demonstration.episode,
        demonstration.cells,
        np.array([1, 2, 7]),
        demonstration.last_episode,
        demonstration.last_cells,
    )
    with pytest.raises(ValueError, match="none of the world's"):
        Observed.of(diagonal, world)


@pytest.mark.parametrize(
    ("given_arrays", "words"),
    [
        (([], [], []), "at least one"),
        (([0, 1], [0], [0, 0]), "shape"),
        (([0, 1, 0], [0, 0, 0], [0, 1, 0]), "together"),
    ],
)
def test_observed_refuses_what_makes_no_episodes(given_arrays: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Observed(*(np.array(each, dtype=np.int64) for each in given_arrays))


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize(
    ("features", "states", "actions", "words"),
    [
        (np.ones((3, 2)), [0], [0], "features must be"),
        (np.ones((4, 0)), [0], [0], "features must be"),
        (np.full((4, 1), np.nan), [0], [0], "finite"),
        (np.ones((4, 1)), [4], [0], "state"),
        (np.ones((4, 1)), [0], [3], "action"),
        (np.ones((4, 1)), [0], [-1], "action"),
    ],
)
def test_what_does_not_fit_the_process_is_refused(
    name: str, features: FloatArray, states: list[int], actions: list[int], words: str
) -> None:
    observed = Observed(np.array(states), np.array(actions), np.zeros(1, dtype=np.int64))
    with pytest.raises(ValueError, match=words):
        MAKERS[name](random_mdp(0), observed, features)


# What all have in common


def test_the_dictionary_names_all() -> None:
    assert RIVALS.keys() == MAKERS.keys()
    world, observed, features = distance_case(0, size=3)
    for name, make in MAKERS.items():
        assert type(make(world, observed, features)) is RIVALS[name]


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.floats(0.0, 0.99))
def test_feature_expectations_solve_the_dense_system(seed: int, discount: float) -> None:
    mdp = random_mdp(seed, discount=discount)
    generator = np.random.default_rng(seed)
    features = generator.normal(size=(4, 2))
    policy = generator.integers(0, 3, 4)
    observed = Observed(np.arange(4), policy, np.zeros(4, dtype=np.int64))
    linear = LinearRewards.of(mdp, observed, features)
    transitions = dense_transitions(mdp)
    scaled = features / np.abs(features).max(axis=0)
    moves = transitions[policy, np.arange(4)]
    expectations = linear.expectations(linear.moves_of(policy))
    expected = np.linalg.solve(np.eye(4) - discount * moves, scaled)
    np.testing.assert_allclose(expectations, expected, atol=1e-10)
    at_random = np.linalg.solve(np.eye(4) - discount * transitions.mean(axis=0), scaled)
    np.testing.assert_allclose(linear.expectations(linear.any_move()), at_random, atol=1e-10)
    # The policy's own actions lead to what it expects, and others to what T says.
    np.testing.assert_allclose(
        linear.expectations_after(expectations, np.arange(4), policy), expected, atol=1e-10
    )
    np.testing.assert_allclose(
        linear.expectations_after(expectations, np.array([1, 3]), np.array([2, 0])),
        scaled[[1, 3]] + discount * transitions[[2, 0], [1, 3]] @ expected,
        atol=1e-10,
    )


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("general", [False, True])
def test_estimates_are_optimal_values_of_a_linear_reward(name: str, general: bool) -> None:
    world, observed, features = distance_case(1)
    transitions = dense_transitions(world)
    mdp = FiniteMDP.from_transitions(transitions, world.discount) if general else world
    rival = MAKERS[name](mdp, observed, features)
    for _ in range(3):
        estimate = rival.iterate()
        weights = np.linalg.lstsq(features, estimate.reward, rcond=None)[0]
        np.testing.assert_allclose(features @ weights, estimate.reward, atol=1e-9)
        expected = optimal_values(transitions, estimate.reward, world.discount)
        np.testing.assert_allclose(estimate.action_values, expected, atol=1e-6)
    assert np.abs(estimate.reward).max() > 1e-3


@pytest.mark.parametrize("name", RIVALS)
def test_units_of_features_do_not_matter(name: str) -> None:
    world, observed, features = distance_case(2)
    rival = MAKERS[name](world, observed, features)
    in_other_units = MAKERS[name](world, observed, features * [1e3, 1.0, 1e-4])
    for _ in range(5):
        reward = rival.iterate().reward
        np.testing.assert_allclose(in_other_units.iterate().reward, reward, atol=1e-6)


def test_a_feature_that_is_nowhere_does_no_harm() -> None:
    world, observed, features = distance_case(3, size=4)
    with_none = np.column_stack([features, np.zeros(len(features))])
    for make in MAKERS.values():
        assert np.isfinite(make(world, observed, with_none).iterate().action_values).all()


# Abbeel & Ng


@given(st.floats(0.1, 10.0), st.floats(0.1, 10.0))
def test_margin_between_two_policies(first: float, second: float) -> None:
    # w1 first = w2 second = t and |w| = 1.
    weights, margin = maximum_margin(np.diag([first, second]))
    expected = 1.0 / np.hypot(1.0 / first, 1.0 / second)
    assert margin == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(weights, [expected / first, expected / second], atol=1e-4)


@pytest.mark.parametrize("gap", [1.0, 1e-3, 1e-6])
def test_small_margins_are_told(gap: float) -> None:
    # The nearest point of the hull is (gap, 0).
    weights, margin = maximum_margin(np.array([[gap, 1.0], [gap, -2.0], [2.0, 0.5]]))
    assert margin == pytest.approx(gap, abs=1e-9)
    np.testing.assert_allclose(weights, [1.0, 0.0], atol=1e-3)


@given(arrays(np.float64, (4, 3), elements=st.floats(-1.0, 1.0)), st.integers(0, 10**6))
def test_no_other_weights_have_a_larger_margin(differences: FloatArray, seed: int) -> None:
    weights, margin = maximum_margin(differences)
    assert np.linalg.norm(weights) <= 1.0 + 1e-7
    assert (differences @ weights).min() == pytest.approx(margin, abs=1e-7)
    others = np.random.default_rng(seed).normal(size=(200, 3))
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    near = weights + 1e-3 * others
    near /= np.maximum(np.linalg.norm(near, axis=1, keepdims=True), 1.0)
    for tried in (others, near):
        assert (differences @ tried.T).min(axis=0).max() <= margin + 1e-7


def test_a_mixture_of_the_policies_leaves_no_margin() -> None:
    _, margin = maximum_margin(np.array([[1.0, 1.0], [-2.0, 1.0], [0.5, -1.0]]))
    assert abs(margin) < SMALLEST_MARGIN


def test_difference_without_noise_is_that_of_the_sums() -> None:
    # Moves that always succeed: the sums over the states visited, and then the policy's.
    world = GridWorld(np.ones((4, 4), dtype=bool), success=1.0, discount=0.8)
    features = np.random.default_rng(0).normal(size=(16, 3))
    values = optimal_values(dense_transitions(world), features[:, 0], 0.8)
    observed = demonstrated(world, values, [0, 15, 6], [5, 2, 7], np.random.default_rng(1))
    linear = LinearRewards.of(world, observed, features)
    expectations = linear.expectations(linear.moves_of(np.full(16, 3)))
    sums = np.zeros(3)
    total = 0.0
    for first, length, last in zip(
        observed.first, observed.lengths, observed.last_states, strict=True
    ):
        states = observed.states[first : first + length]
        sums += 0.8 ** np.arange(length) @ linear.features[states]
        sums += 0.8**length * expectations[last] - expectations[states[0]]
        total += (0.8 ** np.arange(length)).sum()
    difference = expected_difference(linear, observed, expectations)
    np.testing.assert_allclose(difference, sums / total, atol=1e-12)


def test_difference_is_in_expectation_that_of_the_sums() -> None:
    # Every course that three actions of a policy can take, with its probability.
    mdp = random_mdp(7, state_count=3)
    policy = np.array([2, 0, 1])
    transitions = dense_transitions(mdp)
    features = np.random.default_rng(7).normal(size=(3, 2))
    discounts = 0.9 ** np.arange(3)
    mean, mean_of_sums = np.zeros(2), np.zeros(2)
    for course in itertools.product(range(3), repeat=3):
        states = np.array([0, *course])
        steps = itertools.pairwise(states)
        probability = np.prod([transitions[policy[now], now, then] for now, then in steps])
        observed = Observed(states[:3], policy[states[:3]], np.zeros(3, dtype=np.int64))
        linear = LinearRewards.of(mdp, observed, features)
        expectations = linear.expectations(linear.moves_of(np.zeros(3, dtype=np.int64)))
        mean += probability * expected_difference(linear, observed, expectations)
        sums = discounts @ linear.features[states[:3]] + 0.9**3 * expectations[states[3]]
        mean_of_sums += probability * (sums - expectations[0]) / discounts.sum()
    np.testing.assert_allclose(mean, mean_of_sums, atol=1e-12)
    assert np.abs(mean).max() > 1e-2


def test_first_weights_point_from_the_random_policy_to_the_demonstrator() -> None:
    world, observed, features = distance_case(4)
    rival = AbbeelNg(world, observed, features)
    linear = LinearRewards.of(world, observed, features)
    difference = expected_difference(linear, observed, linear.expectations(linear.any_move()))
    assert rival.margin == np.inf
    rival.iterate()
    assert rival.margin == pytest.approx(np.linalg.norm(difference))
    np.testing.assert_allclose(rival.weights, difference / np.linalg.norm(difference), atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_abbeel_ng_ends_at_a_reward_that_explains_everything(seed: int) -> None:
    world, observed, features = distance_case(seed)
    rival = AbbeelNg(world, observed, features)
    margins = []
    while rival.margin > SMALLEST_MARGIN and len(margins) < 40:
        estimate = rival.iterate()
        margins.append(rival.margin)
    assert rival.margin <= SMALLEST_MARGIN
    assert (np.diff(margins) <= 1e-7).all()
    assert policy_loss(estimate.action_values, observed) == 0
    assert rival.iterate() is estimate


def test_a_missing_solver_is_said_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "clarabel", None)
    world, observed, features = distance_case(0, size=3)
    with pytest.raises(InputError, match=r"pip install 'bnirl_ros\[paper\]'"):
        AbbeelNg(world, observed, features)
    for name in ("max_margin", "policy_walk"):
        MAKERS[name](world, observed, features).iterate()


# Maximum margin planning


def every_plan(mdp: FiniteMDP, start: int, steps: int) -> FloatArray:
    """(P, S) frequencies of the states in every plan, which has a policy for each step."""
    transitions = dense_transitions(mdp)
    state_count = mdp.state_count
    policies = list(itertools.product(range(mdp.action_count), repeat=state_count))
    plans = []
    # Nothing is chosen any more by the last action.
    for course in itertools.product(policies, repeat=steps - 1):
        probability = np.eye(state_count)[start]
        frequencies = probability.copy()
        for step, policy in enumerate(course, start=1):
            probability = probability @ transitions[list(policy), np.arange(state_count)]
            frequencies += mdp.discount**step * probability
        plans.append(frequencies)
    return np.array(plans)


def planning_case(seed: int) -> tuple[FiniteMDP, Observed, FloatArray]:
    """Three states and two actions, and episodes of three, two and one step."""
    generator = np.random.default_rng(seed)
    mdp = random_mdp(seed, state_count=3, action_count=2)
    observed = Observed(
        states=np.array([0, 1, 0, 1, 1, 0]),
        actions=generator.integers(0, 2, 6),
        episode=np.array([0, 0, 0, 1, 1, 2]),
        last_states=generator.integers(0, 3, int(generator.integers(0, 2))),
    )
    features = generator.normal(size=(3, 2))
    return mdp, observed, features / np.abs(features).max(axis=0)


def enumerated_objective(
    mdp: FiniteMDP, observed: Observed, features: FloatArray, regularisation: float
) -> Callable[[FloatArray], float]:
    """c(w) with the maximum over every plan, from the sentences of `MaximumMarginPlanning`."""
    visited = np.isin(np.arange(3), [*observed.states, *observed.last_states])
    loss = np.where(visited, 0.0, 1.0)
    plans = [every_plan(mdp, start, steps) for start, steps in ((0, 3), (1, 2), (0, 1))]
    counts = 0.9 ** np.array([0, 1, 2, 0, 1, 0])
    demonstrated_sums = counts @ features[observed.states]

    def objective(weights: FloatArray) -> float:
        best = sum((frequencies @ (features @ weights + loss)).max() for frequencies in plans)
        gap = (best - demonstrated_sums @ weights) / counts.sum()
        return float(gap + 0.5 * regularisation * weights @ weights)

    return objective


@settings(max_examples=25)
@given(st.integers(0, 50), arrays(np.float64, 2, elements=st.floats(-5.0, 5.0)))
def test_objective_is_that_of_all_plans(seed: int, weights: FloatArray) -> None:
    mdp, observed, features = planning_case(seed)
    planning = MaximumMarginPlanning(mdp, observed, features, regularisation=0.3)
    objective, subgradient = planning.objective_at(weights)
    enumerated = enumerated_objective(mdp, observed, features, 0.3)
    assert objective == pytest.approx(enumerated(weights), abs=1e-9)
    # A subgradient: the objective lies nowhere below the plane.
    for other in np.random.default_rng(seed).normal(size=(20, 2), scale=3.0):
        assert enumerated(other) >= objective + subgradient @ (other - weights) - 1e-9


@pytest.mark.parametrize("seed", range(2))
def test_subgradient_method_comes_to_the_minimum(seed: int) -> None:
    mdp, observed, features = planning_case(seed)
    planning = MaximumMarginPlanning(mdp, observed, features, regularisation=0.3)
    objectives = []
    for _ in range(250):
        planning.iterate()
        objectives.append(planning.objective)
    enumerated = enumerated_objective(mdp, observed, features, 0.3)
    least = min(
        minimize(enumerated, start, method="Nelder-Mead", options={"xatol": 1e-9}).fun
        for start in (planning.weights, np.zeros(2))
    )
    # Of the bound G^2 (1 + log t) / (2 lambda t), with subgradients G of about 1 at most.
    assert least - 1e-9 <= min(objectives) <= least + 0.02
    assert enumerated(planning.weights) <= least + 0.05
    assert objectives[0] > least + 0.02


def test_the_reward_is_that_of_the_weighted_mean_of_the_points() -> None:
    mdp, observed, features = planning_case(3)
    planning = MaximumMarginPlanning(mdp, observed, features, regularisation=0.3)
    points = [np.zeros(2)]
    for count in range(1, 8):
        reward = planning.iterate().reward
        objective, subgradient = planning.objective_at(points[-1])
        assert planning.objective == pytest.approx(objective)
        points.append(points[-1] - subgradient / (0.3 * count))
        expected = np.average(points[1:], axis=0, weights=np.arange(1, count + 1))
        np.testing.assert_allclose(planning.weights, expected, atol=1e-9)
        np.testing.assert_allclose(reward, features @ expected, atol=1e-9)


def test_plans_of_one_step_gain_where_they_start() -> None:
    mdp, observed, features = planning_case(0)
    linear = LinearRewards.of(mdp, observed, features)
    value, expected = plan(
        linear, np.array([1.0, 2.0, 4.0]), np.array([2, 2, 0]), np.ones(3, dtype=np.int64)
    )
    assert value == 9.0
    np.testing.assert_allclose(expected, 2 * features[2] + features[0])


@pytest.mark.parametrize("seed", range(4))
def test_planning_explains_demonstrations_that_go_on_for_long(seed: int) -> None:
    generator = np.random.default_rng(seed)
    world = GridWorld(np.ones((5, 5), dtype=bool), success=1.0, discount=0.8)
    features = np.eye(25)[:, [3, 11, 20]]
    goal = seed % 3
    values = optimal_values(dense_transitions(world), features[:, goal], 0.8)
    observed = demonstrated(world, values, [0, 4, 24, 12, 7], [30] * 5, generator)
    planning = MaximumMarginPlanning(world, observed, features)
    for _ in range(30):
        estimate = planning.iterate()
    assert policy_loss(estimate.action_values, observed) == 0
    assert planning.weights.argmax() == goal


def test_regularisation_must_be_above_zero() -> None:
    with pytest.raises(ValueError, match="regularisation"):
        MaximumMarginPlanning(*planning_case(0), regularisation=0.0)


# PolicyWalk


def weight_grid(steps_to_one: int) -> FloatArray:
    """Every pair of weights on the grid."""
    one = np.arange(-steps_to_one, steps_to_one + 1) / steps_to_one
    return np.array(list(itertools.product(one, one)))


def enumerated_log_likelihood(
    mdp: FiniteMDP, observed: Observed, features: FloatArray, confidence: float, grid: FloatArray
) -> FloatArray:
    """(P,) log likelihood (7) of all observations under every weights (P, 2) of the grid."""
    transitions = dense_transitions(mdp)
    result = []
    for weights in grid:
        values = confidence * optimal_values(transitions, features @ weights, mdp.discount)
        likelihood = np.exp(values) / np.exp(values).sum(axis=1, keepdims=True)
        result.append(np.log(likelihood[observed.states, observed.actions]).sum())
    return np.array(result)


def walk_matrix(log_likelihood: FloatArray, side: int) -> FloatArray:
    """(P, P) transition probabilities of the walk: a quarter for each neighbour on the square."""
    matrix = np.zeros((side**2, side**2))
    for x, y in itertools.product(range(side), repeat=2):
        here = x * side + y
        for other_x, other_y in ((x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)):
            if 0 <= other_x < side and 0 <= other_y < side:
                there = other_x * side + other_y
                ratio = np.exp(log_likelihood[there] - log_likelihood[here])
                matrix[here, there] = 0.25 * min(1.0, ratio)
        matrix[here, here] = 1.0 - matrix[here].sum()
    return matrix


def test_walks_end_as_the_enumerated_posterior_says() -> None:
    mdp, observed, features = planning_case(10)
    confidence, steps_to_one, steps, walks = 3.0, 2, 40, 120
    grid = weight_grid(steps_to_one)
    side = 2 * steps_to_one + 1
    log_likelihood = enumerated_log_likelihood(mdp, observed, features, confidence, grid)
    posterior = np.exp(log_likelihood) / np.exp(log_likelihood).sum()
    assert posterior.max() > 3 * posterior.min()
    # From the prior the walk is where it will be, so the ends are independent draws.
    ends = np.full(side**2, 1.0 / side**2) @ np.linalg.matrix_power(
        walk_matrix(log_likelihood, side), steps
    )
    assert np.abs(ends - posterior).sum() < 5e-3
    counts = np.zeros(side**2)
    for seed in range(walks):
        generator = np.random.default_rng(seed)
        walk = PolicyWalk(mdp, observed, features, generator, confidence, steps_to_one)
        for _ in range(steps):
            walk.iterate()
        place = int(np.abs(grid - walk.weights).sum(axis=1).argmin())
        assert walk.log_likelihood == pytest.approx(log_likelihood[place], abs=1e-6)
        counts[place] += 1
    expected = walks * posterior
    simulated = np.random.default_rng(0).multinomial(walks, posterior, 20_000)
    # A false alarm in one of a thousand choices of seeds. The prior in the posterior's place,
    # where a walk that takes every step ends, does not pass.
    limit = np.quantile(((simulated - expected) ** 2 / expected).sum(axis=1), 0.999)
    assert ((counts - expected) ** 2 / expected).sum() < limit
    assert ((walks / side**2 - expected) ** 2 / expected).sum() > 1.5 * limit


def test_walks_begin_anywhere_on_the_grid() -> None:
    case = planning_case(0)
    starts = {
        tuple(PolicyWalk(*case, np.random.default_rng(seed), steps_to_one=1).weights)
        for seed in range(250)
    }
    # One of the nine is missing, by chance, for 9 (8 / 9)^250 = 1.5e-12 of the choices of seeds.
    assert starts == {(x, y) for x, y in weight_grid(1)}


class ResolvingWalk(PolicyWalk):
    """The walk without its shortcut: every proposal's MDP is solved from the start."""

    def _moved(self, levels: npt.NDArray[np.int64]) -> Any:
        return self._solved(levels, np.zeros_like(self._linear.features))


@pytest.mark.parametrize("seed", range(3))
def test_keeping_the_policy_is_as_solving_each_time(seed: int) -> None:
    world, observed, features = distance_case(seed, size=5)
    kept = 0
    walks = [
        kind(world, observed, features, np.random.default_rng(seed), confidence=5.0)
        for kind in (PolicyWalk, ResolvingWalk)
    ]
    for _ in range(150):
        before = walks[0]._place
        estimates = [walk.iterate() for walk in walks]
        after = walks[0]._place
        kept += after is not before and after.policy is before.policy
        np.testing.assert_array_equal(walks[0].weights, walks[1].weights)
        assert walks[0].log_likelihood == pytest.approx(walks[1].log_likelihood, abs=1e-6)
        np.testing.assert_array_equal(estimates[0].reward, estimates[1].reward)
        values = [estimate.action_values for estimate in estimates]
        np.testing.assert_allclose(values[0], values[1], atol=1e-6)
    assert kept > 0


def test_the_walk_stays_on_its_grid_and_its_estimate_is_the_best_place() -> None:
    world, observed, features = distance_case(1, size=4)
    walk = PolicyWalk(
        world, observed, features, np.random.default_rng(0), confidence=0.1, steps_to_one=1
    )
    scaled = features / features.max(axis=0)
    best = walk.log_likelihood
    visited = set()
    for _ in range(200):
        before = walk.weights
        estimate = walk.iterate()
        assert np.abs(walk.weights - before).sum() in (0.0, 1.0)
        visited.add(tuple(walk.weights))
        if walk.log_likelihood > best:
            best = walk.log_likelihood
            np.testing.assert_allclose(estimate.reward, scaled @ walk.weights)
    values = 0.1 * estimate.action_values
    log_likelihood = values - np.log(np.exp(values).sum(axis=1, keepdims=True))
    seen = log_likelihood[observed.states, observed.actions].sum()
    assert seen == pytest.approx(best, abs=1e-9)
    assert len(visited) > 15
    assert all(set(weights) <= {-1.0, 0.0, 1.0} for weights in visited)


@pytest.mark.parametrize("seed", range(3))
def test_policy_walk_comes_to_a_reward_that_explains_everything(seed: int) -> None:
    world, observed, features = distance_case(seed)
    walk = PolicyWalk(world, observed, features, np.random.default_rng(seed))
    for _ in range(300):
        estimate = walk.iterate()
    assert policy_loss(estimate.action_values, observed) == 0


@pytest.mark.parametrize("wrong", [{"confidence": 0.0}, {"steps_to_one": 0}])
def test_policy_walk_refuses_parameters_out_of_range(wrong: dict[str, Any]) -> None:
    world, observed, features = distance_case(0, size=3)
    with pytest.raises(ValueError, match="above 0"):
        PolicyWalk(world, observed, features, np.random.default_rng(0), **wrong)
