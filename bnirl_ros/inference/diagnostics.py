"""Have the chains converged? Split R-hat and effective sample size (Vehtari et al. 2021)."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import numpy.typing as npt

FEWEST_DRAWS = 8
"""Draws of each chain below which nothing can be told."""


def rhat(values: npt.ArrayLike) -> float | None:
    """Rank-normalised split R-hat: the larger one of bulk and tail; 1 when chains agree.

    Vehtari, Gelman, Simpson, Carpenter, Bürkner, Bayesian Analysis 16(2), 2021, sections 3-4.

    Args:
        values: (chain, draw) of one scalar.

    Returns:
        None where it says nothing: one chain, fewer than eight draws, or no variance at all.
    """
    chains = np.asarray(values, dtype=np.float64)
    halves = _split(chains)
    if len(chains) < 2 or chains.shape[1] < FEWEST_DRAWS or np.ptp(halves) == 0.0:
        return None
    bulk = _plain_rhat(_rank_normalised(halves))
    tail = _plain_rhat(_rank_normalised(np.abs(halves - np.median(halves))))
    return max(bulk, tail)


def effective_sample_size(values: npt.ArrayLike) -> float | None:
    """Bulk effective sample size of the draws of all chains together.

    The same source, section 4; autocorrelations by Geyer's initial monotone sequence.

    Args:
        values: (chain, draw) of one scalar.

    Returns:
        None for fewer than eight draws, or no variance.
    """
    chains = np.asarray(values, dtype=np.float64)
    halves = _split(chains)
    if chains.shape[1] < FEWEST_DRAWS or np.ptp(halves) == 0.0:
        return None
    split = _rank_normalised(halves)
    count, length = split.shape
    covariance = _autocovariance(split)
    within = covariance[:, 0].mean() * length / (length - 1.0)
    pooled = within * (length - 1.0) / length
    if count > 1:
        pooled += split.mean(axis=1).var(ddof=1)
    correlation = 1.0 - (within - covariance.mean(axis=0)) / pooled
    correlation[0] = 1.0
    pairs = correlation[: length // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs < 0.0)
    # As Stan and ArviZ: to the first negative pair, or short of the end, where lags are too noisy.
    kept = min(int(negative[0]) if negative.size else length, (length - 3) // 2)
    time = -1.0 + 2.0 * np.minimum.accumulate(pairs[:kept]).sum() + max(correlation[2 * kept], 0.0)
    draws = count * length
    return float(draws / max(time, 1.0 / np.log10(draws)))


def _split(chains: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Each chain's halves as chains of their own; a middle draw is left out."""
    length = chains.shape[1]
    return np.concatenate([chains[:, : length // 2], chains[:, length - length // 2 :]])


def _rank_normalised(chains: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Normal scores of the average ranks over all chains (Blom's offsets)."""
    _, index, counts = np.unique(chains, return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts - 1) / 2.0
    normal = NormalDist()  # not scipy's, which would cost the command 0.1 s at its start
    scores = np.array([normal.inv_cdf(p) for p in (ranks - 0.375) / (chains.size + 0.25)])
    return scores[index].reshape(chains.shape)


def _plain_rhat(chains: npt.NDArray[np.float64]) -> float:
    if not np.ptp(chains, axis=1).any():  # every half-chain stands still: agreed, or never to be
        return float("inf") if np.ptp(chains) else 1.0
    length = chains.shape[1]
    within = chains.var(axis=1, ddof=1).mean()
    between = length * chains.mean(axis=1).var(ddof=1)
    return float(np.sqrt((between / within + length - 1.0) / length))


def _autocovariance(chains: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(chain, lag) biased autocovariances, by the Fourier transform."""
    length = chains.shape[1]
    centred = chains - chains.mean(axis=1, keepdims=True)
    spectrum = np.fft.rfft(centred, n=2 * length, axis=1)
    covariance = np.fft.irfft(spectrum * spectrum.conj(), n=2 * length, axis=1)[:, :length]
    return np.asarray(covariance / length)
