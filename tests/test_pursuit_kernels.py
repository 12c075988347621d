"""The kernels of the sequential model against plain numpy, and its mode against every history."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bnirl_ros.inference import pursuit_gibbs, pursuit_mode
from bnirl_ros.inference.kernels import exponentials, row_sum
from bnirl_ros.inference.runs import run_counts, runs
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.likelihood import delays
from bnirl_ros.model.pursuits import PursuitModel, pursuit_model
from pursuit_reference import (
    history_probability,
    largest_joint,
    likelihood_of,
    parameters_drawn,
    run_count,
    story_drawn,
    switch_probability,
)
from reference import grid_transitions


def random_model(seed: int, count: int, most_goals: int = 20) -> PursuitModel:
    """Observations on a random small map, in parts that may be apart, within a random radius."""
    generator = np.random.default_rng(seed)
    free = generator.random(generator.integers(1, 5, size=2)) < 0.8
    free.flat[seed % free.size] = True
    world = GridWorld(free, int(generator.choice([4, 8])), float(generator.uniform(0.5, 1.0)))
    cells = np.flatnonzero(free)
    parts = world.parts_of(cells)
    # At least one candidate in each part.
    one_of_each_part = np.unique(parts, return_index=True)[1]
    others = generator.permutation(len(cells))[:most_goals]
    goals = np.unique(np.concatenate([one_of_each_part, others]))
    starts = (generator.random(count) < 0.3) | (np.arange(count) == 0)
    part_of = generator.choice(np.unique(parts), size=count)[np.cumsum(starts) - 1]
    states = np.array([generator.choice(cells[parts == part]) for part in part_of])
    apart = world.cells_of(np.unique(states))[:, None] - world.cells_of(cells[goals])
    return pursuit_model(
        world,
        states,
        generator.choice(world.actions, size=count),
        starts,
        cells[goals],
        arrived=np.linalg.norm(apart, axis=2) <= generator.choice([0.0, 1.0, 1.5]),
        likelihood=str(generator.choice(["delay", "value"])),
    )


@pytest.mark.parametrize("seed", range(30))
def test_three_ways_to_the_log_joint_agree(seed: int) -> None:
    generator = np.random.default_rng(seed)
    model = random_model(seed, count=25)
    parameters = parameters_drawn(model, generator)
    kernel = pursuit_gibbs.kernel_model(model)
    chosen = pursuit_gibbs.softmax_table(kernel, parameters[pursuit_gibbs.ALPHA])
    story = story_drawn(model, parameters, generator)
    state = pursuit_gibbs.PursuitState(
        subgoal_of=story.subgoal_of.astype(np.int32),
        switched=story.switched,
        slipped=story.slipped,
        partition_of=story.partition_of.astype(np.int32),
        counts=np.bincount(story.subgoal_of[story.switched], minlength=len(model.prior)),
        parameters=parameters,
        sweeps=np.zeros(1, dtype=np.int64),
    )
    plain = np.log(
        history_probability(
            model, parameters, tuple(story.subgoal_of.tolist()), tuple(story.switched.tolist())
        )
    ) + sum(
        np.log(likelihood_of(model, parameters, t)[subgoal])
        for t, subgoal in enumerate(story.subgoal_of)
    )
    joint = model.log_joint(story.subgoal_of, story.switched, parameters)
    assert joint == pytest.approx(plain, abs=1e-8)
    assert pursuit_gibbs.log_joint_of(kernel, state, chosen) == pytest.approx(plain, abs=1e-8)


@pytest.mark.parametrize("seed", range(30))
def test_the_filter_is_the_one_over_all_pairs_of_subgoals(seed: int) -> None:
    generator = np.random.default_rng(seed)
    model = random_model(seed, count=30)
    parameters = parameters_drawn(model, generator)
    kernel = pursuit_gibbs.kernel_model(model)
    chosen = pursuit_gibbs.softmax_table(kernel, parameters[pursuit_gibbs.ALPHA])
    candidates = len(model.prior)
    for first in np.flatnonzero(model.starts):
        end = next((t for t in range(first + 1, 30) if model.starts[t]), 30)
        part = model.state_part[model.state_of[first]]
        counts = generator.integers(4, size=candidates)
        weights = pursuit_gibbs.urn_weights(kernel, parameters[1], counts, part)
        here = model.candidate_part == part
        urn = here * (parameters[1] / here.sum() + counts)
        np.testing.assert_allclose(weights, urn / urn.sum(), atol=1e-12)
        forward, evidence = np.empty((end - first, candidates)), np.empty(end - first)
        # In two pieces, the second going on from where the first one ended.
        middle = int(generator.integers(first, end))
        before = np.zeros(candidates)
        for low, high in ((first, middle), (middle, end)):
            pieces = forward[low - first : high - first], evidence[low - first : high - first]
            pursuit_gibbs.forward_pass(
                kernel, parameters, chosen, weights, low, high, before, *pieces
            )
            pieces[0][:] /= pieces[1][:, None]
            before = pieces[0][-1] if high > low else before
        belief = weights
        for t in range(first, end):
            if t > first:
                transition = np.empty((candidates, candidates))
                for old in range(candidates):
                    rho = switch_probability(model, parameters, t, old)
                    transition[old] = rho * weights
                    transition[old, old] += 1.0 - rho
                belief = belief @ transition
            belief = belief * likelihood_of(model, parameters, t)
            assert evidence[t - first] == pytest.approx(belief.sum(), rel=1e-9)
            belief = belief / belief.sum()
            np.testing.assert_allclose(forward[t - first], belief, atol=1e-10)


@pytest.mark.parametrize("one_episode", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_the_evidence_of_many_weights_is_that_of_each_filter(seed: int, one_episode: bool) -> None:
    generator = np.random.default_rng(seed)
    model = random_model(seed, count=400)
    if one_episode:  # so long that messages have to be scaled
        part = model.state_part[model.state_of[0]]
        stays = np.flatnonzero(model.state_part[model.state_of] == part)
        model = replace(
            model,
            state_of=model.state_of[stays],
            action_of=model.action_of[stays],
            starts=np.arange(len(stays)) == 0,
        )
    parameters = parameters_drawn(model, generator)
    kernel = pursuit_gibbs.kernel_model(model)
    chosen = pursuit_gibbs.softmax_table(kernel, parameters[pursuit_gibbs.ALPHA])
    for part in range(kernel.parts):
        here = model.candidate_part == part
        weights = generator.gamma(0.3, size=(9, len(here))) * here
        weights /= weights.sum(axis=1, keepdims=True)
        bounds = pursuit_gibbs._episode_bounds(kernel, part)
        expected = np.zeros(9)
        for first, end in bounds:
            forward, evidence = np.empty((end - first, len(here))), np.empty(end - first)
            for trial in range(9):
                pursuit_gibbs.forward_pass(
                    kernel,
                    parameters,
                    chosen,
                    weights[trial],
                    first,
                    end,
                    weights[trial],
                    forward,
                    evidence,
                )
                expected[trial] += np.log(evidence).sum()
        if len(bounds):
            told = pursuit_gibbs._log_evidence(kernel, parameters, chosen, weights, bounds)
            np.testing.assert_allclose(told, expected, rtol=1e-9)


def test_ascent_finds_the_largest_of_every_history() -> None:
    # From any subgoals at all, which is harder than from the best draws of chains. It is
    # coordinate ascent, which may end lower: here in 1 of 150 cases, by half a nat; in 24 of 1,500
    # others, by 1.2 nats at most.
    found, cases = 0, 150
    for seed in range(cases):
        generator = np.random.default_rng(1000 + seed)
        model = random_model(seed, count=5, most_goals=3)
        parameters = parameters_drawn(model, generator)
        best = largest_joint(model, parameters)
        anywhere = [
            generator.choice(np.flatnonzero(model.candidate_part == model.state_part[state]))
            for state in model.state_of
        ]
        mode = pursuit_mode.ascend(model, anywhere, parameters)
        assert mode.log_joint <= best + 1e-8
        found += mode.log_joint >= best - 1e-8
    assert found >= 0.97 * cases


@pytest.mark.parametrize("seed", range(30))
def test_scores_of_partitions_are_sums_of_logarithms(seed: int) -> None:
    # A confidence up to 1,000: products of what is next to impossible must not run out of digits.
    generator = np.random.default_rng(seed)
    model = random_model(seed, count=200)
    parameters = parameters_drawn(model, generator)
    parameters[pursuit_gibbs.ALPHA] = 10.0 ** generator.uniform(-1.0, 3.0)
    parameters[pursuit_gibbs.SLIP] = generator.choice([0.0, parameters[pursuit_gibbs.SLIP]])
    kernel = pursuit_gibbs.kernel_model(model)
    chosen = pursuit_gibbs.softmax_table(kernel, parameters[pursuit_gibbs.ALPHA])
    part = model.state_part[model.state_of]
    groups, partition_of = np.unique(
        2 * part + generator.integers(2, size=len(part)), return_inverse=True
    )
    here = np.array([np.flatnonzero(model.candidate_part == p)[0] for p in part], dtype=np.int32)
    state = pursuit_gibbs.state_of(model, here, model.starts, parameters)
    state.partition_of[:] = partition_of
    scores = pursuit_gibbs.group_scores(kernel, state, chosen, np.int64(len(groups)))

    explained = (1.0 - parameters[pursuit_gibbs.SLIP]) * chosen[kernel.pair_of]
    slips = parameters[pursuit_gibbs.SLIP] * model.uniform[model.state_of]
    each = np.log(explained + slips[:, np.newaxis])
    usual = parameters[pursuit_gibbs.ELSEWHERE]
    floor = 1e-300
    for t in np.flatnonzero(~model.starts):
        for candidate in np.flatnonzero(model.arrived[model.state_of[t]]):
            rho = switch_probability(model, parameters, t, int(candidate))
            odds = (rho, usual) if state.switched[t] else (1.0 - rho, 1.0 - usual)
            gain = np.log(np.maximum(odds, floor))
            each[t - 1, candidate] += gain[0] - gain[1]
    for group in range(len(groups)):
        members = partition_of == group
        expected = each[members].sum(axis=0) + np.log(model.prior)
        expected[model.candidate_part != part[members][0]] = -np.inf
        np.testing.assert_allclose(scores[group], expected, rtol=1e-10, atol=1e-10)


@given(st.lists(st.floats(0.0, 1e6) | st.just(np.inf), max_size=600), st.floats(1e-3, 1e3))
def test_exponentials_are_those_of_the_library(values: list[float], factor: float) -> None:
    given_values = np.array(values, dtype=np.float64)
    found = np.empty_like(given_values)
    exponentials(given_values, -factor, found)
    expected = np.exp(np.maximum(-factor * given_values, -700.0))
    np.testing.assert_allclose(found, expected, rtol=2e-14)
    np.testing.assert_array_equal(found, exponentials_in_python(given_values, -factor))
    assert row_sum(found) == pytest.approx(expected.sum(), rel=1e-12)
    assert row_sum(found) == row_sum.py_func(found)


def exponentials_in_python(values: npt.NDArray[np.float64], factor: float) -> list[float]:
    """What the kernel is compiled from, run by Python itself."""
    result = np.empty_like(values)
    exponentials.py_func(values, factor, result)
    return result.tolist()


@given(st.lists(st.tuples(st.integers(-1, 3), st.booleans()), max_size=30))
def test_runs_are_maximal(told: list[tuple[int, bool]]) -> None:
    subgoal_of = [subgoal for subgoal, _ in told]
    starts = [t == 0 or begins for t, (_, begins) in enumerate(told)]
    plain: list[list[int]] = []  # subgoal, episode, first and last explained observation
    episode = 0
    for t, subgoal in enumerate(subgoal_of):
        episode += starts[t]
        if subgoal < 0:
            continue
        if plain and plain[-1][:2] == [subgoal, episode]:
            plain[-1][3] = t
        else:
            plain.append([subgoal, episode, t, t])
    first, last = runs(np.array(subgoal_of, dtype=np.int32), np.array(starts, dtype=bool))
    assert first.tolist() == [run[2] for run in plain]
    assert last.tolist() == [run[3] for run in plain]
    draws = np.array([subgoal_of, subgoal_of[::-1]], dtype=np.int32)
    counts = run_counts(draws, np.array(starts, dtype=bool), 4)
    assert counts[0].tolist() == [sum(run[0] == g for run in plain) for g in range(4)]
    assert counts[0].sum() == run_count(subgoal_of, starts)


def expected_steps(world: GridWorld, goal: int) -> npt.NDArray[np.float64]:
    """(S, A) expected number of steps until the goal after each action, acting best from then."""
    transitions = grid_transitions(
        world.free, list(map(tuple, STEPS[world.actions])), world.success
    )
    steps = np.zeros(world.free.size)
    for _ in range(100_000):
        after = 1.0 + (transitions @ steps).T
        new = after.min(axis=1)
        new[goal] = 0.0
        new[~world.free.reshape(-1)] = 0.0
        if np.abs(new - steps).max() < 1e-11:
            break
        steps = new
    return after


def test_delays_tend_to_the_expected_extra_steps() -> None:
    free = np.array([[1, 1, 1, 1], [1, 0, 1, 1], [1, 1, 1, 0]], dtype=bool)
    for moves, goal in ((4, 0), (8, 10)):
        errors = []
        for discount in (0.99, 0.999, 0.9999):
            world = GridWorld(free, moves, 0.8, discount)
            states = np.flatnonzero(free & (np.arange(12).reshape(3, 4) != goal))
            found = delays(goal_values(world, [goal], states, 1e-13), discount)[:, :, 0]
            steps = expected_steps(world, goal)[states]
            extra = steps - steps.min(axis=1, keepdims=True)
            errors.append(np.abs(found - extra).max())
        # Of up to two steps; in proportion to 1 - gamma.
        assert errors[0] <= 0.01
        assert errors[1] <= 0.001
        assert errors[2] <= 0.0001


def test_delays_tell_steps_whatever_the_reward_and_nothing_out_of_reach() -> None:
    free = np.array([[1, 1, 1, 0, 1]], dtype=bool)
    values = goal_values(GridWorld(free), [0, 2, 4], [0, 1, 2], 1e-13)
    found = delays(values, 0.99)
    np.testing.assert_allclose(delays(1000.0 * values, 0.99), found, atol=1e-9)
    assert (found[:, :, 2] == 0.0).all()  # beyond the wall
    assert (found.min(axis=1) == 0.0).all()
    assert (found >= 0.0).all()
    assert (delays(values, 0.0) == 0.0).all()
    certain = goal_values(GridWorld(free, 4, success=1.0), [0], [1, 2], 1e-13)
    # stay, E, N, W, S; from x = 1, a step east costs two, one west nothing, all else one
    np.testing.assert_allclose(delays(certain, 0.99)[0, :, 0], [1, 2, 1, 0, 1], atol=1e-6)


@st.composite
def small_worlds(draw: st.DrawFn) -> GridWorld:
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    cells = draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width))
    free = np.array(cells).reshape(height, width)
    free.flat[draw(st.integers(0, free.size - 1))] = True
    return GridWorld(free, draw(st.sampled_from([4, 8])), draw(st.sampled_from([0.6, 1.0])))


@settings(max_examples=60)
@given(small_worlds())
def test_actions_and_parts_are_those_of_the_transitions(world: GridWorld) -> None:
    steps = STEPS[world.actions].tolist()
    transitions = grid_transitions(world.free, steps, world.success)
    states = np.flatnonzero(world.free)
    same = [
        [
            next(b for b in range(len(steps)) if np.allclose(transitions[b, s], transitions[a, s]))
            for a in range(len(steps))
        ]
        for s in states
    ]
    assert world.same_action(states).tolist() == same
    mdp = FiniteMDP.from_transitions(world.transitions(), world.discount)
    assert mdp.same_action(states).tolist() == same
    as_dense = FiniteMDP.from_transitions(transitions, world.discount)
    assert as_dense.same_action(states).tolist() == same
    # A part is all that can be reached.
    ways = transitions.sum(axis=0) > 0.0
    reached = np.linalg.matrix_power(ways.astype(float) + np.eye(len(ways)), len(ways)) > 0.0
    parts = world.parts_of(states)
    np.testing.assert_array_equal(parts[:, None] == parts, reached[np.ix_(states, states)])
    assert (mdp.parts_of(states) == 0).all()
