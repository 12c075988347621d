"""Chains that go on, and the thread in which they do."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from bnirl_ros.demonstrations.placement import Placement, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.inference import background, pursuit_mode
from bnirl_ros.inference.background import BackgroundInference, Result
from bnirl_ros.inference.particles import chosen_again
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.running import CAPACITY, RunningPosterior
from bnirl_ros.inference.settings import Settings
from bnirl_ros.maps.grid_map import FeatureMap, GridMap

MAP = GridMap(np.ones((7, 7), dtype=bool))
SETTINGS = Settings(sweeps=600, burn_in=200)
MODELS = ("sequential", "paper")
CORNERS = ((0, 0), (6, 0), (6, 6), (0, 6), (0, 0))
STEP = 500_000_000


def record_round(recorder: Recorder, episode: int, corners: tuple[tuple[int, int], ...]) -> None:
    """A walk from corner to corner that ends with a pose without action."""
    stamp = (1 + episode * 1000) * 1_000_000_000
    cell = np.array(corners[0])
    for corner in corners[1:]:
        while (step := np.sign(np.array(corner) - cell)).any():
            recorder.add_pose(stamp, "map", cell[0] + 0.5, cell[1] + 0.5)
            recorder.add_action(stamp, float(step[0]), float(step[1]))
            cell = cell + step
            stamp += STEP
    recorder.add_pose(stamp, "map", cell[0] + 0.5, cell[1] + 0.5)


def recorded(rounds: int) -> Recorder:
    recorder = Recorder()
    for episode in range(rounds):
        record_round(recorder, episode, CORNERS)
    return recorder


def placed(rounds: int) -> Placement:
    return place(recorded(rounds).snapshot(), MAP)


def subgoals_of(result_cells: np.ndarray, subgoal_of: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(cell) for cell in result_cells[np.unique(subgoal_of)].tolist()}


def finished(running: RunningPosterior) -> RunningPosterior:
    while not running.finished:
        running.advance(40)
    return running


@pytest.mark.parametrize("model", MODELS)
def test_running_chains_agree_with_fresh_ones(model: str) -> None:
    settings = replace(SETTINGS, model=model)
    fresh = infer(placed(3).demonstration, MAP, settings)
    running = None
    for rounds in (1, 2, 3):  # observations come round by round
        running = RunningPosterior(placed(rounds), MAP, settings, running)
        running.advance(10)
    assert running is not None
    posterior = finished(running).posterior()
    assert posterior.convergence.rhat is not None
    assert posterior.convergence.rhat < 1.05
    np.testing.assert_array_equal(posterior.mode.subgoal_of, fresh.mode.subgoal_of)
    if model == "paper":  # the other's mode is one at the medians of the draws' parameters
        assert posterior.mode.log_joint == pytest.approx(fresh.mode.log_joint)
    else:
        np.testing.assert_allclose(
            *(
                np.quantile(draws.parameters, 0.5, axis=(0, 1))
                for draws in (posterior.draws, fresh.draws)
            ),
            rtol=0.5,
        )
    # 96 and 400 draws a chain: probabilities known to some 0.05 and 0.03 at worst
    np.testing.assert_allclose(
        posterior.subgoal_probability(), fresh.subgoal_probability(), atol=0.25
    )


def test_what_was_known_keeps_its_place_in_the_chains() -> None:
    paper = replace(SETTINGS, model="paper")
    before = finished(RunningPosterior(placed(1), MAP, paper))
    after = RunningPosterior(placed(2), MAP, paper, before)
    count = len(before.placement.poses)
    for old, new in zip(before._states, after._states, strict=True):
        together = old.partition_of[:, None] == old.partition_of
        still = new.partition_of[:count, None] == new.partition_of[:count]
        np.testing.assert_array_equal(together, still)
        assert new.size_of_slot.sum() == 2 * count


def test_pursuits_go_on_in_the_chains() -> None:
    before = finished(RunningPosterior(placed(1), MAP, SETTINGS))
    after = RunningPosterior(placed(2), MAP, SETTINGS, before)
    count = len(before.placement.poses)
    cells_before, cells_after = before._candidates.coordinates, after._candidates.coordinates
    for old, new in zip(before._states, after._states, strict=True):
        np.testing.assert_array_equal(
            cells_before[old.subgoal_of], cells_after[new.subgoal_of[:count]]
        )
        np.testing.assert_array_equal(old.switched, new.switched[:count])
        np.testing.assert_array_equal(old.parameters, new.parameters)
        # The new episode is one pursuit, as long as nothing has been sampled.
        assert (new.subgoal_of[count:] == new.subgoal_of[count]).all()
        assert new.counts.sum() == old.counts.sum() + new.switched[count:].sum()


@pytest.mark.parametrize("model", MODELS)
def test_a_map_that_moves_keeps_subgoals_where_they_are(model: str) -> None:
    settings = replace(SETTINGS, model=model)
    recording = recorded(2).snapshot()
    moved = GridMap(np.ones((9, 9), dtype=bool), origin=(-2.0, -1.0, 0.0))
    before = finished(RunningPosterior(place(recording, MAP), MAP, settings))
    after = RunningPosterior(place(recording, moved), moved, settings, before)
    after.advance(1)
    assert subgoals_of(after._candidates.coordinates, after.posterior().mode.subgoal_of) == {
        (x + 2, y + 1) for x, y in CORNERS
    }


def test_feature_subgoals_go_on_by_their_coordinates() -> None:
    height, width = MAP.free.shape
    y, x = np.mgrid[:height, :width]
    blocks = FeatureMap(np.stack([x // 3, y // 3], axis=2), MAP.free)
    zones = replace(MAP, features=blocks)
    before = finished(RunningPosterior(placed(1), zones, SETTINGS))
    after = RunningPosterior(placed(2), zones, SETTINGS, before)
    count = len(before.placement.poses)
    old, new = before._candidates.coordinates, after._candidates.coordinates
    for was, now in zip(before._states, after._states, strict=True):
        np.testing.assert_array_equal(old[was.subgoal_of], new[now.subgoal_of[:count]])
    # A layer that comes or goes leaves nothing to go on from but the parameters.
    plain = RunningPosterior(placed(2), MAP, SETTINGS, after)
    plain.advance(1)
    for was, now in zip(after._states, plain._states, strict=True):
        assert len(now.counts) == len(plain._candidates) != len(was.counts)


def test_chains_go_on_where_the_oldest_was_forgotten() -> None:
    settings, recorder = replace(SETTINGS, sweeps=300, burn_in=100), Recorder(limit=60)
    running = None
    for round_ in range(4):
        record_round(recorder, round_, CORNERS)
        running = RunningPosterior(place(recorder.snapshot(), MAP), MAP, settings, running)
        finished(running)
    assert running is not None
    assert recorder.snapshot().forgotten[0] > 0
    fresh = infer(running.placement.demonstration, MAP, settings)
    assert subgoals_of(
        running._candidates.coordinates, running.posterior().mode.subgoal_of
    ) == subgoals_of(fresh.candidates.coordinates, fresh.mode.subgoal_of)


def test_memory_is_bounded_and_draws_span_all_sweeps() -> None:
    running = RunningPosterior(placed(1), MAP, replace(SETTINGS, sweeps=20 * CAPACITY))
    sweeps = []
    while not running.finished:
        running.advance(CAPACITY)
        sweeps.append(running.sweeps)
        assert running.posterior().draws.log_joint.shape[1] <= CAPACITY
    assert sweeps == sorted(set(sweeps))
    assert running.sweeps >= 20 * CAPACITY


@pytest.fixture
def workers() -> Iterator[Callable[[Recorder], BackgroundInference]]:
    made: list[BackgroundInference] = []

    def make(recorder: Recorder) -> BackgroundInference:
        made.append(BackgroundInference(recorder, SETTINGS, episode_gap=2.0))
        return made[-1]

    yield make
    for worker in made:
        worker.close()


def settled(worker: BackgroundInference) -> Result:
    """The last result, once the worker has nothing more to do."""
    result = None
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        idle = worker.idle
        result = worker.take_result() or result
        if idle and result is not None:
            return result
        time.sleep(0.01)
    raise AssertionError("the worker did not come to rest")


def test_results_come_by_themselves(workers: Callable[[Recorder], BackgroundInference]) -> None:
    recorder = recorded(1)
    worker = workers(recorder)
    worker.observations_arrived()  # no map yet
    worker.use_map(MAP)
    first = settled(worker)
    assert first.summary is not None
    assert {subgoal.cell for subgoal in first.summary.subgoals} == set(CORNERS)
    assert first.sweeps >= SETTINGS.sweeps
    record_round(recorder, 1, ((3, 3), (3, 5), (5, 3)))
    worker.observations_arrived()
    second = settled(worker)
    assert len(second.placement.demonstration) == 24 + 4
    assert not worker.error


def test_an_inference_asked_for_is_the_offline_one(
    workers: Callable[[Recorder], BackgroundInference],
) -> None:
    recorder = recorded(2)
    worker = workers(recorder)
    worker.use_map(MAP)
    result = worker.infer().result(timeout=120)
    offline = infer(placed(2).demonstration, MAP, SETTINGS)
    assert result.posterior is not None
    for name in ("subgoal_of", "partition_of", "log_joint"):
        np.testing.assert_array_equal(
            getattr(result.posterior.draws, name), getattr(offline.draws, name)
        )
    shown = settled(worker)  # and it stands: nothing has changed since
    assert shown.summary is result.summary


def test_without_map_or_observations_the_reason_is_told(
    workers: Callable[[Recorder], BackgroundInference],
) -> None:
    worker = workers(Recorder())
    with pytest.raises(InputError, match="no map yet"):
        worker.infer().result(timeout=60)
    worker.use_map(MAP)
    with pytest.raises(InputError, match="no observation"):
        worker.infer().result(timeout=60)
    assert settled(worker).summary is None


def test_pause_rests_reset_forgets_and_settings_change(
    workers: Callable[[Recorder], BackgroundInference],
) -> None:
    recorder = recorded(1)
    worker = workers(recorder)
    worker.pause(True)
    worker.use_map(MAP)
    time.sleep(0.2)
    assert worker.take_result() is None
    worker.pause(False)
    assert settled(worker).summary is not None
    worker.use_settings(replace(SETTINGS, chains=2))
    summary = settled(worker).summary
    assert summary is not None
    assert summary.chains == 2
    recorder.clear()
    worker.reset()
    assert settled(worker).summary is None


def test_the_thread_survives_what_goes_wrong(
    workers: Callable[[Recorder], BackgroundInference], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = recorded(1)
    worker = workers(recorder)

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("out of luck")

    with monkeypatch.context() as patch:
        patch.setattr(background, "place", broken)
        worker.use_map(MAP)
        deadline = time.monotonic() + 30
        while not worker.error and time.monotonic() < deadline:
            time.sleep(0.01)
        assert worker.error == "RuntimeError: out of luck"
    worker.observations_arrived()
    assert settled(worker).summary is not None
    assert not worker.error


def test_closing_does_not_wait_for_the_end_of_an_inference() -> None:
    recorder = recorded(2)
    long = replace(SETTINGS, sweeps=10_000_000, thin=10_000)
    worker = BackgroundInference(recorder, long, episode_gap=2.0)
    worker.use_map(MAP)
    request = worker.infer()
    while worker._requests:
        time.sleep(0.01)
    worker.close()
    assert request.cancelled()


def grown(model: str, **settings: float) -> tuple[RunningPosterior, RunningPosterior]:
    """A posterior whose chains have swept, and the next one, with a new episode to a new cell."""
    recorder = recorded(3)
    chosen = replace(SETTINGS, model=model, **settings)
    before = finished(RunningPosterior(place(recorder.snapshot(), MAP), MAP, chosen))
    before.advance(1)
    before.posterior()
    before.prepare()
    record_round(recorder, 3, ((0, 0), (6, 0), (6, 3), (5, 4)))
    return before, RunningPosterior(place(recorder.snapshot(), MAP), MAP, chosen, before)


@pytest.mark.parametrize("model", MODELS)
def test_new_observations_are_in_the_posterior_before_a_sweep(model: str) -> None:
    # A sweep comes first where less than a quarter of the draws is left in effect: for an episode
    # to a cell that was never visited, with two of the first twelve seeds (0.19 to 0.45 are left).
    before, after = grown(model, seed=1)
    assert after.ready
    assert after.sweeps == 0
    posterior = after.posterior()
    assert len(posterior.demonstration) == len(after.placement.poses) > len(before.placement.poses)
    assert len(posterior.candidates) == len(before.posterior().candidates) + 1
    fresh = infer(after.placement.demonstration, MAP, after.settings)
    np.testing.assert_array_equal(posterior.mode.subgoal_of, fresh.mode.subgoal_of)
    if model == "sequential":  # the joint of the mode is that of the sampler's kernels
        again = pursuit_mode.ascend(after._model, posterior.mode.subgoal_of, after._middle)
        assert posterior.mode.log_joint == pytest.approx(again.log_joint)
    # 32 draws: probabilities known to some 0.1 at worst
    np.testing.assert_allclose(
        posterior.subgoal_probability(), fresh.subgoal_probability(), atol=0.5
    )
    after.advance(40)
    assert after.posterior().draws.subgoal_of.shape[:2] == (4, 30)


@pytest.mark.parametrize("model", MODELS)
def test_draws_that_took_in_observations_have_the_joint_of_the_model(model: str) -> None:
    _, after = grown(model, **({} if model == "paper" else {"slip": 0.0}))
    particles = after._particles
    assert particles is not None
    draws, pairs = particles.draws, after._model
    for row in range(len(draws)):
        subgoal_of, partition_of = draws.subgoal_of[row], draws.partition_of[row]
        if model == "paper":
            _, first = np.unique(partition_of, return_index=True)
            expected = pairs.log_joint(partition_of, subgoal_of[first])
        else:
            expected = pairs.log_joint(subgoal_of, particles.switched[row], draws.parameters[row])
            counts = np.bincount(
                subgoal_of[particles.switched[row]], minlength=len(after._candidates)
            )
            np.testing.assert_array_equal(particles.counts[row], counts)
        assert draws.log_joint[row] == pytest.approx(expected)
        _, order = np.unique(partition_of, return_index=True)
        np.testing.assert_array_equal(partition_of[np.sort(order)], np.arange(len(order)))


def test_draws_are_chosen_again_as_often_as_their_weights_say() -> None:
    weights = np.array([0.1, 0.4, 0.0, 0.5])
    generator = np.random.default_rng(0)
    chosen = np.array([chosen_again(weights, generator) for _ in range(2000)])
    times = np.stack([(chosen == parent).sum(axis=1) for parent in range(4)], axis=1)
    np.testing.assert_allclose(times.mean(axis=0), 4 * weights, atol=0.05)
    assert (np.abs(times - 4 * weights) < 1.0).all()
    assert (chosen[:, 3] == 3).all()  # who is chosen stays where it is
