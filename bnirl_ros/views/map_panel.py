"""A map with observations on it: what every picture of a demonstration begins with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.maps import GridMap
from bnirl_ros.mdp.actions import STEPS
from bnirl_ros.views.colours import INK, Colour, colour_of

BLOCKED: Colour = (0.25, 0.28, 0.33)
"""Colour of blocked cells."""

SIGN: Colour = (0.35, 0.38, 0.43)
"""Colour of frames, ways and whatever else is drawn around the data."""

ARROWS_FROM = 9.0
"""Cells of this edge have room for arrows; on smaller ones observations get dots [pt]."""

_FREE: Colour = (1.0, 1.0, 1.0)
_GRID: Colour = (0.92, 0.93, 0.94)
_SMALLEST_DOT = 2.6  # Diameter [pt].

ARROW = np.array(
    [[0.0, 0.5], [0.55, 0.5], [0.55, 1.35], [1.0, 0.0], [0.55, -1.35], [0.55, -0.5], [0.0, -0.5]]
)
"""An arrow from (0, 0) to (1, 0): (along, across as a share of its width) of each corner."""


@dataclass(frozen=True, eq=False)
class DistinctPairs:
    """The distinct (cell, action) pairs that observations are made of, for each subgoal.

    Attributes:
        keys: (M, 4) x, y, action index, rank of the subgoal, in this order.
        counts: (M,) how often each occurs.
        turn: (M,) its place among those with the same cell and action, the most frequent first.
        index: (N,) the row of each observation.
    """

    keys: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    index: npt.NDArray[np.int64]


def distinct_pairs(
    observations: npt.NDArray[np.int64], rank_of: npt.NDArray[np.int64]
) -> DistinctPairs:
    """The distinct pairs of observations (N, 4) with their ranks (N,)."""
    every = np.column_stack([observations[:, 1:], rank_of]).reshape(-1, 4)
    keys, index, counts = np.unique(every, axis=0, return_inverse=True, return_counts=True)
    return DistinctPairs(keys, counts, _turns(keys[:, :3], counts), index.reshape(-1))


def import_matplotlib() -> tuple[Any, Any]:
    """matplotlib's Figure and FigureCanvasAgg, imported when first asked for.

    That takes longer than most inferences: what else there is to tell is told before.
    pyplot is left alone: it would keep every figure, and may look for a screen.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    return Figure, FigureCanvasAgg


def draw_free_space(axes: Any, grid_map: GridMap, cell: float) -> None:
    """The map, blocked cells dark, with a grid where cells are large enough for one.

    Args:
        axes: matplotlib's, whose units become cells, their centres at whole numbers.
        grid_map: the map.
        cell: edge of a cell on paper [pt].
    """
    rows, columns = grid_map.free.shape
    shades = np.rint(255 * np.array([BLOCKED, _FREE])).astype(np.uint8)
    axes.imshow(
        shades[grid_map.free.astype(np.uint8)],
        origin="lower",
        extent=(-0.5, columns - 0.5, -0.5, rows - 0.5),
        interpolation="nearest" if cell >= 2 else "antialiased",
        aspect="equal",
    )
    if cell >= ARROWS_FROM:
        axes.vlines(np.arange(columns - 1) + 0.5, -0.5, rows - 0.5, colors=[_GRID], linewidth=0.6)
        axes.hlines(np.arange(rows - 1) + 0.5, -0.5, columns - 0.5, colors=[_GRID], linewidth=0.6)
    axes.tick_params(labelsize=8.5, length=3, color=SIGN, labelcolor=INK)
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(-0.5, rows - 0.5)
    for spine in axes.spines.values():
        spine.set_color(SIGN)
        spine.set_linewidth(0.8)


def draw_observations(
    axes: Any,
    observations: npt.NDArray[np.int64],
    rank_of: npt.NDArray[np.int64],
    cell: float,
    colour: Callable[[int], Colour] = colour_of,
) -> None:
    """Each distinct (cell, action) pair in the colour of the subgoal that it is assigned to.

    An arrow along the action or a dot for staying, the wider the more often it occurs; a dot where
    cells are too small for arrows.

    Args:
        axes: those of the map, in cells.
        observations: (N, 4) episode, x, y, action index.
        rank_of: (N,) rank of each one's subgoal; 0 for none.
        cell: edge of a cell on paper [pt].
        colour: of a rank.
    """
    pairs = distinct_pairs(observations, rank_of)
    distinct, counts, turn = pairs.keys, pairs.counts, pairs.turn
    colours = np.array([colour(rank) for rank in distinct[:, 3].tolist()]).reshape(-1, 3)
    steps = STEPS[distinct[:, 2]]
    if cell < ARROWS_FROM:
        diameter = max(_SMALLEST_DOT, 0.8 * cell)
        # What is explained lies on top, and there the most frequent one.
        seen_last = np.lexsort((counts, distinct[:, 3] > 0))
        axes.scatter(
            *distinct[seen_last, :2].T,
            s=diameter**2,
            c=colours[seen_last],
            linewidths=0,
            zorder=3,
        )
        return
    from matplotlib.collections import PolyCollection

    # Where several subgoals share a (cell, action) pair, each next one lies on the one before it
    # and is slimmer, so that all are seen.
    width = np.sqrt(counts / counts.max(initial=1)) * 0.6**turn
    moves = steps.any(axis=1)
    for layer in range(turn.max(initial=-1) + 1):
        move, stay = moves & (turn == layer), ~moves & (turn == layer)
        outlines = _arrows(distinct[move, :2], steps[move], 0.04 + 0.16 * width[move])
        axes.add_collection(
            PolyCollection(
                list(outlines),
                facecolors=colours[move],
                edgecolors="white",
                linewidths=0.3,
                zorder=3,
            )
        )
        axes.scatter(
            *distinct[stay, :2].T,
            s=((0.14 + 0.26 * width[stay]) * cell) ** 2,
            c=colours[stay],
            edgecolors="white",
            linewidths=0.3,
            zorder=3.1,
        )


def _turns(pairs: npt.NDArray[np.int64], counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """For each of the sorted pairs (N, 3) its place among its equals, the most frequent first."""
    new = np.ones(len(pairs), dtype=bool)
    new[1:] = (pairs[1:] != pairs[:-1]).any(axis=1)
    group = np.cumsum(new) - 1
    order = np.lexsort((-counts, group))
    turn = np.empty(len(pairs), dtype=np.int64)
    turn[order] = np.arange(len(pairs)) - np.flatnonzero(new)[group]
    return turn


def _arrows(
    cells: npt.NDArray[np.int64], steps: npt.NDArray[np.int64], widths: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Outlines (N, 7, 2) [cells] of arrows from the cells (N, 2) along their steps (N, 2)."""
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    along = steps / length
    across = np.column_stack([-along[:, 1], along[:, 0]])
    return np.asarray(
        cells[:, np.newaxis, :]
        + 0.46 * ARROW[:, :1] * (along * np.sqrt(length))[:, np.newaxis, :]
        + ARROW[:, 1:] * (across * widths[:, np.newaxis])[:, np.newaxis, :]
    )
