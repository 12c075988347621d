"""When the chains stop: what counts as converged, and that it is told as it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bnirl_ros.inference.chains import (
    CONVERGED,
    SWEEP_LIMIT,
    TIME_BUDGET,
    Sampling,
    run_chains,
    run_until,
)
from bnirl_ros.inference.convergence import (
    HIGHEST_RHAT,
    LEAST_ESS,
    Convergence,
    convergence_of,
    traces_of,
)
from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.posterior import convergence_in, infer, model_of
from bnirl_ros.inference.running import RunningPosterior
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.views.tables import verdict
from test_running import placed

MAP = GridMap(np.ones((7, 7), dtype=bool))
MODELS = ("sequential", "paper")
CELLS = [[0, 0], [3, 1], [5, 2]]
STARTS = np.array([True, False, False, False, True, False])


def toy(second_subgoal: np.ndarray) -> Draws:
    """Draws of six observations: three for subgoal 0, three for the one that is given."""
    generator = np.random.default_rng(0)
    shape = second_subgoal.shape
    subgoal_of = np.zeros((*shape, 6), dtype=np.int32)
    subgoal_of[..., 3:] = second_subgoal[..., None]
    partition_of = np.broadcast_to(np.array([0, 0, 0, 1, 1, 1], dtype=np.int32), (*shape, 6))
    return Draws(subgoal_of, partition_of, generator.normal(size=shape), np.empty((*shape, 0)))


def agreement(draws: Draws) -> Convergence:
    return convergence_of(traces_of(draws, STARTS, CELLS, []))


@pytest.mark.parametrize("modes", [(1, 2, 1, 2), (1, 1, 1, 2)])
def test_chains_that_stay_in_modes_of_their_own_have_not_converged(modes: tuple[int, ...]) -> None:
    """Two modes of equal height, with equally many subgoals: only the cells tell them apart."""
    stuck = toy(np.repeat(np.array(modes)[:, None], 800, axis=1))
    blind = convergence_of({"the log joint": stuck.log_joint, "count": stuck.partition_count})
    assert blind.reached
    told = agreement(stuck)
    assert not told.reached
    assert told.rhat == float("inf")
    assert "R-hat of the subgoal (5, 2) is inf" in told.doubt
    # Rare changes from one to the other do not help much.
    rarely = np.repeat(np.array(modes)[:, None], 800, axis=1)
    rarely[0, 700:] = 3 - rarely[0, 0]
    assert agreement(toy(rarely)).rhat > 1.05


def test_chains_that_go_to_and_fro_have_converged() -> None:
    to_and_fro = toy(np.random.default_rng(1).integers(1, 3, size=(4, 800)))
    told = agreement(to_and_fro)
    assert told.reached
    assert told.rhat is not None
    assert told.rhat <= HIGHEST_RHAT
    assert told.ess is not None
    assert told.ess >= LEAST_ESS
    assert (told.chains, told.draws, told.doubt) == (4, 800, "")


def test_what_is_nearly_certain_is_not_watched() -> None:
    draws = toy(np.ones((4, 800), dtype=np.int64))
    names = {"the log joint", "the number of partitions"}
    assert set(traces_of(draws, STARTS, CELLS, [])) == names
    draws.subgoal_of[0, :80, 5] = 2  # 80 draws of 3,200
    assert set(traces_of(draws, STARTS, CELLS, [])) == names
    draws.subgoal_of[0, :200, 5] = 2
    assert set(traces_of(draws, STARTS, CELLS, [])) == {*names, "the subgoal (5, 2)"}


def test_parameters_are_watched_by_name() -> None:
    shape = (4, 500)
    drift = np.linspace(0.0, 3.0, 500)
    draws = toy(np.ones(shape, dtype=np.int64))
    draws = replace(draws, parameters=np.stack([draws.log_joint, draws.log_joint + drift], axis=2))
    told = convergence_of(traces_of(draws, STARTS, CELLS, ["alpha", "eta"]))
    assert (told.rhat_of, told.ess_of) == ("eta", "eta")
    assert "effective sample size of eta" in told.doubt


def test_where_nothing_can_be_told_nothing_has_converged() -> None:
    to_and_fro = np.random.default_rng(1).integers(1, 3, size=(4, 800))
    assert "one chain" in agreement(toy(to_and_fro[:1])).doubt
    assert "20 draws are too few" in agreement(toy(to_and_fro[:, :5])).doubt
    assert "396 draws are too few" in agreement(toy(to_and_fro[:, :99])).doubt
    many_short = np.random.default_rng(1).integers(1, 3, size=(200, 7))
    assert "1400 draws are too few" in agreement(toy(many_short)).doubt
    # A posterior that is a single point needs no more than to be seen often enough.
    point = {"the log joint": np.zeros((4, 100))}
    assert convergence_of(point).reached
    assert not convergence_of({"the log joint": np.zeros((4, 99))}).reached


def looks(before_enough: int) -> tuple[Callable[[Draws], bool], list[tuple[int, ...]]]:
    """An `is_enough` that says so at a later look, and the shapes of the draws that it saw."""
    seen: list[tuple[int, ...]] = []

    def is_enough(draws: Draws) -> bool:
        seen.append(draws.log_joint.shape)
        return len(seen) > before_enough

    return is_enough, seen


@pytest.mark.parametrize("model_name", MODELS)
@pytest.mark.parametrize(
    ("sweeps", "burn_in", "thin", "max_sweeps", "stopped_by", "ended"),
    [
        (60, 20, 1, 1000, 0, 60),
        (60, 20, 1, 1000, 2, 240),
        (61, 20, 3, 1000, 2, 244),
        (61, 60, 1, 150, 9, 150),
        (1700, 0, 1, 4000, 1, 3400),  # more than there is room for
        (1701, 203, 2, 3500, 9, 3500),
    ],
)
def test_going_on_gives_the_draws_of_as_many_sweeps_at_once(
    model_name: str,
    sweeps: int,
    burn_in: int,
    thin: int,
    max_sweeps: int,
    stopped_by: int,
    ended: int,
) -> None:
    settings = Settings(model=model_name, sweeps=sweeps, burn_in=burn_in, thin=thin, chains=2)
    demonstration = placed(1).demonstration
    _, model = model_of(demonstration, MAP, settings)
    is_enough, seen = looks(stopped_by)
    draws, sampling = run_until(is_enough, model, replace(settings, max_sweeps=max_sweeps))
    assert sampling.sweeps == ended
    assert sampling.stopped == (SWEEP_LIMIT if ended == max_sweeps else CONVERGED)
    assert seen[0] == (2, settings.draws)
    at_once = replace(
        settings, sweeps=sampling.sweeps, burn_in=sampling.burn_in, thin=sampling.thin
    )
    expected = run_chains(model, at_once)
    for name, values in vars(expected).items():
        np.testing.assert_array_equal(getattr(draws, name), values)
    assert len(seen) == min(stopped_by + 1, len(seen))
    room = max(sweeps // thin, 4 * LEAST_ESS) + 1
    assert max(kept for _, kept in seen) <= room


def test_a_time_budget_ends_the_sweeps_early_and_is_told() -> None:
    settings = Settings(model="paper", sweeps=5000, burn_in=200, time_budget=1e-9)
    found = infer(placed(1).demonstration, MAP, settings)
    assert found.sampling.stopped == TIME_BUDGET
    assert found.sampling.sweeps == 1
    assert found.draws.log_joint.shape == (4, 1)
    assert not found.convergence.reached
    told = verdict(found.convergence, found.sampling)
    assert "not converged after 1 sweeps, where the time budget was used up" in told
    assert "raise --time-budget" in told
    # One that is not used up changes nothing.
    plain = replace(settings, sweeps=300, time_budget=0.0)
    one, other = (
        infer(placed(1).demonstration, MAP, replace(plain, time_budget=budget))
        for budget in (0.0, 1e6)
    )
    assert one.sampling.stopped == other.sampling.stopped == SWEEP_LIMIT
    np.testing.assert_array_equal(one.draws.subgoal_of, other.draws.subgoal_of)


@pytest.mark.parametrize("model", MODELS)
def test_an_inference_goes_on_until_it_has_converged(model: str) -> None:
    settings = Settings(model=model, sweeps=40, burn_in=10, alpha=5.0, eta=1.0)
    demonstration = placed(1).demonstration
    short = infer(demonstration, MAP, settings)
    assert not short.convergence.reached
    assert short.sampling.stopped == SWEEP_LIMIT
    assert "; --max-sweeps 640 goes on" in verdict(short.convergence, short.sampling)
    going_on = replace(settings, max_sweeps=100_000)
    found, again = infer(demonstration, MAP, going_on), infer(demonstration, MAP, going_on)
    assert found.sampling.stopped == CONVERGED
    assert found.convergence.reached
    assert found.sampling.sweeps in {40 * 2**power for power in range(1, 11)}
    assert found.convergence == convergence_in(found.draws, demonstration, found.candidates)
    assert replace(found.sampling, seconds=0.0) == replace(again.sampling, seconds=0.0)
    np.testing.assert_array_equal(found.draws.subgoal_of, again.draws.subgoal_of)
    assert found.convergence.ess is not None
    assert found.ess_per_second == found.convergence.ess / found.sampling.seconds


@pytest.mark.parametrize("chains", [2, 4])
def test_running_chains_go_on_until_they_have_converged(chains: int) -> None:
    settings = Settings(model="paper", sweeps=40, burn_in=10, max_sweeps=1_000_000, chains=chains)
    running = RunningPosterior(placed(1), MAP, settings)
    looked_at = []
    while not running.finished:
        running.advance(16)
        posterior = running.posterior()
        looked_at.append(posterior.sampling)
    assert looked_at[-1].stopped == CONVERGED
    assert posterior.convergence.reached
    # Only where there are most draws: 1, 2, 4, ... times what there is room for, and soon.
    assert running.full
    assert running.sweeps in {256 * 2**power for power in range(5)}
    assert {each.stopped for each in looked_at[:-1]} == {None}
    # With other observations it begins again to ask.
    assert not RunningPosterior(placed(2), MAP, settings, running).finished
    limited = RunningPosterior(placed(1), MAP, replace(settings, max_sweeps=0))
    limited.advance(40)
    assert limited.finished
    assert limited.posterior().sampling.stopped == SWEEP_LIMIT
    hurried = RunningPosterior(placed(1), MAP, replace(settings, time_budget=1e-9))
    assert not hurried.finished
    hurried.advance(4)
    assert hurried.finished
    assert hurried.posterior().sampling.stopped == TIME_BUDGET


def test_one_chain_is_told_to_take_more() -> None:
    alone = Convergence(None, 500.0, "", "the log joint", chains=1, draws=800)
    told = verdict(alone, Sampling(1000, 200, 1, SWEEP_LIMIT, 1.0))
    assert told.endswith("take --chains 4")
