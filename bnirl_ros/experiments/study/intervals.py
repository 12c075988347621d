"""How far a measured share may be from the true one."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

_RESAMPLES = 2000

Interval = tuple[float, float]


def normal_quantile(level: float) -> float:
    """Half the width of the central interval of this probability, in standard deviations."""
    return NormalDist().inv_cdf((1.0 + level) / 2.0)


def wilson(successes: int, trials: int, level: float = 0.95) -> Interval:
    """Wilson's score interval for the share of successes in so many independent trials, 1 or more.

    Unlike the share plus or minus its standard error, it holds near 0 and 1 as well.
    """
    share, z = successes / trials, normal_quantile(level)
    scale = 1.0 + z * z / trials
    centre = (share + z * z / (2 * trials)) / scale
    half = z * math.sqrt(share * (1.0 - share) / trials + (z / (2 * trials)) ** 2) / scale
    return max(0.0, centre - half), min(1.0, centre + half)


def ratio_interval(
    parts: npt.ArrayLike,
    wholes: npt.ArrayLike,
    generator: np.random.Generator,
    level: float = 0.95,
) -> Interval:
    """Bootstrap interval for sum(parts) / sum(wholes), demonstrations being what is drawn again.

    Subgoals of one demonstration are found or missed together, so they are no trials of their own.

    Args:
        parts, wholes: (M,) of each demonstration; their wholes sum to above 0.
        generator: of the resampling.
        level: probability of the interval, its ends percentiles.
    """
    both = np.column_stack([parts, wholes]).astype(np.float64)
    drawn = generator.integers(len(both), size=(_RESAMPLES, len(both)))
    sums = both[drawn].sum(axis=1)
    ratios = sums[:, 0] / np.maximum(sums[:, 1], 1e-300)
    low, high = np.quantile(ratios, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return float(low), float(high)
