"""Which action comes next: against enumerations and the textbook, in tiny cases and on the way."""

from __future__ import annotations

from dataclasses import replace
from math import lgamma

import numpy as np
import pytest

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.filtering import evenly_spaced_draws, filtered, weights_of_draws
from bnirl_ros.inference.mode import Mode
from bnirl_ros.inference.posterior import Posterior, grid_world, infer, pursuit_model_of
from bnirl_ros.inference.prediction import (
    NEW_SUBGOAL,
    Prediction,
    beginning_in,
    by_outcome,
    log_predictive,
    predict,
    predict_at,
    predict_from_mode,
    shared_evenly,
)
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import FeatureMap, GridMap, parse_text_grid
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.model.likelihood import action_log_likelihood
from pursuit_reference import PursuitEnumeration, likelihood_of
from reference import set_partitions
from test_filtering import (
    MAP,
    ONE_DRAW,
    WITHOUT_LAST_POSES,
    episode,
    model_of_draw,
    posterior_with,
    textbook_filter,
    walked,
)

PREDICTORS = pytest.mark.parametrize("predictor", [predict, predict_from_mode])
MODELS = pytest.mark.parametrize("model", ["sequential", "paper"])


def seen(*rows: tuple[int, int, int, str]) -> Demonstration:
    """Observations (episode, x, y, name of the action)."""
    episodes, x, y, names = zip(*rows, strict=True)
    return Demonstration(
        np.array(episodes),
        np.column_stack([x, y]),
        np.array([ACTION_NAMES.index(name) for name in names]),
        *WITHOUT_LAST_POSES,
    )


def with_action(demonstration: Demonstration, t: int, action: int) -> Demonstration:
    """What was seen up to t, which is changed to this action."""
    actions = demonstration.action[: t + 1].copy()
    actions[t] = action
    return Demonstration(
        demonstration.episode[: t + 1],
        demonstration.cells[: t + 1],
        actions,
        *WITHOUT_LAST_POSES,
    )


# The paper's model

LANE = parse_text_grid("...\n.#.\n", "a lane with two ends")
LEARNT = seen((0, 0, 0, "N"), (0, 0, 1, "E"), (0, 1, 1, "E"), (0, 2, 1, "S"), (0, 2, 0, "stay"))


def log_evidence(posterior: Posterior, demonstration: Demonstration, grid_map: GridMap) -> float:
    """Log P(actions) under the mixture: the sum over every set partition and every subgoal."""
    world = grid_world(grid_map, posterior.settings)
    states = world.states_of(demonstration.cells)
    fixed = posterior.settings.fixed
    values = goal_values(world, posterior.candidates.goals, states)
    policies = np.exp(action_log_likelihood(values, fixed["alpha"]))
    columns = np.searchsorted(world.actions, demonstration.action)
    likelihood = policies[np.arange(len(states)), columns]
    total = 0.0
    for labels in map(np.array, set_partitions(len(states))):
        weight = 1.0
        for label in range(labels.max() + 1):
            block = likelihood[labels == label]
            seats = np.prod(np.arange(1, len(block)))
            weight *= fixed["eta"] * seats * block.prod(axis=0).mean()
        total += weight
    eta, count = fixed["eta"], len(states)
    return float(np.log(total) - (lgamma(eta + count) - lgamma(eta)))


@pytest.mark.parametrize("eta", [0.5, 4.0])
def test_the_papers_predictive_is_that_of_all_set_partitions(eta: float) -> None:
    settings = Settings(model="paper", alpha=2.0, eta=eta, sweeps=8000, burn_in=100, moves=4)
    posterior = infer(LEARNT, LANE, settings)
    before = log_evidence(posterior, LEARNT, LANE)
    cells = ((0, 0), (1, 1), (2, 0))
    told = predict_at(posterior, cells, LANE)
    for row, cell in enumerate(cells):
        for column, action in enumerate(told.actions):
            name = ACTION_NAMES[action]
            rows = [(0, *LEARNT.cells[t], ACTION_NAMES[LEARNT.action[t]]) for t in range(5)]
            together = seen(*rows, (0, *cell, name))
            exact = np.exp(log_evidence(posterior, together, LANE) - before)
            assert told.probability[row, column] == pytest.approx(exact, abs=0.004)


def with_mode(posterior: Posterior, partition_of: list[int], subgoals: list[int]) -> Posterior:
    """The posterior with another mode: the subgoal of each partition."""
    labels = np.array(partition_of, dtype=np.int32)
    return replace(posterior, mode=Mode(np.array(subgoals, dtype=np.int32)[labels], labels, 0.0))


def test_equation_19_takes_the_policy_of_the_largest_partition() -> None:
    settings = Settings(model="paper", alpha=2.0, sweeps=20, burn_in=10, moves=4)
    posterior = with_mode(infer(LEARNT, LANE, settings), [0, 1, 1, 1, 2], [0, 3, 1])
    world = grid_world(LANE, settings)
    states = np.flatnonzero(world.free)
    values = goal_values(world, posterior.candidates.goals, states)
    policies = np.exp(action_log_likelihood(values, 2.0))  # (state, action, subgoal)
    told = predict_from_mode(posterior, beginning_in(world.cells_of(states)), LANE)
    # (19) as it stands: CRP weight times likelihood, summed over the actions.
    by_partition = [
        size * policies[:, :, subgoal].sum(axis=1) for size, subgoal in ((1, 0), (3, 3), (1, 1))
    ]
    by_partition.append(settings.fixed["eta"] * policies.sum(axis=1).mean(axis=1))
    chosen = np.array(by_partition).argmax(axis=0)
    assert set(chosen.tolist()) == {1}
    assert told.subgoal.tolist() == [3] * len(states)
    np.testing.assert_allclose(told.probability, policies[:, :, 3])
    np.testing.assert_allclose(told.subgoal_probability, 3 / (5 + 1))


def test_equation_19_takes_a_new_partition_where_that_is_likelier() -> None:
    settings = Settings(model="paper", alpha=2.0, eta=3.5, sweeps=20, burn_in=10, moves=4)
    posterior = with_mode(infer(LEARNT, LANE, settings), [0, 1, 1, 1, 2], [0, 3, 1])
    world = grid_world(LANE, settings)
    told = predict_from_mode(posterior, beginning_in([(1, 1)]), LANE)
    values = goal_values(world, posterior.candidates.goals, world.states_of([(1, 1)]))
    policies = np.exp(action_log_likelihood(values, 2.0))
    assert told.subgoal.tolist() == [NEW_SUBGOAL]
    np.testing.assert_allclose(told.probability, policies.mean(axis=2))
    np.testing.assert_allclose(told.subgoal_probability, 3.5 / 8.5)


# The sequential model


@pytest.mark.parametrize("likelihood", ["delay", "value"])
def test_the_sequential_predictive_is_the_textbooks(likelihood: str) -> None:
    posterior = posterior_with(**ONE_DRAW, likelihood=likelihood)
    watched = episode(walked(seed=1)[0], 0)
    world = grid_world(MAP, posterior.settings)
    same = world.same_action(world.states_of(watched.cells))
    told = predict(posterior, watched, MAP)
    (weights,), (parameters,) = evenly_spaced_draws(posterior)
    for t in (0, 1, 5, len(watched) - 1):
        for column, action in enumerate(world.actions):
            trial = with_action(watched, t, int(action))
            model = pursuit_model_of(trial, posterior.candidates, MAP, posterior.settings)
            _, evidence, before = textbook_filter(model, weights, parameters)
            alike = (same[t] == same[t, column]).sum() if likelihood == "delay" else 1
            assert told.probability[t, column] == pytest.approx(evidence[t] / alike)
        assert told.subgoal[t] == before[t].argmax()
        assert told.subgoal_probability[t] == pytest.approx(before[t].max())


def test_the_sequential_predictive_is_that_of_all_histories() -> None:
    # With an eta so large, the urn forgets what was drawn: every draw is from P(g).
    parameters = (1.2, 1e9, 0.1, 0.8, 0.5, 0.1)
    names = ("alpha", "eta", "slip", "switch_on_arrival", "switch_at_subgoal", "switch_elsewhere")
    fixed = dict(zip(names, parameters, strict=True))
    settings = Settings(chains=1, sweeps=20, burn_in=10, moves=4, **fixed)
    posterior = infer(LEARNT, LANE, settings)
    watched = seen((0, 1, 1, "W"), (0, 0, 1, "S"), (0, 0, 0, "W"), (0, 0, 0, "N"))
    told = predict(posterior, watched, LANE)
    world = grid_world(LANE, settings)
    same = world.same_action(world.states_of(watched.cells))
    for t in range(len(watched)):
        evidence = np.empty(len(world.actions))
        for column, action in enumerate(world.actions):
            trial = with_action(watched, t, int(action))
            model = pursuit_model_of(trial, posterior.candidates, LANE, settings)
            exact = PursuitEnumeration(model, np.array(parameters))
            evidence[column] = np.exp(exact.log_evidence)
        distinct = by_outcome(np.ones((1, 5)), same[t : t + 1])[0]
        total = (evidence * (distinct > 0)).sum()
        expected = evidence / total / distinct[same[t]]
        np.testing.assert_allclose(told.probability[t], expected, rtol=1e-6)


def test_the_likeliest_subgoal_so_far_gives_the_action() -> None:
    posterior = posterior_with(**ONE_DRAW)
    watched = walked(seed=1, episodes=2)[0]
    told = predict_from_mode(posterior, watched, MAP)
    (weights,), (parameters,) = evenly_spaced_draws(posterior)
    model = pursuit_model_of(watched, posterior.candidates, MAP, posterior.settings)
    before = textbook_filter(model, weights, parameters)[2]
    np.testing.assert_array_equal(told.subgoal, before.argmax(axis=1))
    np.testing.assert_allclose(told.subgoal_probability, before.max(axis=1))
    columns = np.searchsorted(told.actions, watched.action)
    for t, subgoal in enumerate(told.subgoal):
        alike = (told.same[t] == told.same[t, columns[t]]).sum()
        expected = likelihood_of(model, parameters, t)[subgoal] / alike
        assert told.probability[t, columns[t]] == pytest.approx(expected)


def test_a_prediction_over_draws_is_their_mean() -> None:
    posterior = posterior_with(chains=2, sweeps=102, burn_in=99)
    watched = episode(walked(seed=1)[0], 0)
    mean = np.mean([predict(each, watched, MAP).probability for each in singles(posterior)], 0)
    np.testing.assert_allclose(predict(posterior, watched, MAP).probability, mean, rtol=1e-12)


def singles(posterior: Posterior) -> list[Posterior]:
    """A posterior of each of its draws."""
    chains, draws = posterior.draws.log_joint.shape
    return [
        replace(
            posterior,
            draws=replace(
                posterior.draws,
                **{
                    name: values[chain : chain + 1, draw : draw + 1]
                    for name, values in vars(posterior.draws).items()
                },
            ),
        )
        for chain in range(chains)
        for draw in range(draws)
    ]


# Both models


def check(told: Prediction, count: int) -> None:
    """One of the actions comes next, and those that do the same are equally probable."""
    assert told.probability.shape == told.same.shape == (count, len(told.actions))
    np.testing.assert_allclose(told.probability.sum(axis=1), 1.0)
    assert (told.probability > 0.0).all()
    first = np.take_along_axis(told.probability, told.same, axis=1)
    np.testing.assert_allclose(told.probability, first, rtol=1e-9)
    assert ((told.subgoal_probability > 0.0) & (told.subgoal_probability <= 1.0)).all()


@MODELS
@PREDICTORS
@pytest.mark.parametrize("moves", [4, 8])
def test_one_of_all_actions_comes_next(predictor, model: str, moves: int) -> None:  # type: ignore[no-untyped-def]
    learnt = seen((0, 0, 0, "N"), (0, 0, 1, "E"), (0, 1, 1, "E"), (1, 2, 1, "S"), (1, 2, 0, "E"))
    settings = Settings(model=model, moves=moves, chains=2, sweeps=40, burn_in=20)
    posterior = infer(learnt, LANE, settings)
    everywhere = [(x, y) for x in range(3) for y in range(2) if LANE.free[y, x]]
    for told in (
        predictor(posterior, learnt, LANE),
        predictor(posterior, beginning_in(everywhere), LANE),
    ):
        check(told, 5)
        assert told.actions.tolist() == grid_world(LANE, settings).actions.tolist()


@MODELS
def test_what_is_done_in_the_end_does_not_change_what_was_foreseen(model: str) -> None:
    posterior = posterior_with(model=model, chains=1, sweeps=60, burn_in=30)
    watched = episode(walked(seed=1)[0], 0)
    told = predict(posterior, watched, MAP).probability
    for action in (0, 3, 7):
        other = predict(posterior, with_action(watched, 6, action), MAP).probability
        np.testing.assert_array_equal(other, told[:7])


def test_the_episode_so_far_counts_for_the_sequential_model_alone() -> None:
    watched = episode(walked(seed=1)[0], 0)
    fresh = beginning_in(watched.cells)
    for model in ("sequential", "paper"):
        posterior = posterior_with(model=model, chains=1, sweeps=60, burn_in=30)
        told = predict(posterior, watched, MAP).probability
        alone = predict(posterior, fresh, MAP).probability
        np.testing.assert_array_equal(predict_at(posterior, watched.cells, MAP).probability, alone)
        np.testing.assert_allclose(told[0], alone[0])
        apart = np.abs(told - alone).max()
        assert apart > 0.1 if model == "sequential" else apart == 0.0
        # Each episode is one for itself.
        twice = Demonstration(
            np.repeat([0, 1], len(watched)),
            np.tile(watched.cells, (2, 1)),
            np.tile(watched.action, 2),
            *WITHOUT_LAST_POSES,
        )
        np.testing.assert_allclose(
            predict(posterior, twice, MAP).probability, np.tile(told, (2, 1))
        )


def test_what_actions_do_alike_is_what_counts() -> None:
    probability = np.array([[0.2, 0.35, 0.25, 0.2]])
    same = np.array([[0, 1, 0, 0]])
    np.testing.assert_allclose(by_outcome(probability, same), [[0.65, 0.35, 0.0, 0.0]])
    np.testing.assert_allclose(
        shared_evenly(probability, same), [[0.65 / 3, 0.35, 0.65 / 3, 0.65 / 3]]
    )
    # The second action is the most probable one, and yet it is likelier to stay, by whichever.
    told = Prediction(np.array([0, 1, 3, 5]), probability, same, np.zeros(1), np.ones(1))
    assert told.most_probable.tolist() == [0]


@PREDICTORS
@MODELS
def test_features_are_foreseen_as_cells_are(predictor, model: str) -> None:  # type: ignore[no-untyped-def]
    labels = np.array([[1, 1, 1, 2, 2, 3, 3]] * 5)[:, :, None]
    rooms = replace(MAP, features=FeatureMap(labels, np.ones(MAP.free.shape, bool)))
    rows = [(number, x, y, "E") for number, y in enumerate((0, 1, 3, 4)) for x in range(2, 5)]
    rows += [(number, 5, y, "stay") for number, y in enumerate((0, 1, 3, 4)) for _ in range(3)]
    posterior = infer(seen(*rows), rooms, Settings(model=model, sweeps=200, burn_in=100))
    told = predictor(posterior, seen((0, 3, 1, "E"), (0, 4, 1, "E")), rooms)
    check(told, 2)
    np.testing.assert_array_equal(posterior.candidates.coordinates[told.subgoal], [[3], [3]])
    east = told.probability[:, [2, 1, 8]].sum(axis=1)  # NE, E, SE: equally near the room
    assert (east > 0.5).all()


@MODELS
def test_what_cannot_be_foreseen_is_refused(model: str) -> None:
    settings = Settings(model=model, moves=4, chains=1, sweeps=20, burn_in=10)
    posterior = infer(LEARNT, LANE, settings)
    for cell, words in (((1, 0), "is blocked"), ((3, 0), "is outside"), ((0, -1), "is outside")):
        with pytest.raises(InputError, match=rf"cell \({cell[0]}, {cell[1]}\) {words}"):
            predict_at(posterior, [(0, 0), cell], LANE)
        with pytest.raises(InputError, match=words):
            predict_from_mode(posterior, beginning_in([cell]), LANE)
    with pytest.raises(InputError, match="action 2: is none of 0, 1, 3, 5, 7"):
        predict(posterior, seen((0, 0, 0, "NE")), LANE)


def test_where_no_candidate_can_be_reached_only_the_papers_model_foresees() -> None:
    grid_map = parse_text_grid("..#.\n", "two rooms")
    learnt = seen((0, 0, 0, "E"), (0, 1, 0, "stay"))
    quick = Settings(moves=4, chains=1, sweeps=20, burn_in=10)
    with pytest.raises(InputError, match=r"cell \(3, 0\): no candidate can be reached from it"):
        predict_at(infer(learnt, grid_map, quick), [(3, 0)], grid_map)
    posterior = infer(learnt, grid_map, replace(quick, model="paper"))
    np.testing.assert_allclose(predict_at(posterior, [(3, 0)], grid_map).probability, 0.2)


# The sequential model's own probability of what was done


def test_log_predictive_of_a_single_draw_is_its_evidence() -> None:
    posterior = posterior_with(**ONE_DRAW)
    watched, _ = walked(seed=1, episodes=2)
    weights = weights_of_draws(posterior, model_of_draw(posterior), np.array([0]))[0]
    model = pursuit_model_of(watched, posterior.candidates, MAP, posterior.settings)
    _, evidence = filtered(model, weights, posterior.draws.parameters[0, 0])
    foreseen = log_predictive(posterior, watched, MAP)
    np.testing.assert_allclose(foreseen, np.log(evidence), rtol=1e-12)
    # Episodes are foreseen each for itself.
    apart = [log_predictive(posterior, episode(watched, number), MAP) for number in (0, 1)]
    np.testing.assert_allclose(foreseen, np.concatenate(apart), rtol=1e-12)


def test_log_predictive_is_the_mean_over_draws() -> None:
    posterior = posterior_with(chains=2, sweeps=102, burn_in=99)
    watched, _ = walked(seed=1, episodes=1)
    foreseen = [log_predictive(each, watched, MAP) for each in singles(posterior)]
    expected = np.log(np.exp(foreseen).mean(axis=0))
    np.testing.assert_allclose(log_predictive(posterior, watched, MAP), expected, rtol=1e-12)


@pytest.mark.parametrize("likelihood", ["delay", "value"])
@pytest.mark.parametrize("rows", [1, 4, 12])
def test_one_of_what_the_model_tells_apart_comes_next(likelihood: str, rows: int) -> None:
    posterior = posterior_with(chains=2, sweeps=60, burn_in=30, likelihood=likelihood)
    watched = episode(walked(seed=1)[0], 0)
    world = grid_world(MAP, posterior.settings)
    state = world.states_of(watched.cells[rows - 1])
    # By delay, blocked moves are staying.
    distinct = set(
        world.actions if likelihood == "value" else world.actions[world.same_action(state)[0]]
    )
    probability = []
    for action in distinct:
        actions = watched.action[:rows].copy()
        actions[-1] = action
        trial = Demonstration(
            watched.episode[:rows], watched.cells[:rows], actions, *WITHOUT_LAST_POSES
        )
        probability.append(np.exp(log_predictive(posterior, trial, MAP)[-1]))
    assert sum(probability) == pytest.approx(1.0)
    assert min(probability) > 0.0


def test_the_papers_model_has_no_filter_to_foresee_with() -> None:
    posterior = posterior_with(model="paper", sweeps=20, burn_in=10)
    with pytest.raises(InputError, match="only the sequential model can be filtered"):
        log_predictive(posterior, walked(seed=1)[0], MAP)
