"""From a demonstration to posterior, mode and summary."""

from __future__ import annotations

from dataclasses import replace
from threading import Event

import numpy as np
import pytest

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.errors import InputError
from bnirl_ros.inference.chains import StoppedError, run_chains
from bnirl_ros.inference.mode import ascend
from bnirl_ros.inference.posterior import Posterior, grid_world, infer, paper_model
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import episode_visits, summarise
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.mdp.finite_mdp import FiniteMDP
from bnirl_ros.model.mixture import subgoal_mixture
from reference import set_partitions

MAP = GridMap(np.ones((7, 7), dtype=bool), resolution=0.5, origin=(-1.0, 2.0, 0.0))
QUICK = Settings(sweeps=300, burn_in=100, chains=3)


def walk(*corners: tuple[int, int], episodes: int = 2) -> Demonstration:
    """Straight from corner to corner (king's moves), staying once at each but the first."""
    observations, last = [], []
    for episode in range(episodes):
        cell = np.array(corners[0])
        for corner in corners[1:]:
            while True:
                step = np.sign(np.array(corner) - cell)
                action = int(np.flatnonzero((step == STEPS).all(axis=1))[0])
                observations.append([episode, *cell, action])
                if action == 0:
                    break
                cell = cell + step
        last.append(cell)
    table = np.array(observations)
    return Demonstration(
        table[:, 0], table[:, 1:3], table[:, 3], np.arange(episodes), np.array(last)
    )


ROUND = walk((0, 0), (6, 0), (6, 6), (0, 6), (0, 0))


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return infer(ROUND, MAP, QUICK)


def test_finds_the_corners_in_their_order(posterior: Posterior) -> None:
    summary = summarise(posterior, MAP)
    by_rank = {subgoal.rank: subgoal for subgoal in summary.subgoals}
    assert [by_rank[rank].cell for rank in summary.visit_sequence] == [
        (6, 0),
        (6, 6),
        (0, 6),
        (0, 0),
    ]
    assert [by_rank[rank].visit_order for rank in summary.visit_sequence] == [
        (1,),
        (2,),
        (3,),
        (4,),
    ]
    assert sum(subgoal.observations for subgoal in summary.subgoals) == len(ROUND)
    counts = [subgoal.observations for subgoal in summary.subgoals]
    assert counts == sorted(counts, reverse=True)
    for subgoal in summary.subgoals:
        assert subgoal.probability == summary.cell_probability[subgoal.cell[1], subgoal.cell[0]]
        assert subgoal.probability > 0.95
        assert subgoal.position == (
            -1.0 + 0.5 * (subgoal.cell[0] + 0.5),
            2.0 + 0.5 * (subgoal.cell[1] + 0.5),
        )


def test_equal_seeds_give_equal_posteriors_and_others_do_not(posterior: Posterior) -> None:
    again = infer(ROUND, MAP, QUICK)
    for name in ("subgoal_of", "partition_of", "log_joint"):
        np.testing.assert_array_equal(getattr(posterior.draws, name), getattr(again.draws, name))
    other = infer(ROUND, MAP, replace(QUICK, seed=1))
    assert (other.draws.log_joint != posterior.draws.log_joint).any()


def test_chains_do_not_depend_on_how_many_there_are(posterior: Posterior) -> None:
    one = infer(ROUND, MAP, replace(QUICK, chains=1))
    np.testing.assert_array_equal(one.draws.subgoal_of[0], posterior.draws.subgoal_of[0])
    assert one.rhat is None


def test_burn_in_and_thinning_choose_sweeps_of_the_same_chain() -> None:
    whole = infer(ROUND, MAP, Settings(sweeps=100, burn_in=0, chains=1))
    part = infer(ROUND, MAP, Settings(sweeps=100, burn_in=30, thin=4, chains=1))
    # burn-in sweeps, then the last of every four
    np.testing.assert_array_equal(part.draws.log_joint[0], whole.draws.log_joint[0, 33:100:4])


def test_probabilities_are_shares_of_the_draws(posterior: Posterior) -> None:
    drawn = posterior.draws.subgoal_of.reshape(-1, len(ROUND))
    shares = posterior.assignment_probability()
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    for candidate in range(len(posterior.candidates)):
        assert posterior.subgoal_probability()[candidate] == pytest.approx(
            (drawn == candidate).any(axis=1).mean()
        )
        assert shares[5, candidate] == pytest.approx((drawn[:, 5] == candidate).mean())


def test_last_poses_are_candidates_and_free_cells_on_request() -> None:
    demonstration = walk((0, 0), (3, 0), episodes=1)
    moved_on = replace(demonstration, last_cells=np.array([[4, 1]]))
    candidates, _ = paper_model(moved_on, MAP, Settings())
    assert candidates.tolist() == [[0, 0], [1, 0], [2, 0], [3, 0], [4, 1]]
    candidates, _ = paper_model(moved_on, MAP, Settings(candidates="free"))
    assert len(candidates) == 49


def test_the_mode_is_the_largest_of_every_partition_and_subgoal() -> None:
    for seed in range(8):
        generator = np.random.default_rng(seed)
        count = 6
        demonstration = Demonstration(
            np.zeros(count, dtype=np.int64),
            generator.integers(4, size=(count, 2)),
            generator.integers(9, size=count),
            np.empty(0, dtype=np.int64),
            np.empty((0, 2), dtype=np.int64),
        )
        settings = Settings(alpha=0.5 + seed / 4, eta=0.2 + seed, sweeps=300, chains=4)
        _, mixture = paper_model(demonstration, MAP, settings)
        posterior = infer(demonstration, MAP, settings)
        by_observation = mixture.log_likelihood[mixture.pair_of]
        best = -np.inf
        for labels in map(np.array, set_partitions(count)):
            subgoals = [
                int((mixture.log_prior + by_observation[labels == block].sum(axis=0)).argmax())
                for block in range(labels.max() + 1)
            ]
            best = max(best, mixture.log_joint(labels, subgoals))
        assert posterior.mode.log_joint == pytest.approx(best, abs=1e-9)


def test_ascent_never_loses_and_tells_its_log_joint(posterior: Posterior) -> None:
    _, mixture = paper_model(ROUND, MAP, QUICK)
    for draw in range(0, 200, 20):
        chain = posterior.draws[0]
        mode = ascend(mixture, chain.partition_of[draw], chain.subgoal_of[draw])
        assert mode.log_joint >= chain.log_joint[draw] - 1e-9
        _, first = np.unique(mode.partition_of, return_index=True)
        assert (np.diff(first) > 0).all()  # numbered by first observations
        assert mode.log_joint == pytest.approx(
            mixture.log_joint(mode.partition_of, mode.subgoal_of[first]), abs=1e-8
        )


def test_the_sampler_takes_any_finite_mdp() -> None:
    world = grid_world(MAP, QUICK)
    mdp = FiniteMDP.from_transitions(world.transitions(), world.discount)
    candidates, on_grid = paper_model(ROUND, MAP, QUICK)
    states, goals = world.states_of(ROUND.cells), world.states_of(candidates)
    mixture = subgoal_mixture(mdp, states, ROUND.action, goals, QUICK.alpha, QUICK.eta)
    np.testing.assert_allclose(mixture.log_likelihood, on_grid.log_likelihood, atol=1e-5)
    np.testing.assert_array_equal(mixture.pair_of, on_grid.pair_of)
    draws = run_chains(mixture, QUICK)
    np.testing.assert_array_equal(draws.subgoal_of, run_chains(on_grid, QUICK).subgoal_of)


def test_progress_counts_every_sweep_and_stopping_stops() -> None:
    done: list[int] = []
    infer(ROUND, MAP, QUICK, progress=done.append)
    assert sum(done) == QUICK.sweeps * QUICK.chains
    stop = Event()
    stop.set()
    with pytest.raises(StoppedError):
        infer(ROUND, MAP, QUICK, stop=stop)


def test_nothing_observed_is_nothing_to_infer() -> None:
    empty = walk((0, 0), (1, 0))
    empty = Demonstration(*(np.asarray(getattr(empty, name))[:0] for name in vars(empty)))
    with pytest.raises(InputError, match="no observation"):
        infer(empty, MAP, QUICK)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"alpha": 0.0}, "alpha must be above 0, not 0.0"),
        ({"alpha": float("nan")}, "alpha must be a finite number"),
        ({"eta": -1.0}, "eta must be above 0"),
        ({"success": 1.5}, "success must be above 0 and at most 1"),
        ({"discount": 1.0}, "discount must be at least 0 and below 1"),
        ({"moves": 5}, "moves must be one of 4, 8"),
        ({"candidates": "some"}, "candidates must be one of visited, free"),
        ({"sweeps": 100, "burn_in": 100}, "sweeps must leave a draw"),
        ({"thin": 0}, "thin must be at least 1"),
        ({"model": "best"}, "model must be one of paper"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"alpha": "5"}, "alpha must be of type float, not '5'"),
        ({"sweeps": 1000.5}, "sweeps must be of type int, not 1000.5"),
        ({"chains": True}, "chains must be of type int, not True"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(wrong: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Settings(**wrong)  # type: ignore[arg-type]


def visits_of(path: list[tuple[int, int]], pursued: list[int], last: bool) -> list[list[int]]:
    """Visits of one episode with subgoals at (2, 0) (rank 1) and (0, 0) (rank 2)."""
    count = len(pursued)
    demonstration = Demonstration(
        np.zeros(count, dtype=np.int64),
        np.array(path[:count]),
        np.zeros(count, dtype=np.int64),
        np.zeros(int(last), dtype=np.int64),
        np.array(path[count:]).reshape(-1, 2),
    )
    return episode_visits(demonstration, np.array([[2, 0], [0, 0]]), np.array(pursued))


def test_a_visit_is_an_arrival_at_what_was_pursued() -> None:
    there_and_back = [(0, 0), (1, 0), (2, 0), (1, 0), (0, 0)]
    # the start is no visit; the last pose is one
    assert visits_of(there_and_back, [1, 1, 2, 2], last=True) == [[1, 2]]
    # passing by without pursuit is none
    assert visits_of([(1, 0), (2, 0), (1, 0), (0, 0)], [2, 2, 2], last=True) == [[2]]
    # staying is one visit
    assert visits_of([(1, 0), (2, 0), (2, 0), (2, 0)], [1, 1, 1, 1], last=False) == [[1]]
    # pursued to the end without arrival: where its last observation was
    assert visits_of([(0, 0), (1, 0), (2, 0), (1, 0)], [1, 1, 2, 2], last=False) == [[1, 2]]
