"""Watching a demonstrator: the filter against the textbook's."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.experiments.scenarios import outcome_of
from bnirl_ros.inference import filtering
from bnirl_ros.inference.filtering import (
    SubgoalFilter,
    filtered,
    foreseen,
    middle_of_draws,
    weights_of_draws,
)
from bnirl_ros.inference.posterior import Posterior, grid_world, infer, pursuit_model_of
from bnirl_ros.inference.prediction import log_predictive
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps import GridMap, parse_text_grid
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.model.likelihood import action_log_likelihood
from bnirl_ros.model.pursuits import PRIORS, PursuitModel, action_costs
from pursuit_reference import (
    Parameters,
    PursuitEnumeration,
    explained_probability,
    switch_probability,
    uniform_probability,
)
from test_pursuit_exactness import CASES, Case, small_model

MAP = parse_text_grid(".......\n.......\n...#...\n.......\n.......\n", "the filter's grid")
ONE_DRAW = {"chains": 1, "sweeps": 100, "burn_in": 99}
WITHOUT_LAST_POSES = (np.empty(0, dtype=np.int64), np.empty((0, 2), dtype=np.int64))

# The filter


def parameters_of(case: Case) -> Parameters:
    return np.array(case.parameters)


def random_weights(model: PursuitModel, seed: int) -> npt.NDArray[np.float64]:
    """(G,) random weights of the next subgoal, in each part of the map."""
    weights = np.random.default_rng(seed).random(len(model.candidate_part))
    return weights / np.bincount(model.candidate_part, weights=weights)[model.candidate_part]


def textbook_filter(
    model: PursuitModel, weights: npt.NDArray[np.float64], parameters: Parameters
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The forward algorithm of a hidden Markov chain, with a whole matrix of transitions.

    Belief after each action and before it, and the evidence of the action.
    """
    count, candidates = len(model.state_of), len(weights)
    belief, evidence = np.empty((count, candidates)), np.empty(count)
    before = np.empty((count, candidates))
    for t, (state, action) in enumerate(zip(model.state_of, model.action_of, strict=True)):
        part = model.state_part[state]
        drawn = np.array(
            [weights[g] * (model.candidate_part[g] == part) for g in range(candidates)]
        )
        if model.starts[t]:
            before[t] = drawn
        else:
            transition = np.empty((candidates, candidates))
            for g in range(candidates):
                rho = switch_probability(model, parameters, t, g)
                transition[g] = rho * drawn
                transition[g, g] += 1.0 - rho
            before[t] = belief[t - 1] @ transition
        slip = parameters[2]
        likelihood = [
            (1.0 - slip) * explained_probability(model, parameters, state, g)[action]
            + slip * uniform_probability(model, state)[action]
            for g in range(candidates)
        ]
        joint = before[t] * likelihood
        evidence[t] = joint.sum()
        belief[t] = joint / evidence[t]
    return belief, evidence, before


@pytest.mark.parametrize("name", CASES)
def test_filtering_is_the_textbooks(name: str) -> None:
    case = CASES[name]._replace(count=40)
    model = small_model(case, seed=1)
    weights = random_weights(model, seed=2)
    belief, evidence = filtered(model, weights, parameters_of(case))
    expected_belief, expected_evidence, before = textbook_filter(
        model, weights, parameters_of(case)
    )
    np.testing.assert_allclose(belief, expected_belief, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(evidence, expected_evidence, rtol=1e-9)
    np.testing.assert_allclose(belief.sum(axis=1), 1.0)
    expected = foreseen(model, weights, parameters_of(case))
    np.testing.assert_allclose(expected, before, rtol=1e-9, atol=1e-15)


def test_evidence_is_that_of_all_histories() -> None:
    # With an eta so large, the urn forgets what was drawn: every draw is from P(g).
    case = CASES["corridor"]._replace(parameters=(0.7, 1e9, 0.2, 0.8, 0.5, 0.1))
    model = small_model(case, seed=3)
    _, evidence = filtered(model, model.prior, parameters_of(case))
    exact = PursuitEnumeration(model, parameters_of(case))
    assert np.log(evidence).sum() == pytest.approx(exact.log_evidence, abs=1e-6)


# What a posterior knows of the next subgoal

ROUND = ((0, 0), (6, 0), (6, 4), (0, 4))


@cache
def walked(seed: int, episodes: int = 4) -> tuple[Demonstration, npt.NDArray[np.int64]]:
    """Rounds of a demonstrator, and the number in `ROUND` (N,) of what it was going for.

    It acts by (7), and moves as chosen with the probability of the default settings.
    """
    generator = np.random.default_rng(seed)
    world = grid_world(MAP, Settings())
    goals = world.states_of(ROUND)
    values = goal_values(world, goals, np.arange(world.state_count))
    policies = np.exp(action_log_likelihood(values, 100.0))
    outcomes = world.outcomes()
    rows = []
    for episode in range(episodes):
        state = int(world.states_of((3, 1))[0])
        for subgoal, goal in enumerate(goals):
            while state != goal:
                choice = int(generator.choice(len(world.actions), p=policies[state, :, subgoal]))
                rows.append((episode, state, world.actions[choice], subgoal))
                state = int(outcomes[state, outcome_of(choice, world, generator)])
    episode_of, states, actions, pursued = np.array(rows).T
    demonstration = Demonstration(
        episode_of,
        world.cells_of(states),
        actions,
        np.arange(episodes),
        world.cells_of([state] * episodes),
    )
    return demonstration, pursued


@cache
def posterior_with(**settings: object) -> Posterior:
    return infer(walked(seed=0)[0], MAP, Settings(**settings))


def model_of_draw(posterior: Posterior) -> PursuitModel:
    return pursuit_model_of(posterior.demonstration, posterior.candidates, MAP, posterior.settings)


def urn(posterior: Posterior, counts: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    eta = posterior.draws.parameters[0, 0, list(PRIORS).index("eta")]
    candidates = len(posterior.candidates)
    return (eta / candidates + counts) / (eta + counts.sum())


@pytest.mark.parametrize("rho", [0.0, 1.0])
def test_weights_of_a_draw_are_the_urns(rho: float) -> None:
    # With no switch, each episode is a draw; with a switch everywhere, each observation is.
    places = ("on_arrival", "at_subgoal", "elsewhere")
    posterior = posterior_with(**ONE_DRAW, slip=0.0, **{f"switch_{each}": rho for each in places})
    subgoal_of = posterior.draws.subgoal_of[0, 0]
    drawn = subgoal_of if rho else subgoal_of[posterior.demonstration.starts]
    counts = np.bincount(drawn, minlength=len(posterior.candidates))
    weights = weights_of_draws(posterior, model_of_draw(posterior), np.array([0]))
    np.testing.assert_allclose(weights, [urn(posterior, counts)])


def test_weights_count_pursuits_and_what_was_drawn_again() -> None:
    posterior = posterior_with(**ONE_DRAW, slip=0.0)
    subgoal_of, starts = posterior.draws.subgoal_of[0, 0], posterior.demonstration.starts
    begins = starts | (np.diff(subgoal_of, prepend=-1) != 0)
    fewest = np.bincount(subgoal_of[begins], minlength=len(posterior.candidates))
    (weights,) = weights_of_draws(posterior, model_of_draw(posterior), np.array([0]))
    assert weights.sum() == pytest.approx(1.0)
    # Hardly anything is drawn again where a switch on the way is rare.
    np.testing.assert_allclose(weights, urn(posterior, fewest), atol=0.02)
    assert (weights != urn(posterior, fewest)).all()


# Watching


def episode(demonstration: Demonstration, number: int) -> Demonstration:
    """One of its episodes alone."""
    here = demonstration.episode == number
    return Demonstration(
        demonstration.episode[here],
        demonstration.cells[here],
        demonstration.action[here],
        *WITHOUT_LAST_POSES,
    )


def test_observing_step_by_step_is_filtering_the_whole() -> None:
    # Of a single draw, the medians of the parameters and the mean of the weights are its own.
    posterior = posterior_with(**ONE_DRAW)
    watched, _ = walked(seed=1, episodes=2)
    weights = weights_of_draws(posterior, model_of_draw(posterior), np.array([0]))[0]
    model = pursuit_model_of(watched, posterior.candidates, MAP, posterior.settings)
    belief, _ = filtered(model, weights, posterior.draws.parameters[0, 0])
    watching = SubgoalFilter(posterior, MAP)
    assert watching.candidates is posterior.candidates
    for row, starts in enumerate(watched.starts):
        if starts:
            watching.begin_episode()
        now = watching.observe(watched.cells[row], int(watched.action[row]))
        np.testing.assert_allclose(now, belief[row], rtol=1e-9, atol=1e-15)


def expected_and_watched(
    posterior: Posterior, grid_map: GridMap, watched: Demonstration
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Belief before each action and after it, by a model of all that is watched."""
    weights, parameters = middle_of_draws(posterior)
    model = pursuit_model_of(watched, posterior.candidates, grid_map, posterior.settings)
    return foreseen(model, weights, parameters), filtered(model, weights, parameters)[0]


@pytest.mark.parametrize(
    "settings", [{}, {"arrival_radius": 1.0}, {"likelihood": "value"}], ids=str
)
def test_what_is_expected_in_a_cell_is_what_observing_there_begins_with(
    settings: dict[str, object],
) -> None:
    posterior = posterior_with(**ONE_DRAW, **settings)
    watched, _ = walked(seed=2, episodes=2)
    before, after = expected_and_watched(posterior, MAP, watched)
    watching = SubgoalFilter(posterior, MAP)
    for row, starts in enumerate(watched.starts):
        if starts:
            watching.begin_episode()
        expected = watching.expect(watched.cells[row])
        np.testing.assert_allclose(expected, before[row], rtol=1e-9, atol=1e-15)
        now = watching.observe(watched.cells[row], int(watched.action[row]))
        np.testing.assert_allclose(now, after[row], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("room", [None, 0, 500])
def test_cells_that_the_posterior_never_saw_are_watched_too(
    room: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if room is not None:  # costs for all other cells at once, for one after the other, for some
        monkeypatch.setattr(filtering, "_ROOM", room)
    edge = Demonstration(
        np.zeros(12, dtype=np.int64),
        np.array([(x, 0) for x in range(6)] * 2),
        np.full(12, ACTION_NAMES.index("E")),
        *WITHOUT_LAST_POSES,
    )
    posterior = infer(edge, MAP, Settings(**ONE_DRAW))
    watched = episode(walked(seed=3)[0], 0)
    assert not {*map(tuple, watched.cells.tolist())} <= {*map(tuple, edge.cells.tolist())}
    before, after = expected_and_watched(posterior, MAP, watched)
    watching = SubgoalFilter(posterior, MAP)
    half = len(watched) // 2
    first = watching.observe_all(watched.cells[:half], watched.action[:half])
    expected = watching.expect(watched.cells[half])
    second = watching.observe_all(watched.cells[half:], watched.action[half:])
    np.testing.assert_allclose(np.concatenate([first, second]), after, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(expected, before[half], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("success", [0.7, 0.9], ids=["the same world", "another world"])
def test_goal_values_of_an_older_filter_change_nothing(
    success: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = episode(walked(seed=3)[0], 0)
    whole, _ = walked(seed=0)

    def learnt(count: int, **settings: object) -> Posterior:
        first = Demonstration(
            whole.episode[:count],
            whole.cells[:count],
            whole.action[:count],
            *WITHOUT_LAST_POSES,
        )
        return infer(first, MAP, Settings(**ONE_DRAW, **settings))

    before = SubgoalFilter(learnt(6), MAP)
    before.observe_all(watched.cells, watched.action)  # all the map is known to it
    posterior = learnt(14, success=success)
    assert len(before.candidates) < len(posterior.candidates)
    expected = SubgoalFilter(posterior, MAP).observe_all(watched.cells, watched.action)
    solved: list[int] = []

    def counted(*of: Any) -> npt.NDArray[np.float64]:
        solved.append(len(of[2]))
        return action_costs(*of)

    monkeypatch.setattr(filtering, "action_costs", counted)
    after = SubgoalFilter(posterior, MAP, before)
    told = after.observe_all(watched.cells, watched.action)
    np.testing.assert_allclose(told, expected, rtol=1e-9, atol=1e-15)
    new = len(posterior.candidates) - len(before.candidates)
    assert solved == [new if success == 0.7 else len(posterior.candidates)]


def test_a_new_episode_forgets_the_one_before() -> None:
    watching = SubgoalFilter(posterior_with(**ONE_DRAW), MAP)
    fresh = watching.observe((3, 1), 2)
    on = watching.observe((3, 1), 2)
    assert np.abs(on - fresh).max() > 1e-3
    watching.begin_episode()
    np.testing.assert_array_equal(watching.observe((3, 1), 2), fresh)


def test_what_is_told_can_be_changed_without_changing_the_belief() -> None:
    watching = SubgoalFilter(posterior_with(**ONE_DRAW), MAP)
    other = SubgoalFilter(posterior_with(**ONE_DRAW), MAP)
    watching.observe((3, 1), 2)[:] = 0.0
    other.observe((3, 1), 2)
    np.testing.assert_array_equal(watching.observe((4, 2), 2), other.observe((4, 2), 2))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_belief_comes_to_rest_on_the_true_subgoal(seed: int) -> None:
    posterior = posterior_with(chains=2, sweeps=300, burn_in=100)
    watched, pursued = walked(seed, episodes=1)
    number_of = {
        tuple(cell): index for index, cell in enumerate(posterior.candidates.coordinates.tolist())
    }
    true = np.array([number_of[cell] for cell in ROUND])[pursued]
    watching = SubgoalFilter(posterior, MAP)
    belief = np.array(
        [
            watching.observe(cell, int(action))
            for cell, action in zip(watched.cells, watched.action, strict=True)
        ]
    )
    np.testing.assert_allclose(belief.sum(axis=1), 1.0)
    of_true = belief[np.arange(len(watched)), true]
    assert of_true.mean() > 0.8
    last = np.flatnonzero(np.diff(pursued, append=-1) != 0)
    assert len(last) == len(ROUND)
    assert (of_true[last] > 0.9).all()
    # It comes to know: right after a subgoal was reached, the next one is not yet sure.
    assert of_true[last].min() > of_true[last[:-1] + 1].min()


# What cannot be watched


def test_only_the_sequential_model_filters() -> None:
    posterior = posterior_with(model="paper", sweeps=20, burn_in=10)
    with pytest.raises(InputError, match="only the sequential model can be filtered"):
        SubgoalFilter(posterior, MAP)


ROOMS = parse_text_grid("...#.\n...#.\n...#.\n", "two rooms")


def posterior_in_a_room() -> Posterior:
    """Of a demonstrator with four moves that was never in the room on the right."""
    learnt = Demonstration(
        np.zeros(4, dtype=np.int64),
        np.array([(0, 0), (1, 0), (2, 0), (2, 1)]),
        np.array([1, 1, 3, 3]),
        *WITHOUT_LAST_POSES,
    )
    settings = Settings(chains=1, sweeps=30, burn_in=10, moves=4)
    return infer(learnt, ROOMS, settings)


def filter_in_a_room() -> SubgoalFilter:
    return SubgoalFilter(posterior_in_a_room(), ROOMS)


def test_what_lies_where_no_candidate_can_be_reached_is_not_foreseen() -> None:
    posterior = posterior_in_a_room()
    elsewhere = Demonstration(
        np.zeros(1, dtype=np.int64), np.array([(4, 1)]), np.array([1]), *WITHOUT_LAST_POSES
    )
    with pytest.raises(InputError, match="no candidate can be reached from it"):
        log_predictive(posterior, elsewhere, ROOMS)


def test_a_cell_that_cannot_be_watched_is_refused_and_changes_nothing() -> None:
    watching, other = filter_in_a_room(), filter_in_a_room()
    watching.observe((0, 0), 1)
    other.observe((0, 0), 1)
    for cell in ((3, 1), (4, 1), (5, 1), (-1, 1), (0, -1), (0, 3)):
        with pytest.raises(InputError, match=r"cell .* no candidate can be reached from it"):
            watching.observe(cell, 1)
        with pytest.raises(InputError, match=r"cell .* no candidate can be reached from it"):
            watching.expect(cell)
    np.testing.assert_array_equal(watching.observe((1, 0), 1), other.observe((1, 0), 1))


@pytest.mark.parametrize("action", [-1, 2, 8, 9])
def test_an_action_that_there_is_not_is_refused(action: int) -> None:
    with pytest.raises(InputError, match=f"action {action}: is none of 0, 1, 3, 5, 7"):
        filter_in_a_room().observe((2, 1), action)
