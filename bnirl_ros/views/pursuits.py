"""Pursuits as views tell them: whether there are any, by episode, and what they leave over."""

from __future__ import annotations

import numpy as np

from bnirl_ros.inference.summary import Pursuit, Summary


def knows_pursuits(summary: Summary) -> bool:
    """Whether the model knows pursuits and slips, be it that it found nothing but slips."""
    return bool(summary.pursuits) or summary.unexplained > 0.0


def pursuits_by_episode(summary: Summary) -> dict[int, list[Pursuit]]:
    """The pursuits of each observed episode, in order; none where all of it is unexplained."""
    episodes: dict[int, list[Pursuit]] = {
        int(episode): [] for episode in np.unique(summary.observations[:, 0])
    }
    for pursuit in summary.pursuits:
        episodes[pursuit.episode].append(pursuit)
    return episodes


def unexplained_share(summary: Summary) -> str:
    """The expected share of unexplained observations, in percent."""
    return f"{100.0 * summary.unexplained:.3g} %"
