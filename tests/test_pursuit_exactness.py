"""The sequential model's sampler draws from the right posterior.

Enumeration of every history, the paper's model as the limit, a Geweke test, and simulation-based
calibration. Statistical tests have fixed seeds. Their false-alarm rates, had the seeds been drawn
anew, are stated beside the bounds.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from numba import njit
from scipy.stats import chi2

from bnirl_ros.inference import pursuit_gibbs
from bnirl_ros.inference.diagnostics import effective_sample_size
from bnirl_ros.inference.draws import Draws
from bnirl_ros.inference.runs import run_counts, runs
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.mixture import SubgoalMixture, subgoal_mixture
from bnirl_ros.model.pursuits import ALPHA, PRIORS, PursuitModel, pursuit_model
from pursuit_reference import (
    PursuitEnumeration,
    Story,
    actions_drawn,
    parameters_drawn,
    story_drawn,
)
from reference import set_partitions
from test_exactness import CASES as PAPER_CASES
from test_exactness import total_variations as mixture_variations

CORRIDOR = np.ones((1, 6), dtype=bool)
ROOMS = np.array([[1, 1, 1, 0, 1], [1, 0, 1, 1, 1], [1, 1, 1, 0, 1]], dtype=bool)
APART = np.array([[1, 1, 1, 0, 1, 1]], dtype=bool)


class Case(NamedTuple):
    """A small world with N observations in two episodes.

    Attributes:
        goals: states of the candidates.
        count: observations N; the second episode begins at N // 2.
        radius: arrival radius in cells.
        parameters: in the order of `PRIORS`.
    """

    free: npt.NDArray[np.bool_]
    moves: int
    goals: tuple[int, ...]
    count: int
    radius: float
    likelihood: str
    parameters: tuple[float, ...]


CASES = {
    # ......................................alpha, eta, slip, rho on arrival, at subgoal, elsewhere
    "corridor": Case(CORRIDOR, 4, (0, 2, 5), 6, 0.0, "delay", (0.7, 1.0, 0.2, 0.8, 0.5, 0.1)),
    "arrives early": Case(CORRIDOR, 4, (0, 3, 5), 6, 1.0, "delay", (0.4, 0.3, 0.1, 0.7, 0.2, 0.3)),
    "rooms": Case(ROOMS, 8, (0, 4, 7, 12), 5, 0.0, "delay", (1.0, 4.0, 0.3, 0.9, 0.6, 0.2)),
    "two parts": Case(APART, 4, (0, 2, 4, 5), 6, 0.0, "delay", (0.5, 0.7, 0.15, 0.6, 0.4, 0.2)),
    "by value": Case(ROOMS, 4, (2, 5, 14), 6, 0.0, "value", (2.0, 0.5, 0.05, 1.0, 0.9, 0.05)),
    "no slips": Case(CORRIDOR, 4, (0, 2, 5), 6, 0.0, "delay", (2.0, 1.0, 0.0, 1.0, 0.3, 0.1)),
    "never gives up": Case(ROOMS, 8, (0, 4, 12), 6, 1.5, "delay", (1.0, 2.0, 0.2, 0.9, 0.5, 0.0)),
}  # fmt: skip


def small_model(case: Case, seed: int) -> PursuitModel:
    """Random observations, in two episodes that each stay in one connected part."""
    generator = np.random.default_rng(seed)
    world = GridWorld(case.free, case.moves)
    states = np.flatnonzero(case.free)
    parts = world.parts_of(states)
    starts = np.arange(case.count) % (case.count // 2 + case.count % 2) == 0
    part_of = np.unique(parts)[np.cumsum(starts) % len(np.unique(parts))]
    at = np.array([generator.choice(states[parts == part]) for part in part_of])
    visited = np.unique(at)
    apart = world.cells_of(visited)[:, None] - world.cells_of(case.goals)
    return pursuit_model(
        world,
        at,
        generator.choice(world.actions, size=case.count),
        starts,
        case.goals,
        arrived=np.linalg.norm(apart, axis=2) <= case.radius,
        likelihood=case.likelihood,
        fixed=dict(zip(PRIORS, case.parameters, strict=True)),
    )


def drawn(model: PursuitModel, draws: int, seed: int, thin: int = 1) -> Draws:
    generator = np.random.default_rng(seed)
    state = pursuit_gibbs.initial_state(model, generator)
    kept = pursuit_gibbs.room_for(model, (draws,))
    pursuit_gibbs.advance(model, state, generator, kept[:1], thin=500)
    pursuit_gibbs.advance(model, state, generator, kept, thin)
    return kept


def distribution(values: npt.NDArray[np.int64], length: int) -> npt.NDArray[np.float64]:
    return np.bincount(values, minlength=length) / len(values)


def total_variations(
    model: PursuitModel, exact: PursuitEnumeration, draws: Draws
) -> dict[str, float]:
    """Distances of the draws from the exact posterior, each the largest of its kind."""
    count, candidates = len(model.state_of), len(model.candidate_part)
    by_subgoal = run_counts(draws.subgoal_of, model.starts, candidates)
    told = draws.partition_of >= 0
    together = draws.partition_of[:, :, None] == draws.partition_of[:, None, :]
    together &= told[:, :, None]
    subgoal_of = np.array(
        [
            distribution(np.where(told[:, t], draws.subgoal_of[:, t], candidates), candidates + 1)
            for t in range(count)
        ]
    )
    runs = distribution(by_subgoal.sum(axis=1), count + 1)
    partitions = distribution(draws.partition_count, count + 1)
    return {
        "subgoal of an observation": 0.5 * np.abs(subgoal_of - exact.subgoal_of).sum(axis=1).max(),
        "number of pursuits": 0.5 * np.abs(runs - exact.run_count).sum(),
        # two-valued: total variation is the difference of the probabilities
        "subgoal": np.abs((by_subgoal > 0).mean(axis=0) - exact.subgoal_probability).max(),
        "co-assignment": np.abs(together.mean(axis=0) - exact.co_assignment).max(),
        "number of partitions": 0.5 * np.abs(partitions - exact.partition_count).sum(),
    }


@pytest.mark.parametrize("name", CASES)
def test_draws_agree_with_every_history(name: str) -> None:
    # 40,000 draws, at worst (measured) some 14,000 independent ones: a probability is known to a
    # standard deviation of 0.0042, so that 0.02 is passed by chance less than once in 10^5.
    model = small_model(CASES[name], seed=1)
    exact = PursuitEnumeration(model, np.array(CASES[name].parameters))
    distances = total_variations(model, exact, drawn(model, 40_000, seed=2))
    assert max(distances.values()) <= 0.02, distances


def path_draws(
    kernel: Callable[..., None], model: PursuitModel, draws: int, seed: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """(draw, N) subgoals and switches, the parameters held, by one step of the sampler alone."""
    generator = np.random.default_rng(seed)
    state = pursuit_gibbs.initial_state(model, generator)
    arguments = pursuit_gibbs.kernel_model(model)
    chosen = pursuit_gibbs.softmax_table(arguments, state.parameters[ALPHA])
    forward = np.empty((len(model.state_of), len(model.prior)))
    subgoal_of = np.empty((draws, len(model.state_of)), dtype=np.int32)
    switched = np.empty(subgoal_of.shape, dtype=np.bool_)
    kernel(arguments, state, chosen, forward, generator, subgoal_of, switched)
    return subgoal_of, switched


@njit(nogil=True)
def short_blocks(model, state, chosen, forward, generator, subgoal_of, switched):  # type: ignore[no-untyped-def]
    """Step 1 alone, in blocks of one or two observations; every fourth sweep is kept."""
    count = subgoal_of.shape[1]
    for draw in range(subgoal_of.shape[0]):
        for _ in range(4):
            first = np.int64(0)  # a literal would have all compiled once more
            while first < count:
                end = first + 1
                if end < count and not model.starts[end] and generator.random() < 0.5:
                    end += 1
                pursuit_gibbs._draw_block(model, state, chosen, forward, first, end, generator)
                first = end
        subgoal_of[draw] = state.subgoal_of
        switched[draw] = state.switched


@pytest.mark.parametrize("name", ["corridor", "arrives early", "rooms", "two parts"])
def test_blocks_that_end_within_an_episode_agree_with_every_history(name: str) -> None:
    # The sampler's own blocks rarely end within so short episodes; these do everywhere. No slips
    # are drawn here, so the subgoals are those that are pursued through slips too. 100,000 draws,
    # at worst (measured) some 11,000 independent ones: a standard deviation of 0.005; one of all
    # these probabilities is off by 0.025 by chance less than once in 10^4.
    model = small_model(CASES[name], seed=1)
    exact = PursuitEnumeration(model, np.array(CASES[name].parameters))
    subgoal_of, switched = path_draws(short_blocks, model, 100_000, 3)
    for t in range(len(model.state_of)):
        shares = distribution(subgoal_of[:, t], len(model.prior))
        assert 0.5 * np.abs(shares - exact.pursued[t]).sum() <= 0.025
    assert np.abs(switched.mean(axis=0) - exact.switched).max() <= 0.025


HELD = (2.0, 0.3, 0.05, 0.7, 0.3, 0.1)
NEIGHBOURS = {
    "in a row": Case(CORRIDOR, 4, (0, 1, 2, 3), 6, 0.0, "delay", HELD),
    "in a square": Case(np.ones((2, 3), dtype=bool), 8, (0, 1, 3, 4), 6, 1.0, "delay", HELD),
    "in two parts": Case(APART, 4, (0, 1, 4, 5), 6, 0.0, "delay", HELD),
}


@njit(nogil=True)
def relocations(model, state, chosen, forward, generator, subgoal_of, switched):  # type: ignore[no-untyped-def]
    """Step 2 alone, but for a sweep of blocks before every 25 of it; all 25 are kept."""
    for draw in range(subgoal_of.shape[0]):
        if draw % 25 == 0:
            pursuit_gibbs._draw_blocks(model, state, chosen, forward, generator)
        pursuit_gibbs._relocate(model, state, chosen, generator)
        subgoal_of[draw] = state.subgoal_of
        switched[draw] = state.switched


@pytest.mark.parametrize("name", NEIGHBOURS)
def test_relocations_among_neighbours_agree_with_every_history(name: str) -> None:
    # 500,000 draws, at worst (measured) some 30,000 independent ones: a standard deviation of
    # 0.0029; one of all these probabilities is off by 0.012 by chance less than once in 1,000.
    # Power: by the square root of the evidence they are off by 0.12 to 0.15, and without arrivals
    # in it by 0.023.
    model = small_model(NEIGHBOURS[name], seed=2)
    exact = PursuitEnumeration(model, np.array(NEIGHBOURS[name].parameters))
    subgoal_of, switched = path_draws(relocations, model, 500_000, 6)
    for t in range(len(model.state_of)):
        shares = distribution(subgoal_of[:, t], len(model.prior))
        assert 0.5 * np.abs(shares - exact.pursued[t]).sum() <= 0.012
    assert np.abs(switched.mean(axis=0) - exact.switched).max() <= 0.012


# The paper's model as the limit: a switch before every observation, no slips, and (7).


@pytest.mark.parametrize("case", PAPER_CASES, ids=[case[0] for case in PAPER_CASES])
def test_with_a_switch_everywhere_it_is_the_papers_model(case: tuple) -> None:  # type: ignore[type-arg]
    # 150,000 draws, at worst (measured, "open, few subgoals") some 7,000 independent ones: a
    # standard deviation of 0.006; one of all these probabilities is off by 0.025 by chance less
    # than once in 1,000.
    mixture, model = both_models(case)
    distances = mixture_variations(mixture, drawn(model, 150_000, seed=4))
    assert max(distances.values()) <= 0.025, distances


@pytest.mark.parametrize("case", PAPER_CASES, ids=[case[0] for case in PAPER_CASES])
def test_there_the_joint_is_the_mixtures_summed_over_partitions(case: tuple) -> None:  # type: ignore[type-arg]
    mixture, model = both_models(case)
    parameters = np.array([model.fixed[name] for name in PRIORS])
    generator = np.random.default_rng(5)
    count, candidates = len(model.state_of), len(model.prior)
    partitions = [np.array(labels) for labels in set_partitions(count)]
    for spread in (1, 2, candidates, candidates, candidates):
        subgoals = generator.choice(generator.choice(candidates, size=spread), size=count)
        terms = []
        for labels in partitions:
            _, first = np.unique(labels, return_index=True)
            if (subgoals[first][labels] == subgoals).all():  # one subgoal in each partition
                terms.append(mixture.log_joint(labels, subgoals[first]))
        joint = model.log_joint(subgoals, np.ones(count, dtype=bool), parameters)
        assert joint == pytest.approx(np.logaddexp.reduce(terms), abs=1e-6)


def both_models(case: tuple) -> tuple[SubgoalMixture, PursuitModel]:  # type: ignore[type-arg]
    """The same random observations as the paper's model and as the sequential one."""
    _, free, moves, alpha, eta, count = case
    generator = np.random.default_rng(1)
    world = GridWorld(free, moves)
    goals = np.flatnonzero(free)
    states = generator.choice(goals, size=count)
    actions = generator.choice(world.actions, size=count)
    model = pursuit_model(
        world,
        states,
        actions,
        np.arange(count) == 0,
        goals,
        likelihood="value",
        fixed=dict(zip(PRIORS, (alpha, eta, 0.0, 1.0, 1.0, 1.0), strict=True)),
    )
    return subgoal_mixture(world, states, actions, goals, alpha, eta), model


# Geweke (2004): if the sampler leaves the posterior as it is, then sweeps that alternate with
# drawing the actions anew leave the joint prior as it is. States and candidates stay fixed.


def wanderings(
    free: npt.NDArray[np.bool_], moves: int, lengths: tuple[int, ...], seed: int
) -> PursuitModel:
    """A model of episodes of these lengths that wander, all free cells candidates; all inferred.

    The actions are placeholders for those that tests draw.
    """
    generator = np.random.default_rng(seed)
    world = GridWorld(free, moves)
    goals, outcomes = np.flatnonzero(free), world.outcomes()
    states = []
    for length in lengths:
        state = generator.choice(goals)
        for _ in range(length):
            states.append(state)
            state = generator.choice(outcomes[state])
    starts = np.isin(np.arange(len(states)), np.cumsum((0, *lengths)))
    return pursuit_model(world, states, np.zeros(len(states)), starts, goals)


class Told(NamedTuple):
    """Everything that is drawn: parameters, the story of the subgoals, and the actions."""

    parameters: npt.NDArray[np.float64]
    story: Story
    model: PursuitModel


def told_by_prior(model: PursuitModel, generator: np.random.Generator) -> Told:
    parameters = parameters_drawn(model, generator)
    story = story_drawn(model, parameters, generator)
    actions = actions_drawn(model, parameters, story.subgoal_of, story.slipped, generator)
    return Told(parameters, story, replace(model, action_of=actions))


MEAN_LOG = np.log(3.0)  # of alpha and of eta, by their priors


def functionals(told: Told) -> dict[str, float]:
    """Scalars of (parameters, story, actions) whose mean under the joint is compared."""
    alpha, eta, slip, on_arrival, at_subgoal, elsewhere = told.parameters
    subgoal_of, switched, partition_of, slipped = told.story
    explained = np.where(slipped, -1, subgoal_of)
    subgoals, partitions = np.unique(subgoal_of).size, np.unique(partition_of).size
    return {
        "log alpha": np.log(alpha),
        "spread of alpha": (np.log(alpha) - MEAN_LOG) ** 2,
        "log eta": np.log(eta),
        "spread of eta": (np.log(eta) - MEAN_LOG) ** 2,
        "slip": slip,
        "switch on arrival": on_arrival,
        "switch at subgoal": at_subgoal,
        "switch elsewhere": elsewhere,
        "pursuits": len(runs(explained, told.model.starts)[0]),
        "switches": switched.sum(),
        "slips": slipped.sum(),
        "subgoals": subgoals,
        "partitions": partitions,
        "partitions by eta": (partitions - subgoals) * (np.log(eta) - MEAN_LOG),
        "subgoals by eta": subgoals * (np.log(eta) - MEAN_LOG),
        "slips by alpha": slipped.sum() * (np.log(alpha) - MEAN_LOG),
        "switches by rho": switched.sum() * elsewhere,
        "first subgoal": subgoal_of[0] == len(told.model.prior) - 1,
        "a subgoal": (explained == 1).any(),
        "first and last together": partition_of[0] == partition_of[-1],
        "stays": (told.model.action_of == 0).sum(),
        "log joint": told.model.log_joint(subgoal_of, switched, told.parameters),
    }


GEWEKE_CASES = {
    "open": (np.ones((3, 3), dtype=bool), 8, (11, 3), 9),
    "two parts": (np.array([[1, 1, 1, 0, 1, 1]], dtype=bool), 4, (6, 4, 5), 3),
}


@pytest.mark.parametrize("name", GEWEKE_CASES)
def test_geweke_joint_distribution(name: str) -> None:
    # Twenty-two functionals, two cases, |z| <= 4.5: a false alarm once in 3,000 runs. Effective
    # sizes: from some 250 (a single subgoal) to nearly all rounds (partitions by eta). Power: with
    # partitions drawn before the eta of the same sweep, "partitions by eta" is off by 9 and 10.
    rounds = 5_000
    model = wanderings(*GEWEKE_CASES[name])
    generator = np.random.default_rng(12)
    independent = [
        list(functionals(told_by_prior(model, generator)).values()) for _ in range(rounds)
    ]
    told = told_by_prior(model, generator)
    state = pursuit_gibbs.initial_state(told.model, generator)
    last = pursuit_gibbs.room_for(model, (1,))
    successive = []
    for _ in range(rounds):
        # Alpha is drawn in every fourth sweep.
        pursuit_gibbs.advance(told.model, state, generator, last, thin=4)
        story = Story(
            state.subgoal_of.astype(np.int64),
            state.switched.copy(),
            state.partition_of.astype(np.int64),
            state.slipped.copy(),
        )
        actions = actions_drawn(
            model, state.parameters, state.subgoal_of, state.slipped, generator
        )
        told = Told(state.parameters.copy(), story, replace(model, action_of=actions))
        successive.append(list(functionals(told).values()))
    values, chain = np.array(independent, dtype=float), np.array(successive, dtype=float)
    sizes = [effective_sample_size(chain[None, :, index]) for index in range(chain.shape[1])]
    errors = np.sqrt(values.var(axis=0) / rounds + chain.var(axis=0) / np.array(sizes))
    scores = dict(
        zip(functionals(told), (chain.mean(axis=0) - values.mean(axis=0)) / errors, strict=True)
    )
    assert max(map(abs, scores.values())) <= 4.5, scores


# Simulation-based calibration (Talts et al. 2018): where the truth is drawn from the prior, its
# rank among draws from the posterior is uniform.


def scalars(told: Told) -> dict[str, float]:
    """What is ranked: all that a user reads."""
    explained = np.where(told.story.slipped, -1, told.story.subgoal_of)
    return {
        **dict(zip(PRIORS, told.parameters, strict=True)),
        "pursuits": len(runs(explained, told.model.starts)[0]),
        "subgoals": np.unique(explained[explained >= 0]).size,
        "log joint": told.model.log_joint(
            told.story.subgoal_of, told.story.switched, told.parameters
        ),
        "share of slips": told.story.slipped.mean(),
    }


def scalars_of(draws: Draws, model: PursuitModel) -> npt.NDArray[np.float64]:
    """(draw, 10) the same of draws, in the same order."""
    pursuits = run_counts(draws.subgoal_of, model.starts, len(model.prior))
    return np.column_stack(
        [
            draws.parameters,
            pursuits.sum(axis=1),
            (pursuits > 0).sum(axis=1),
            draws.log_joint,
            (draws.subgoal_of < 0).mean(axis=1),
        ]
    )


CALIBRATION_RUNS = 500
RANKED = 9  # draws, and so ten ranks
APART_BY = (
    40  # sweeps; alpha, the slowest, has an autocorrelation time of 13, nine times in ten 35
)


def calibration_ranks(count: int, seed: int) -> npt.NDArray[np.int64]:
    """(run, 10) rank of each scalar of the truth among the draws, ties in random order."""
    world = wanderings(np.ones((3, 4), dtype=bool), 8, (18, 12), 2)

    def ranks(run: int) -> npt.NDArray[np.int64]:
        generator = np.random.default_rng([seed, run])
        told = told_by_prior(world, generator)
        state = pursuit_gibbs.initial_state(told.model, generator)
        draws = pursuit_gibbs.room_for(told.model, (RANKED,))
        pursuit_gibbs.advance(told.model, state, generator, draws[:1], thin=5 * APART_BY)
        pursuit_gibbs.advance(told.model, state, generator, draws, thin=APART_BY)
        truth, values = np.array(list(scalars(told).values())), scalars_of(draws, told.model)
        below, ties = (values < truth).sum(axis=0), (values == truth).sum(axis=0)
        return np.asarray(below + generator.integers(ties + 1))

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        return np.array(list(threads.map(ranks, range(count))))


def test_the_whole_model_is_calibrated() -> None:
    # 500 demonstrations of 30 observations; ten histograms of ten ranks, each rejected by
    # chi-square at 10^-4: a false alarm once in 1,000 runs. Power: that eta's density lacks the
    # urns' normalisation, or that of the slip the Jacobian of its logit, shows at 10^-50 and less;
    # what a step of one block does wrong shows in the tests above, and not here.
    ranks = calibration_ranks(CALIBRATION_RUNS, seed=22)
    expected = CALIBRATION_RUNS / (RANKED + 1)
    names = (*PRIORS, "pursuits", "subgoals", "log joint", "share of slips")
    improbable = {}
    for name, column in zip(names, ranks.T, strict=True):
        histogram = np.bincount(column, minlength=RANKED + 1)
        improbable[name] = chi2.sf(((histogram - expected) ** 2 / expected).sum(), RANKED)
    assert min(improbable.values()) >= 1e-4, improbable
