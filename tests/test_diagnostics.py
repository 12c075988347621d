"""R-hat and effective sample size agree with ArviZ, and say nothing where nothing can be said."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base import array_stats

from bnirl_ros.inference.diagnostics import effective_sample_size, rhat


def chains_of(kind: str, chains: int, draws: int) -> np.ndarray:
    generator = np.random.default_rng(3)
    noise = generator.normal(size=(chains, draws))
    slow = np.zeros((chains, draws))
    for draw in range(1, draws):
        slow[:, draw] = 0.8 * slow[:, draw - 1] + noise[:, draw]
    return {
        "independent": noise,
        "slow": slow,
        "counts": np.round(slow),
        "apart": slow + np.arange(chains)[:, None],
        "heavy tails": noise / generator.random((chains, draws)),
    }[kind]


@pytest.mark.parametrize("kind", ["independent", "slow", "counts", "apart", "heavy tails"])
@pytest.mark.parametrize(("chains", "draws"), [(4, 800), (2, 101), (3, 2000)])
def test_agrees_with_arviz(kind: str, chains: int, draws: int) -> None:
    values = chains_of(kind, chains, draws)
    assert rhat(values) == pytest.approx(array_stats.rhat(values, chain_axis=0, draw_axis=1))
    assert effective_sample_size(values) == pytest.approx(
        array_stats.ess(values, chain_axis=0, draw_axis=1)
    )


def test_undefined_where_nothing_varies_or_there_is_one_chain() -> None:
    constant = np.ones((4, 100))
    assert rhat(constant) is None
    assert effective_sample_size(constant) is None
    assert rhat(chains_of("slow", 1, 100)) is None
    assert rhat(chains_of("slow", 4, 1)) is None
    only_in_the_middle = np.zeros((2, 9))
    only_in_the_middle[0, 4] = 1.0  # which split chains leave out
    assert rhat(only_in_the_middle) is None
    assert effective_sample_size(only_in_the_middle) is None
    assert rhat(chains_of("slow", 4, 7)) is None
    assert effective_sample_size(chains_of("slow", 4, 7)) is None


def test_chains_that_stand_still_apart_have_not_converged() -> None:
    assert rhat(np.repeat([[1.0], [2.0]], 50, axis=1)) == float("inf")
    assert rhat(np.repeat([[0.0], [1.0], [0.0], [1.0]], 800, axis=1)) == float("inf")
