"""The paper's experiments count as they say, and tell when something does not hold."""

from __future__ import annotations

import gc
import json
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bnirl_ros
from bnirl_ros import cli
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments import identifiability
from bnirl_ros.experiments.machine import cores, machine
from bnirl_ros.experiments.paper import sensitivity, table1
from bnirl_ros.experiments.paper.claims import Claim, claims_of, claims_of_times
from bnirl_ros.experiments.paper.courses import (
    ALGORITHMS,
    BNIRL,
    RIVAL_NAMES,
    Course,
    Found,
    Parameters,
    best_so_far,
    bnirl_course,
    mixture_of,
    rival_course,
    sample,
)
from bnirl_ros.experiments.paper.experiments import (
    SECTIONS,
    Experiment,
    Outcome,
    generator_of,
    run_job,
)
from bnirl_ros.experiments.paper.figures import assignments, draw_figure
from bnirl_ros.experiments.paper.page import Report, numbers, page, short
from bnirl_ros.experiments.paper.reproduce import PARTS, Plan
from bnirl_ros.experiments.paper.runs import run_all
from bnirl_ros.experiments.paper.table1 import Cost, Table1
from bnirl_ros.experiments.paper.trials import (
    Trial,
    candidate_subgoals,
    goal_values_of,
    reward_losses,
    trial_of,
    true_subgoals,
    unmatched,
)
from bnirl_ros.experiments.scenarios import (
    PAPER_FEATURES,
    PAPER_GRID,
    PAPER_LOOP,
    SPLITS,
    TIE,
    WEIGHTS,
    Scenario,
    distance_features,
    draw_reward,
    follow_reward,
    number_of,
    outcome_of,
    paper_cell,
)
from bnirl_ros.inference.settings import Settings
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.mdp.reward_values import action_values, optimal_values

ACTION = {name: index for index, name in enumerate(ACTION_NAMES)}

LINE = Scenario(
    name="line", section="none", grid=".......", start=(0, 0), subgoals=((4, 0),), episodes=1
)
"""Seven cells in a row."""


def trial_on_line(*pairs: tuple[int, str]) -> Trial:
    """Observations (x, action) on the line, in one episode that ends in its last cell."""
    cells = np.array([(x, 0) for x, _ in pairs])
    demonstration = Demonstration(
        episode=np.zeros(len(pairs), dtype=np.int64),
        cells=cells,
        action=np.array([ACTION[action] for _, action in pairs]),
        last_episode=np.array([0]),
        last_cells=np.array([[6, 0]]),
    )
    features = distance_features(LINE.grid_map, [(4, 0)])
    return Trial(LINE.world, LINE.process, demonstration, features, ((4, 0),))


# Scenarios


def test_sections_4_1_and_4_2_are_the_papers() -> None:
    for scenario in (PAPER_GRID, PAPER_FEATURES):
        world = scenario.world
        assert world.free.shape == (20, 20)
        assert not world.free.all()
        assert (world.success, world.discount, world.moves) == (0.7, 0.99, 8)
        assert scenario.grid_map.is_free(np.array([scenario.start])).all()
    assert [number_of(cell) for cell in PAPER_GRID.subgoals] == [(10, 12), (2, 17), (2, 2)]
    assert PAPER_GRID.grid_map.is_free(np.array(PAPER_GRID.subgoals)).all()
    assert number_of(PAPER_FEATURES.start) == (15, 1)
    assert (PAPER_FEATURES.episodes, PAPER_FEATURES.actions, PAPER_FEATURES.features) == (5, 15, 6)
    # Why 4.3 cannot share its walls.
    assert not PAPER_LOOP.grid_map.is_free(np.array([paper_cell(10, 12)])).any()


@pytest.mark.parametrize("weights", WEIGHTS)
def test_who_follows_a_reward_takes_optimal_actions(weights: str) -> None:
    scenario = replace(PAPER_FEATURES, weights=weights)
    reward = draw_reward(scenario, np.random.default_rng(3))
    assert reward.weights.shape == (6,)
    assert len({tuple(site) for site in reward.sites.tolist()}) == 6
    assert scenario.grid_map.is_free(reward.sites).all()
    if weights == "attracting":
        assert (reward.weights <= 0.0).all()
    elif weights == "uniform":
        assert (np.abs(reward.weights) <= 1.0).all()
    demonstration = follow_reward(scenario, reward, np.random.default_rng(3))
    assert np.bincount(demonstration.episode).tolist() == [15] * 5
    world = scenario.world
    cells = world.cells_of(np.arange(400))
    apart = np.abs(cells[:, None] - reward.sites).sum(axis=2)
    rewards = (apart @ reward.weights)[:, None]
    values = optimal_values(world, rewards, 1e-10)
    states = world.states_of(demonstration.cells)
    choices = action_values(world, rewards, values, states)[:, :, 0]
    assert not unmatched(choices, demonstration.action).any()
    starts = demonstration.cells[demonstration.starts]
    assert (starts == scenario.start).all()


def test_sites_may_be_given() -> None:
    sites = tuple(paper_cell(*site) for site in sensitivity.SITES)
    reward = draw_reward(replace(PAPER_FEATURES, sites=sites), np.random.default_rng(0))
    assert reward.sites.tolist() == [list(site) for site in sites]


@pytest.mark.parametrize("split", SPLITS)
def test_noise_is_split_alike_in_plans_and_in_motion(split: str) -> None:
    scenario = replace(LINE, grid="...\n...\n...", subgoals=((2, 2),), split=split)
    world, state = scenario.world, 4  # in the middle no action is blocked
    generator = np.random.default_rng(0)
    for choice in (ACTION["stay"], ACTION["E"], ACTION["SE"]):
        happened = [outcome_of(choice, world, generator, split) for _ in range(4000)]
        seen = np.bincount(world.outcomes()[state, happened], minlength=9) / 4000
        planned = scenario.process.transitions()[choice].toarray()[state]
        np.testing.assert_allclose(planned.sum(), 1.0)
        np.testing.assert_allclose(seen, planned, atol=0.03)
    east = scenario.process.transitions()[ACTION["E"]].toarray()[state]
    expected = {"evenly": [0.3 / 8] * 9, "stays": [0.0] * 9, "beside": [0.0] * 9}[split]
    expected[5] = 0.7
    if split == "stays":
        expected[4] = 0.3
    if split == "beside":
        expected[8] = expected[2] = 0.15
    np.testing.assert_allclose(east, expected, atol=1e-12)


def test_other_splits_are_refused() -> None:
    with pytest.raises(ValueError, match="split must be one of evenly, stays, beside"):
        _ = replace(LINE, split="sometimes").process


# The 0-1 loss


def test_an_action_is_lost_unless_it_ties_with_the_best() -> None:
    values = np.array(
        [
            [1.0, 1.0 - 0.5 * TIE, 0.0],  # within the tie
            [1.0, 1.0 - 2.0 * TIE, 0.0],  # beyond it
            [5.0, 5.0, 5.0],
            [0.0, 7.0, 0.0],
        ]
    )
    assert unmatched(values, np.array([1, 1, 2, 1])).tolist() == [False, True, False, False]
    assert unmatched(values, np.array([0, 0, 0, 0])).tolist() == [False, False, False, True]
    both = np.stack([values, -values], axis=2)
    assert unmatched(both, np.array([0, 0, 0, 0])).tolist() == [
        [False, True],
        [False, True],
        [False, False],
        [True, False],
    ]


def test_losses_under_a_reward_by_hand() -> None:
    trial = trial_on_line((0, "E"), (2, "W"), (4, "stay"), (4, "N"), (6, "E"), (6, "W"))
    reward = np.zeros(7)
    reward[4] = 1.0
    # A blocked move stays, so that it ties with staying: at (4, 0) for N, at (6, 0) it is wrong.
    expected = [False, True, False, False, True, False]
    for scale in (1.0, 1e-12, 1e6):  # units of the reward do not matter
        assert reward_losses(trial, scale * reward, np.zeros((7, 9))).tolist() == expected
    # Where two goals are as good, both ways are.
    reward[:] = 0.0
    reward[[0, 6]] = 1.0
    middle = trial_on_line((3, "E"), (3, "W"), (3, "stay"))
    assert reward_losses(middle, reward, np.zeros((7, 9))).tolist() == [False, False, True]
    # A constant reward is for any action.
    assert not reward_losses(trial, np.ones(7), np.zeros((7, 9))).any()


def test_the_loss_of_the_sampler_is_that_of_each_observations_own_subgoal() -> None:
    trial = trial_on_line((0, "E"), (1, "E"), (2, "E"), (5, "W"), (6, "W"))
    course = bnirl_course(trial, "State", 30, np.random.default_rng(0), Parameters())
    candidates = candidate_subgoals(trial, "State")
    mixture = mixture_of(trial, candidates, Parameters())
    samples = sample(mixture, 30, np.random.default_rng(0))
    lost = unmatched(goal_values_of(trial, candidates.goals), trial.positions)
    by_hand = [
        sum(lost[i, goal] for i, goal in enumerate(subgoals)) for subgoals in samples.subgoal_of
    ]
    found = course.found
    assert found is not None
    assert found.sample_loss.tolist() == by_hand
    best = [int(np.argmax(samples.log_joint[: t + 1])) for t in range(31)]
    assert course.loss.tolist() == [by_hand[number] for number in best]
    assert found.mode_joint >= found.best_joint == samples.log_joint.max()
    assert samples.log_joint[0] == pytest.approx(
        mixture.log_joint(samples.partition_of[0], [samples.subgoal_of[0, 0]])
    )
    assert found.least_loss == lost.min(axis=1).sum()


def test_the_best_sample_so_far_by_hand() -> None:
    assert best_so_far(np.array([3.0, 1.0, 4.0, 4.0, 2.0, 5.0])).tolist() == [0, 0, 2, 2, 2, 5]


def test_feature_subgoals_are_the_cells_as_far_from_all_sites() -> None:
    trial = trial_on_line((3, "E"), (5, "W"))
    candidates = candidate_subgoals(trial, "Feature")
    assert candidates.coordinates.tolist() == [[1], [2]]
    assert [candidates.goals[goal].tolist() for goal in range(2)] == [[3, 5], [2, 6]]
    assert true_subgoals(trial, "Feature") == {(0,)}
    assert true_subgoals(trial, "State") == {(4, 0)}


# Jobs


def _squared(number: int) -> int:
    if number < 0:
        raise ValueError("negative")
    return number * number


def test_jobs_give_the_same_whatever_the_number_of_processes() -> None:
    told: list[int] = []
    assert run_all(_squared, list(range(9)), 2, told.append) == [n * n for n in range(9)]
    assert sum(told) == 9
    assert run_all(_squared, list(range(9)), 1) == [n * n for n in range(9)]


@pytest.mark.parametrize("processes", [1, 2])
def test_a_job_that_fails_ends_all(processes: int) -> None:
    with pytest.raises(ValueError, match="negative"):
        run_all(_squared, [1, -1, 2], processes)
    deadline = time.monotonic() + 10
    while multiprocessing.active_children() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not multiprocessing.active_children()


def test_a_job_takes_all_chance_from_itself() -> None:
    experiment = Experiment(PAPER_GRID, ("BN-IRL State",), runs=2, iterations=5)
    first, second = experiment.jobs
    one, again, other = run_job(first), run_job(first), run_job(second)
    assert one.loss.tolist() == again.loss.tolist()
    assert one.loss.tolist() != other.loss.tolist()
    assert len({generator_of(0, name).random() for name in ALGORITHMS}) == len(ALGORITHMS)


def test_equal_jobs_of_two_experiments_are_run_once() -> None:
    experiment = Experiment(PAPER_FEATURES, ALGORITHMS, runs=1)
    other = replace(experiment, parameters=Parameters(alpha=1.0))
    shared = set(experiment.jobs) & set(other.jobs)
    assert {job.algorithm for job in shared} == set(RIVAL_NAMES)


@pytest.mark.parametrize("name", RIVAL_NAMES)
def test_a_rival_answers_from_its_first_iteration_on(name: str) -> None:
    pytest.importorskip("clarabel")
    trial = trial_of(PAPER_FEATURES, 1)
    course = rival_course(trial, name, 3, generator_of(1, name))
    assert course.observations == 75
    assert math.isnan(course.loss[0])
    assert ((course.loss[1:] >= 0) & (course.loss[1:] <= 75)).all()


# Claims


def course(loss: float, exact: bool = True, observations: int = 100, length: int = 31) -> Course:
    losses = np.full(length, loss)
    return Course(
        observations,
        losses,
        Found(
            sample_loss=losses.astype(np.int64),
            best_joint=-2.0,
            mode_joint=-1.0,
            mode_loss=int(loss),
            best_subgoals=((1, 1),),
            mode_subgoals=((1, 1),),
            best_exact=exact,
            mode_exact=exact,
            least_loss=0,
            unmatched_cost=0.5,
        ),
    )


def outcome(section: str, losses: dict[str, float], exact: int = 25) -> Outcome:
    experiment = replace(SECTIONS[section], iterations=30)
    return Outcome(
        experiment,
        {
            name: [course(losses.get(name, 0.0), run < exact) for run in range(25)]
            for name in experiment.algorithms
        },
    )


def holding(claims: list[Claim], words: str) -> list[bool]:
    return [claim.holds for claim in claims if words in claim.statement]


@pytest.mark.parametrize(("exact", "holds"), [(25, True), (24, True), (23, False)])
def test_modes_have_to_be_exact_in_24_of_25_runs(exact: int, holds: bool) -> None:
    for section, variants in (("4.1", 1), ("4.3", 2)):
        claims = claims_of(section, outcome(section, {}, exact))
        assert holding(claims, "posterior mode is exactly") == [holds] * variants
        (told, *_) = (claim.ours for claim in claims if "exactly" in claim.statement)
        assert told.startswith(f"{exact} of 25")


def test_comparable_is_within_one_action_of_the_best_rival() -> None:
    losses = {"Abbeel IRL": 5.0, "MaxMargin IRL": 3.0, "Bayesian IRL": 9.0}
    good = claims_of("4.2", outcome("4.2", losses | {"BN-IRL State": 4.0, "BN-IRL Feature": 4.1}))
    assert holding(good, "comes within 1 action") == [True, False]
    (bad,) = (claim for claim in good if "comes within" in claim.statement and not claim.holds)
    assert "MaxMargin IRL 3.0" in bad.ours
    assert "0.5 nats" in bad.why


def test_convergence_is_to_what_the_demonstrator_does() -> None:
    rivals = dict.fromkeys(RIVAL_NAMES, 50.0)  # stands still, and is no convergence
    claims = claims_of("4.3", outcome("4.3", rivals | {"BN-IRL Feature": 30.0}))
    assert holding(claims, "converges in 0-1 loss") == [True, False]
    assert holding(claims, "does not converge") == [True] * 3
    claims = claims_of("4.3", outcome("4.3", {"Abbeel IRL": 10.0, "MaxMargin IRL": 11.0}))
    assert holding(claims, "does not converge") == [False, True, False]
    assert all(claim.why for claim in claims if not claim.holds)


def test_a_constant_reward_is_told() -> None:
    found = outcome("4.3", dict.fromkeys(RIVAL_NAMES, 50.0))
    courses = dict(found.courses)
    courses["Bayesian IRL"] = [
        *(replace(course(0.0), constant=True) for _ in range(3)),
        *courses["Bayesian IRL"][3:],
    ]
    claims = claims_of("4.3", replace(found, courses=courses))
    told = [claim.ours for claim in claims if "constant" in claim.ours]
    assert len(told) == 1
    assert "in 3 of the runs" in told[0]


def times(sweep: float, rival: float, ended: float = 100.0) -> Table1:
    costs = {name: Cost(name, 0.01, sweep, 100 * sweep, 100.0) for name in BNIRL}
    costs |= {name: Cost(name, 0.02, rival, ended * rival, ended) for name in RIVAL_NAMES}
    return Table1(costs, 100, "a machine")


def test_times_are_compared_with_the_fastest_rival() -> None:
    assert holding(claims_of_times(times(1e-5, 1e-2)), "takes less than a 10th") == [True] * 2
    assert holding(claims_of_times(times(1e-5, 1e-2)), "take less than the fast") == [True] * 2
    assert holding(claims_of_times(times(1e-5, 9e-5)), "takes less than a 10th") == [False] * 2
    # A rival that ends at once needs little for its hundred iterations, too.
    ends = claims_of_times(times(1e-4, 1e-2, ended=1.0))
    assert holding(ends, "take less than the fastest") == [False] * 2
    (slow, *_) = claims_of_times(times(1e-5, 9e-5))
    assert "9 times less: 10 us and 90 us" in slow.ours
    assert slow.why


def report(exact: int) -> Report:
    found = outcome("4.1", {"BN-IRL State": 2.0}, exact)
    return Report(
        claims=[*claims_of("4.1", found), *claims_of_times(times(1e-5, 1e-2))],
        outcomes={"4.1": found},
        variations={},
        detours=(),
        table1=times(1e-5, 1e-2),
        parameters=Parameters(),
        machine="a machine",
        seconds=1.0,
    )


def test_what_does_not_hold_is_said_everywhere() -> None:
    bad, good = report(20), report(25)
    statement = "BN-IRL State: the posterior mode is exactly"
    (line,) = (line for line in short(bad.claims).splitlines() if statement in line)
    assert line.startswith("4.1      NO ")
    assert "why: " in short(bad.claims)
    (line,) = (line for line in page(bad).splitlines() if statement in line)
    assert "| 20 of 25 (best sample 20) | **no** | in the other runs" in line
    (line,) = (line for line in page(good).splitlines() if statement in line)
    assert line.endswith("| yes |  |")
    assert [claim["holds"] for claim in numbers(bad)["claims"]].count(False) == 2
    json.dumps(numbers(bad), allow_nan=False)


def test_table_1_has_the_papers_figures_beside_ours() -> None:
    table = times(1.23e-5, 1.2e-2)
    rows = {row[0]: row[1:] for row in table1.rows(table)}
    assert rows["BN-IRL State"] == ("0.01", "1.2e-05", "0.011", "15.3", "0.21")
    assert rows["BN-IRL Feature"][-2:] == ("", "")
    assert rows["Bayesian IRL"][-2:] == ("0.56", "3.27")
    assert set(rows) == set(ALGORITHMS)


def test_times_are_measured() -> None:
    pytest.importorskip("clarabel")
    experiment = replace(SECTIONS["4.2"], runs=1, iterations=2)
    told: list[int] = []
    table = table1.measure(experiment, told.append)
    assert list(table.costs) == list(ALGORITHMS)
    assert sum(told) == len(ALGORITHMS)
    for cost in table.costs.values():
        assert 0 < cost.iteration <= cost.iterations
        assert cost.initialisation > 0
        assert 1 <= cost.new_answers <= 2


def test_the_machine_is_named() -> None:
    line = machine()
    assert f"{cores()} core" in line
    assert f"Python {sys.version_info.major}.{sys.version_info.minor}." in line
    assert f"numpy {np.__version__}" in line


# Identifiability


def test_detours_by_hand() -> None:
    # Without noise, lengths are numbers of steps.
    on_the_way = replace(LINE, start=(0, 0), subgoals=((3, 0), (6, 0)), success=1.0)
    np.testing.assert_allclose(identifiability.detours(on_the_way), [0.0, 6.0], atol=1e-6)
    turning = replace(LINE, start=(2, 0), subgoals=((0, 0), (6, 0)), success=1.0)
    np.testing.assert_allclose(identifiability.detours(turning), [4.0, 12.0], atol=1e-6)


def test_starts_are_counted_by_their_detour() -> None:
    scenario = replace(LINE, subgoals=((3, 0), (6, 0)), success=1.0)
    settings = Settings(model="paper", chains=1, sweeps=5, burn_in=0)
    chosen = identifiability.starts(scenario, 3, settings)
    assert [start.scenario.start for start in chosen] == [(0, 0), (2, 0), (4, 0), (6, 0)]
    bins = identifiability.by_detour(chosen, [1, 0, 2, 3])
    # From 4 it is a way of 1 + 3 steps to 6 over 3, 2 more; from 6 of 3 + 3, 6 more.
    counted = {bin_.low: (bin_.starts, bin_.demonstrations, bin_.exact) for bin_ in bins}
    assert counted[0.0] == (2, 6, 1)
    assert counted[2.0] == (1, 3, 2)
    assert counted[4.0] == (1, 3, 3)
    assert counted[8.0] == (0, 0, 0)


def test_a_subgoal_on_the_way_is_not_found_and_a_turn_is() -> None:
    settings = Settings(model="paper", chains=1, sweeps=100, burn_in=0)
    exact = {}
    for start in (paper_cell(2, 2), paper_cell(20, 12)):
        scenario = replace(PAPER_GRID, start=start)
        exact[identifiability.detours(scenario)[0] > 1.0] = identifiability.exact_modes(
            identifiability.Start(scenario, 5, settings)
        )
    assert exact[True] == 5
    assert exact[False] <= 1


# Other choices


def test_walls_are_where_their_corners_say() -> None:
    assert sensitivity.grid_of(((1, 1, 2, 1), (3, 2, 3, 3)), 3) == "..#\n..#\n##."
    ours = sensitivity.grid_of(sensitivity.WALLS["4.3"]["those of 4.1"])
    assert ours == PAPER_GRID.grid.strip()


@pytest.mark.parametrize("section", SECTIONS)
def test_every_choice_is_made_in_our_way_and_in_others(section: str) -> None:
    experiment = SECTIONS[section]
    variations = sensitivity.variations(section, experiment)
    ours = [variation for variation in variations if variation.ours]
    choices = [variation.choice for variation in ours]
    assert sorted(choices) == sorted({variation.choice for variation in variations})
    for variation in variations:
        same = (
            variation.experiment.scenario == experiment.scenario
            and variation.experiment.parameters == experiment.parameters
        )
        assert same == variation.ours
        scenario = variation.experiment.scenario
        cells = [scenario.start, *getattr(scenario, "subgoals", ())]
        assert scenario.grid_map.is_free(np.array(cells)).all()
    run = set(experiment.jobs)
    for variation in ours:
        assert set(variation.experiment.jobs) <= run


# Figures


def test_true_subgoals_have_the_same_rank_in_every_panel() -> None:
    experiment = replace(SECTIONS["4.1"], iterations=30)
    for assigned in assignments(experiment, 0):
        known = [cell for cell in assigned.subgoals if cell in PAPER_GRID.subgoals]
        assert list(assigned.subgoals[: len(known)]) == known
        assert known == [cell for cell in PAPER_GRID.subgoals if cell in known]
        assert set(assigned.rank_of.tolist()) == set(range(1, len(assigned.subgoals) + 1))


def test_a_figure_is_the_same_file_each_time(tmp_path: Path) -> None:
    found = outcome("4.3", dict.fromkeys(RIVAL_NAMES, 50.0))
    written = []
    for folder in (tmp_path / "one", tmp_path / "two"):
        folder.mkdir()
        written.append([file.read_bytes() for file in draw_figure("4.3", found, folder)])
    assert written[0] == written[1]
    vectors, pixels = written[0]
    assert vectors.startswith(b"%PDF")
    assert pixels.startswith(b"\x89PNG")


# The command

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def bnirl(capsys: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """The command in this process: its status, and what it said."""

    def call(*arguments: str | Path) -> tuple[int, str, str]:
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse
            status = int(end.code or 0)
        return status, *capsys.readouterr()

    yield call
    gc.unfreeze()
    gc.enable()


def test_the_command_offers_what_there_is() -> None:
    assert (*PARTS, "all") == cli.reproduce.REPRODUCIBLE
    plan = Plan()
    options = cli.parser().parse_args(["reproduce"])
    assert (options.part, options.runs, options.iterations) == ("all", plan.runs, plan.iterations)
    assert Parameters(options.alpha, options.eta) == plan.parameters


def test_a_section_is_reproduced(bnirl: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    few = ("--runs", "1", "--iterations", "20", "--jobs", "1")
    status, told, err = bnirl("reproduce", "4.1", "--out", out, *few)
    assert (status, err) == (0, "")
    assert "1 of 1 (best sample " in told
    assert sorted(file.name for file in out.iterdir()) == [
        "figure_3.pdf",
        "figure_3.png",
        "reproduction.json",
        "reproduction.md",
    ]
    document = json.loads((out / "reproduction.json").read_text())
    ((course_,),) = document["sections"]["4.1"].values()
    assert len(course_["loss"]) == 21
    text = (out / "reproduction.md").read_text()
    for heading in ("What the paper says", "does not print", "other choices", "on the way to"):
        assert heading in text
    assert "(figure_3.png)" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["5.1"], "invalid choice: '5.1'"),
        (["--runs", "0"], "must be at least 1, not 0"),
        (["--iterations", "-3"], "must be at least 1, not -3"),
        (["--jobs", "none"], "invalid"),
        (["--alpha", "0"], "must be above 0, not 0"),
        (["--eta", "inf"], "must be above 0, not inf"),
        (["4.1", "4.2"], "unrecognized arguments: 4.2"),
    ],
)
def test_wrong_arguments_end_with_status_2(
    bnirl: Command, arguments: list[str], words: str
) -> None:
    status, told, err = bnirl("reproduce", *arguments)
    assert (status, told) == (2, "")
    assert words in err.splitlines()[-1]
    assert err.splitlines()[-1].startswith(("bnirl reproduce: error: ", "bnirl: error: "))


def test_a_folder_that_cannot_be_made_is_told_before_anything_runs(
    bnirl: Command, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    status, told, err = bnirl("reproduce", "4.1", "--out", tmp_path / "file" / "out")
    assert (status, told) == (1, "")
    assert len(err.splitlines()) == 1
    assert "cannot be written" in err


@pytest.mark.parametrize("part", ["4.2", "4.3", "table1", "all"])
def test_a_missing_solver_is_told_before_anything_runs(
    bnirl: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    monkeypatch.setitem(sys.modules, "clarabel", None)
    status, told, err = bnirl("reproduce", part, "--out", tmp_path)
    assert (status, told) == (1, "")
    assert len(err.splitlines()) == 1
    assert "bnirl_ros[paper]" in err


def alive_in_group(group: int) -> list[str]:
    """Processes of a group that still run; those that nobody has waited for do not."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of_group = file.read_text().rpartition(")")[2].split()[:3]
        except OSError:  # gone meanwhile
            continue
        if int(of_group) == group and state not in "ZX":
            found.append(file.parent.name)
    return found


def test_ctrl_c_leaves_one_line_and_no_process(tmp_path: Path) -> None:
    # A shell's `&` would have told us, and by us the command, to ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "bnirl_ros.cli", "reproduce", "4.1", "--jobs", "2"),
            *("--iterations", "100000", "--out", str(tmp_path / "out")),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(bnirl_ros.__file__).parents[1])},
        start_new_session=True,  # a terminal's Ctrl-C goes to the whole group
    )
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=4)
        os.killpg(process.pid, signal.SIGINT)
        told, err = process.communicate(timeout=60)
        assert (process.returncode, told, err) == (130, "", "bnirl: stopped\n")
        deadline = time.monotonic() + 10
        while alive_in_group(process.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not alive_in_group(process.pid)
    finally:
        process.kill()
