"""Figures 3, 4 and 5: what was demonstrated, how the 0-1 loss fell, what the mode says.

Cells are numbered as in the paper, from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.paper.courses import BNIRL, empirical_mode, mixture_of, sample
from bnirl_ros.experiments.paper.experiments import Experiment, Outcome, generator_of
from bnirl_ros.experiments.paper.trials import Trial, candidate_subgoals, trial_of
from bnirl_ros.experiments.scenarios import Cell, number_of
from bnirl_ros.maps import GridMap
from bnirl_ros.views.colours import INK, Colour, colour_of, writing_on
from bnirl_ros.views.map_panel import SIGN, draw_free_space, draw_observations, import_matplotlib

FIGURES = {"4.1": "figure_3", "4.2": "figure_4", "4.3": "figure_5"}
"""File names, without ending, of the paper's figures by section."""

BAND = 2.0
"""Half the width of a mean loss's band, in its standard errors: about 95 % for the mean."""

# By algorithm: rank of its colour, line style, and the marker on its line. Colours alone would
# not do in a print without colours.
_LINES: dict[str, tuple[int, Any, str]] = {
    "BN-IRL State": (1, "-", "o"),
    "BN-IRL Feature": (4, (0, (5, 1.5)), "s"),
    "Abbeel IRL": (2, (0, (3, 1, 1, 1)), "^"),
    "MaxMargin IRL": (3, (0, (1, 1)), "D"),
    "Bayesian IRL": (5, (0, (6, 1.5, 1, 1.5, 1, 1.5)), "v"),
}

_PANEL = 2.95  # Edge of a panel [inch].
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.62, 0.16, 0.55, 0.4  # Margins of a panel [inch].
_DOTS_PER_INCH = 200
_TICKS = 5  # One in so many cells has its number.


@dataclass(frozen=True, eq=False)
class Assignment:
    """Observations of a run with subgoals: of the best sample, or of the posterior mode.

    Attributes:
        title: what it is.
        subgoals: their cells, in the order of their ranks.
        rank_of: (N,) rank of each observation's subgoal: true ones in the order in which they are
            pursued, so that they have the same colour in every picture, then others.
    """

    title: str
    subgoals: tuple[Cell, ...]
    rank_of: npt.NDArray[np.int64]


def assignments(experiment: Experiment, run: int) -> list[Assignment]:
    """The best sample and the posterior mode of a run, with state subgoals."""
    trial = trial_of(experiment.scenario, run)
    candidates = candidate_subgoals(trial, BNIRL["BN-IRL State"])
    mixture = mixture_of(trial, candidates, experiment.parameters)
    generator = generator_of(run, "BN-IRL State")
    samples = sample(mixture, experiment.iterations, generator)
    best, mode = empirical_mode(mixture, samples)
    return [
        _assignment(title, candidates.coordinates, subgoal_of, trial.truth)
        for title, subgoal_of in (
            (f"Best of {experiment.iterations} samples", samples.subgoal_of[best]),
            ("Posterior mode", mode.subgoal_of),
        )
    ]


def _assignment(
    title: str,
    cells: npt.NDArray[np.int64],
    subgoal_of: npt.NDArray[np.int32],
    truth: Sequence[Cell],
) -> Assignment:
    chosen, index, counts = np.unique(subgoal_of, return_inverse=True, return_counts=True)
    found = [(int(x), int(y)) for x, y in cells[chosen]]
    place = {cell: number for number, cell in enumerate(truth)}
    order = sorted(range(len(found)), key=lambda n: (place.get(found[n], len(truth)), -counts[n]))
    rank_of = (np.argsort(order) + 1)[index]
    return Assignment(title, tuple(found[number] for number in order), rank_of)


def draw_figure(section: str, outcome: Outcome, folder: Path) -> list[Path]:
    """Write the figure of a section as PDF and PNG; returns the files.

    Raises:
        OSError: the files cannot be written.
    """
    experiment = outcome.experiment
    trial = trial_of(experiment.scenario, 0)
    grid_map = experiment.scenario.grid_map
    start = experiment.scenario.start
    drawers: list[Callable[[Any], None]] = [
        lambda axes: _draw_demonstration(axes, grid_map, trial.demonstration, start),
        lambda axes: _draw_losses(axes, outcome),
    ]
    if trial.truth:
        for assigned in assignments(experiment, 0):
            drawers.append(_assignment_drawer(grid_map, trial, assigned))
    figure_class, canvas_class = import_matplotlib()
    columns, rows = 2, len(drawers) // 2
    width, height = _LEFT + _PANEL + _RIGHT, _BOTTOM + _PANEL + _TOP
    size = (columns * width, rows * height)
    figure = figure_class(figsize=size, dpi=_DOTS_PER_INCH, facecolor="white")
    canvas_class(figure)
    for number, draw in enumerate(drawers):
        row, column = divmod(number, columns)
        left = (column * width + _LEFT) / size[0]
        bottom = ((rows - 1 - row) * height + _BOTTOM) / size[1]
        axes = figure.add_axes((left, bottom, _PANEL / size[0], _PANEL / size[1]))
        draw(axes)
    files = [folder / f"{FIGURES[section]}.{ending}" for ending in ("pdf", "png")]
    for file, metadata in zip(
        files,
        ({"CreationDate": None, "Creator": None, "Producer": None}, {"Software": None}),
        strict=True,
    ):
        figure.savefig(file, metadata=metadata)
    return files


def _assignment_drawer(
    grid_map: GridMap, trial: Trial, assigned: Assignment
) -> Callable[[Any], None]:
    return lambda axes: _draw_assignment(axes, grid_map, trial, assigned)


def _draw_map(axes: Any, grid_map: GridMap, title: str) -> float:
    """The map with the paper's numbers on its axes; returns the edge of a cell [pt]."""
    rows, columns = grid_map.free.shape
    cell = _PANEL * 72 / max(rows, columns)
    draw_free_space(axes, grid_map, cell)
    for axis, count in ((axes.xaxis, columns), (axes.yaxis, rows)):
        numbers = [1, *range(_TICKS, count + 1, _TICKS)]
        axis.set_ticks([number - 1 for number in numbers], [str(number) for number in numbers])
    _label(axes, title, "x", "y")
    return cell


def _label(axes: Any, title: str, across: str, up: str) -> None:
    axes.set_title(title, fontsize=10, color=INK, pad=6)
    axes.set_xlabel(across, fontsize=9, color=INK, labelpad=2)
    axes.set_ylabel(up, fontsize=9, color=INK, labelpad=2)
    axes.tick_params(labelsize=8.5, length=3, color=SIGN, labelcolor=INK)


def _draw_demonstration(
    axes: Any, grid_map: GridMap, demonstration: Demonstration, start: Cell
) -> None:
    count = len(demonstration)
    episodes = len(np.unique(demonstration.episode))
    title = f"Run 1: {count} observations in {episodes} demonstration{'s' * (episodes > 1)}"
    cell = _draw_map(axes, grid_map, title)
    nobody = np.zeros(count, dtype=np.int64)
    draw_observations(axes, demonstration.observations, nobody, cell, lambda rank: SIGN)
    axes.plot(
        *start,
        marker="o",
        markersize=1.25 * cell,
        markerfacecolor="none",
        markeredgecolor=colour_of(2),
        markeredgewidth=1.6,
        clip_on=False,
        zorder=4,
    )
    _tag(axes, start, "start", colour_of(2), grid_map, demonstration.cells)


def _draw_assignment(axes: Any, grid_map: GridMap, trial: Trial, assigned: Assignment) -> None:
    missing = set(trial.truth) - set(assigned.subgoals)
    cell = _draw_map(axes, grid_map, f"{assigned.title}, run 1")
    draw_observations(axes, trial.demonstration.observations, assigned.rank_of, cell)
    from matplotlib.patches import Rectangle

    for rank, (x, y) in enumerate(assigned.subgoals, start=1):
        for width, colour in ((3.6, "white"), (2.0, colour_of(rank))):
            axes.add_patch(
                Rectangle(
                    (x - 0.62, y - 0.62),
                    1.24,
                    1.24,
                    fill=False,
                    edgecolor=colour,
                    linewidth=width,
                    clip_on=False,
                    zorder=4,
                )
            )
        text = "({}, {})".format(*number_of((x, y)))
        _tag(axes, (x, y), text, colour_of(rank), grid_map, trial.demonstration.cells)
    for x, y in missing:
        axes.plot(x, y, marker="x", markersize=cell, color=INK, markeredgewidth=1.6, zorder=4)


def _tag(
    axes: Any,
    cell: Cell,
    text: str,
    colour: Colour,
    grid_map: GridMap,
    cells: npt.NDArray[np.int64],
) -> None:
    """A word on a coloured ground beside a cell, where it hides fewest of some cells."""
    width, height = 0.52 * len(text) + 0.5, 1.25  # [cells]
    right, up = 0.95 + width / 2, 0.95 + height / 2
    rows, columns = grid_map.free.shape
    places = [
        (cell[0] + dx * right, cell[1] + dy * up)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
    ]

    def cost(place: tuple[float, float]) -> float:
        half = np.array([width / 2 + 0.3, height / 2 + 0.3])
        hidden = (np.abs(cells - np.array(place)) < half).all(axis=1).sum()
        low = np.array(place) - half + 0.8
        high = np.array(place) + half - 0.8
        outside = (low < 0).any() or (high > (columns - 1, rows - 1)).any()
        return float(hidden) + 1000.0 * outside

    axes.text(
        *min(places, key=cost),
        text,
        fontsize=7.5,
        color=writing_on(colour),
        horizontalalignment="center",
        verticalalignment="center_baseline",
        bbox={
            "boxstyle": "round,pad=0.18,rounding_size=0.3",
            "facecolor": colour,
            "edgecolor": "white",
            "linewidth": 0.8,
        },
        zorder=5,
    )


def standard_error(losses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(T,) standard error of the mean over runs of losses (runs, T); 0 for a single run."""
    runs = len(losses)
    if runs == 1:
        return np.zeros(losses.shape[1])
    return np.asarray(losses.std(axis=0, ddof=1) / np.sqrt(runs))


def _draw_losses(axes: Any, outcome: Outcome) -> None:
    experiment = outcome.experiment
    iterations = np.arange(experiment.iterations + 1)
    highest = 0.0
    alone = len(experiment.algorithms) == 1
    for name in experiment.algorithms:
        rank, style, marker = _LINES[name]
        colour = colour_of(rank)
        losses = outcome.losses(name)
        known = ~np.isnan(losses).any(axis=0)
        mean = losses[:, known].mean(axis=0)
        half = BAND * standard_error(losses[:, known])
        low, high = np.maximum(mean - half, 0.0), mean + half
        axes.fill_between(iterations[known], low, high, color=colour, alpha=0.16, linewidth=0)
        axes.plot(
            iterations[known],
            mean,
            color=colour,
            linestyle=style,
            linewidth=1.6,
            marker=marker,
            markevery=(3 * rank, 20),
            markersize=4.5,
            markeredgecolor="white",
            markeredgewidth=0.5,
            label=f"{name}, best sample so far" if alone else name,
        )
        highest = max(highest, float(high.max()))
    if alone:
        (name,) = experiment.algorithms
        drawn = np.stack([found.sample_loss for found in outcome.found(name)])
        axes.plot(
            iterations,
            drawn.mean(axis=0),
            color=SIGN,
            linestyle=(0, (2, 1.5)),
            linewidth=1.1,
            label="the sample itself",
        )
    axes.set_xlim(0, experiment.iterations)
    axes.set_ylim(0, 1.05 * max(highest, 1.0))
    axes.grid(color=SIGN, alpha=0.15, linewidth=0.6)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(SIGN)
        spine.set_linewidth(0.8)
    up = f"0-1 loss of {outcome.observations():.0f} observations"
    _label(axes, f"0-1 policy loss, mean of {experiment.runs} runs", "iteration", up)
    axes.legend(
        fontsize=8, labelcolor=INK, frameon=True, framealpha=0.85, edgecolor="none", handlelength=3
    )
