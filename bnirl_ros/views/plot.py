"""The picture of a posterior: map, observations by subgoal, subgoals and the way through them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.inference.summary import Summary
from bnirl_ros.maps import GridMap
from bnirl_ros.terminal_text import plain
from bnirl_ros.views.colours import INK, UNEXPLAINED, Colour, colour_of, writing_on
from bnirl_ros.views.map_panel import (
    ARROWS_FROM,
    SIGN,
    draw_free_space,
    draw_observations,
    import_matplotlib,
)
from bnirl_ros.views.pursuits import unexplained_share
from bnirl_ros.views.tables import subgoal_columns
from bnirl_ros.views.ways import Route, Way, route_of

_DOTS_PER_INCH = 144
_POINTS_PER_INCH = 72
_LONGEST = 7.4  # Longer side of the axes [inch].
_LARGEST_CELL = 0.85  # Edge of a cell, so that tiny maps are drawn small [inch].
_SHORTEST = 1.6  # Shorter side of the axes, unless the map would be stretched [inch].
_LEFT, _BOTTOM = 0.65, 0.6  # Margins beside and below the axes [inch].
_TOP, _TITLED_TOP = 0.2, 0.5  # Margin above them, without and with a title [inch].
_LEGEND_LEFT = 0.47  # From the axes to the middle of the legend's signs [inch].
_KEY = 0.34  # From there to what they mean [inch].
_LEGEND_LINE = 0.235  # Height of one line of the legend [inch].
_LARGEST_LEGEND = 24  # Subgoals that the legend lists.
# Width of the columns that it has, after the ranks [inch].
_COLUMNS = {
    "cell": 0.93,
    "feature": 0.93,
    "probability": 0.8,
    "observations": 0.95,
    "pursuits": 0.65,
    "order": 0.5,
}
_LETTER = 0.075  # Width of a letter in it [inch].

_TINT = 0.25  # Opacity of the colour on the cells of a feature subgoal.

_MOST_NUMBERS = 3  # Numbers on one way.
_NUMBER = 11.0  # Height of a number's box, and its width unless it is longer [pt].


@dataclass(frozen=True)
class _Layout:
    """Sizes of the picture: figure, axes and top margin [inch], a cell's edge on paper [pt].

    `bend` is how far the way from one subgoal to the next may bow, as a share of its length.
    """

    figure: tuple[float, float]
    axes: tuple[float, float]
    top: float
    cell: float
    bend: float


@dataclass(frozen=True, eq=False)
class _Number:
    """The numbers of a way: text, place (x, y) [cells], width and height of its box [pt]."""

    text: str
    place: npt.NDArray[np.float64]
    box: npt.NDArray[np.float64]


def draw_summary(
    summary: Summary, grid_map: GridMap, path: str | Path, title: str | None = None
) -> None:
    """Write the picture of a posterior as a PNG file.

    Shown are the map (blocked cells dark); each distinct (cell, action) pair of the observations,
    as an arrow along the action or a dot for staying, coloured by the subgoal to which the mode
    assigns it and the wider the more often it occurs (on maps too fine for arrows, a dot); the
    cells of feature subgoals, tinted; the subgoals with their rank, with their probability beside
    it; and the ways from one to the next as arrows, numbered in order (see `route_of`) and the
    wider the more often they were gone. Axes are in cells.

    Args:
        summary: the posterior.
        grid_map: the map on which it lies.
        path: the file to write.
        title: a line above the picture.

    Raises:
        OSError: the file cannot be written.
    """
    figure_class, canvas_class = import_matplotlib()
    route = route_of(summary)
    table = subgoal_columns(summary.subgoals[:_LARGEST_LEGEND], summary.visit_sequence)
    columns = {name: texts for name, texts in table.items() if name in _COLUMNS}
    legend = (
        _LEGEND_LEFT + sum(_column_width(*column) for column in columns.items()) + 0.2,
        _LEGEND_LINE * (len(columns["order"]) + 5 + route.wide),
    )
    layout = _layout(grid_map, legend, _TOP if title is None else _TITLED_TOP)
    width, height = layout.figure
    figure = figure_class(figsize=layout.figure, dpi=_DOTS_PER_INCH, facecolor="white")
    canvas = canvas_class(figure)
    axes = figure.add_axes(
        (
            _LEFT / width,
            (height - layout.top - layout.axes[1]) / height,
            layout.axes[0] / width,
            layout.axes[1] / height,
        )
    )
    _draw_map(axes, grid_map, layout)
    _draw_feature_cells(axes, summary, grid_map)
    draw_observations(axes, summary.observations, summary.rank_of, layout.cell)
    numbers = _number_places(summary, route, layout)
    _draw_route(axes, route, numbers, layout)
    _draw_subgoals(axes, summary, numbers, layout)
    _draw_legend(figure, summary, route, columns, layout)
    if title is not None:
        figure.text(
            _LEFT / width,
            1.0 - 0.6 * layout.top / height,
            plain(title),
            parse_math=False,
            fontsize=12,
            fontweight="bold",
            color=INK,
            verticalalignment="center",
        )
    with Path(path).open("wb") as file:
        canvas.print_png(file, metadata={"Software": None}, pil_kwargs={"compress_level": 2})


def _layout(grid_map: GridMap, legend: tuple[float, float], top: float) -> _Layout:
    """The layout for a map, beside it a legend of some width and height [inch]."""
    rows, columns = grid_map.free.shape
    # A longish map is as long as there is room, a square one smaller: about the same area.
    longest = _LONGEST * min(1.0, 0.78 * math.sqrt(max(rows, columns) / min(rows, columns)))
    inches = min(longest / max(rows, columns), _LARGEST_CELL)
    axes = (max(columns * inches, _SHORTEST), max(rows * inches, _SHORTEST))
    figure = (_LEFT + axes[0] + legend[0], top + max(axes[1] + _BOTTOM, legend[1]))
    # Ways bow aside of what was walked, but along a corridor not out of the map.
    bend = 0.14 * min(1.0, 2.5 * min(rows, columns) / max(rows, columns))
    return _Layout(figure, axes, top, inches * _POINTS_PER_INCH, bend)


def _draw_map(axes: Any, grid_map: GridMap, layout: _Layout) -> None:
    draw_free_space(axes, grid_map, layout.cell)
    rows, columns = grid_map.free.shape
    from matplotlib.ticker import MaxNLocator

    for axis, cells in ((axes.xaxis, columns), (axes.yaxis, rows)):
        ticks = min(max(int(cells * layout.cell / 50), 1), 8)  # One in 50 points of paper.
        axis.set_major_locator(MaxNLocator(nbins=ticks, integer=True, min_n_ticks=1))
    axes.set_xlabel(f"x [cells of {grid_map.resolution:.4g} m]", fontsize=9, color=INK)
    axes.set_ylabel("y [cells]", fontsize=9, color=INK)


def _draw_feature_cells(axes: Any, summary: Summary, grid_map: GridMap) -> None:
    """Tint the cells of feature subgoals with their colours."""
    rows, columns = grid_map.free.shape
    tints = np.zeros((rows, columns, 4))
    for subgoal in summary.subgoals:
        for x, y in subgoal.cells:
            tints[y, x] = (*colour_of(subgoal.rank), _TINT)
    if tints.any():
        axes.imshow(
            tints,
            origin="lower",
            extent=(-0.5, columns - 0.5, -0.5, rows - 0.5),
            interpolation="nearest",
            aspect="equal",
            zorder=1.5,
        )


def _draw_route(axes: Any, route: Route, numbers: Sequence[_Number], layout: _Layout) -> None:
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.patheffects import withStroke

    opacity = max(0.35, min(1.0, 8 / (len(numbers) + 1)))  # Many ways must not hide the map.
    for way in route.ways:
        width = max(_widest(route) * way.times / route.most, 0.8)
        axes.add_patch(
            FancyArrowPatch(
                way.here.cell,
                way.there.cell,
                connectionstyle=f"arc3,rad={_bend(way, layout)}",
                arrowstyle="-|>,head_length=5,head_width=2.6",
                shrinkA=_marker(layout) / 2 + 1,
                shrinkB=_marker(layout) / 2 + 2,
                linewidth=width,
                linestyle=(0, (4, 2)),
                color=SIGN,
                alpha=opacity,
                path_effects=[
                    withStroke(linewidth=width + 1.7, foreground="white", alpha=0.6 * opacity)
                ],
                zorder=4,
            )
        )
    for number in numbers:
        _write_order(axes, number.place, number.text)


def _widest(route: Route) -> float:
    """Width of the most frequent way [pt]."""
    return min(1.3 * math.sqrt(route.most), 4.0)


def _span(way: Way) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The vector [cells] from one end of a way to the other, and one as long to its right."""
    along = np.subtract(way.there.cell, way.here.cell, dtype=np.float64)
    return along, np.array([along[1], -along[0]])


def _bend(way: Way, layout: _Layout) -> float:
    """How far a way bows to its right, as a share of its length: at most to the map's edge."""
    along, aside = _span(way)
    frame = np.array(layout.axes) * _POINTS_PER_INCH
    middle = _on_paper(way.here.cell + along / 2, layout)
    room = np.where(aside > 0, frame - middle, middle) - _NUMBER
    bow = np.abs(aside) * layout.cell / 2  # Half of the control point's distance.
    reach = np.divide(room, bow, out=np.full(2, np.inf), where=bow > 0)
    return float(np.clip(reach.min(), 0.0, layout.bend))


def _number_places(summary: Summary, route: Route, layout: _Layout) -> list[_Number]:
    """The numbers of the ways: halfway, or where they cover less of markers and other numbers.

    They lie on their way, but beside it where there is a way back: it may be as close as that.
    """
    size = _marker(layout)
    taken = [
        (_on_paper(subgoal.cell, layout), np.array([size, size])) for subgoal in summary.subgoals
    ]
    pairs = {(way.here.rank, way.there.rank) for way in route.ways}
    numbers = []
    for way in route.ways:
        if not way.numbers:
            continue
        text = ", ".join(map(str, way.numbers[:_MOST_NUMBERS]))
        text += ", …" if len(way.numbers) > _MOST_NUMBERS else ""
        box = np.array([_NUMBER + 4.0 * max(len(text) - 2, 0), _NUMBER])
        along, aside = _span(way)
        bow = _bend(way, layout) * aside
        start = np.array(way.here.cell, dtype=np.float64)
        if (way.there.rank, way.here.rank) in pairs:
            start += (box / 2 + 2) * aside / max(math.hypot(*aside), 1.0) / layout.cell
        places = [
            start + share * along + 2 * share * (1 - share) * bow
            for share in (0.5, 0.6, 0.4, 0.7, 0.3)
        ]
        costs = [_overlap(_on_paper(place, layout), box, taken) for place in places]
        best = places[int(np.argmin(costs))]
        taken.append((_on_paper(best, layout), box))
        numbers.append(_Number(text, best, box))
    return numbers


def _on_paper(cell: npt.ArrayLike, layout: _Layout) -> npt.NDArray[np.float64]:
    """A place (x, y) [cells] as one right and up of the map's corner [pt]."""
    return (np.asarray(cell, dtype=np.float64) + 0.5) * layout.cell


def _overlap(
    centre: npt.NDArray[np.float64],
    box: npt.NDArray[np.float64],
    taken: Sequence[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]],
) -> float:
    """How much [pt^2] of a box, of some width and height, lies on others, each with its centre."""
    apart = np.abs([centre - other for other, _ in taken])
    sides = np.clip([(box + size) / 2 for _, size in taken] - apart, 0.0, None)
    return float(sides.prod(axis=1).sum())


def _write_order(axes: Any, place: npt.NDArray[np.float64], text: str) -> None:
    """The numbers of a way: the places in the order to which it leads."""
    axes.text(
        *place,
        text,
        fontsize=7,
        color=SIGN,
        horizontalalignment="center",
        verticalalignment="center_baseline",
        bbox={
            "boxstyle": "circle,pad=0.18" if len(text) < 3 else "round,pad=0.18,rounding_size=0.6",
            "facecolor": "white",
            "edgecolor": SIGN,
            "linewidth": 0.7,
        },
        zorder=4.5,
    )


def _marker(layout: _Layout) -> float:
    """Diameter of a subgoal's marker [pt]: it holds two digits."""
    return min(max(0.5 * layout.cell, 15.0), 22.0)


def _draw_subgoals(
    axes: Any, summary: Summary, numbers: Sequence[_Number], layout: _Layout
) -> None:
    from matplotlib.patheffects import withStroke

    size = _marker(layout)
    tags = _tag_places(summary, numbers, layout, size)
    for subgoal, (right, up) in zip(summary.subgoals, tags, strict=True):
        colour = colour_of(subgoal.rank)
        axes.plot(
            *subgoal.cell,
            marker="o",
            markersize=size,
            color=colour,
            markeredgecolor="white",
            markeredgewidth=1.4,
            clip_on=False,
            zorder=5,
        )
        axes.annotate(
            str(subgoal.rank),
            subgoal.cell,
            horizontalalignment="center",
            verticalalignment="center_baseline",
            fontsize=0.52 * size,
            fontweight="bold",
            color=writing_on(colour),
            zorder=6,
        )
        axes.annotate(
            f"{subgoal.probability:.2f}",
            subgoal.cell,
            xytext=(right, up),
            textcoords="offset points",
            horizontalalignment="center",
            verticalalignment="center",
            fontsize=8.5,
            color=INK,
            path_effects=[withStroke(linewidth=2.6, foreground="white")],
            zorder=7,
        )


def _tag_places(
    summary: Summary, numbers: Sequence[_Number], layout: _Layout, size: float
) -> Iterator[tuple[float, float]]:
    """Where each subgoal's probability goes, right and up of its centre [pt].

    Each takes the first of eight places around its marker where it covers least of the markers,
    of the numbers of the ways and of the probabilities placed before it, within the axes.
    """
    width, height = 24.0, 11.0
    frame = np.array(layout.axes) * _POINTS_PER_INCH
    centres = [_on_paper(subgoal.cell, layout) for subgoal in summary.subgoals]
    taken = [(centre, np.array([size, size])) for centre in centres]
    taken += [(_on_paper(number.place, layout), number.box) for number in numbers]
    aside, above = (size + width) / 2 + 1, (size + height) / 2 + 1
    places = np.array(
        [(0, above), (0, -above), (aside, 0), (-aside, 0)]
        + [(x * aside * 0.8, y * above * 0.8) for y in (1, -1) for x in (1, -1)]
    )
    box = np.array([width, height])
    for centre in centres:
        costs = []
        for place in places:
            low, high = centre + place - box / 2, centre + place + box / 2
            outside = np.clip(-low, 0.0, None).sum() + np.clip(high - frame, 0.0, None).sum()
            costs.append(_overlap(centre + place, box, taken) + 100.0 * outside)
        best = places[int(np.argmin(costs))]
        taken.append((centre + best, box))
        yield float(best[0]), float(best[1])


def _draw_legend(
    figure: Any, summary: Summary, route: Route, columns: dict[str, list[str]], layout: _Layout
) -> None:
    """The table of the subgoals and the key of the signs, right of the axes."""
    width, height = layout.figure
    legend = figure.add_axes((0, 0, 1, 1))
    legend.set_axis_off()
    legend.set_xlim(0, width)
    legend.set_ylim(height, 0)
    sign = _LEFT + layout.axes[0] + _LEGEND_LEFT

    def write(x: float, y: float, text: str, faint: bool = True, right: bool = False) -> None:
        legend.text(
            x,
            y,
            plain(text),
            parse_math=False,  # names of features may have any signs
            fontsize=8.5,
            color=SIGN if faint else INK,
            horizontalalignment="right" if right else "left",
            verticalalignment="center_baseline",
        )

    def dot(y: float, colour: Colour, size: float) -> None:
        legend.plot(sign, y, marker="o", markersize=size, color=colour, markeredgewidth=0)

    y = layout.top + 0.1
    x = sign
    for name, texts in columns.items():
        x += _column_width(name, texts)
        write(x, y, name, right=True)
        for line, text in enumerate(texts, start=1):
            write(x, y + line * _LEGEND_LINE, text, faint=False, right=True)
    for subgoal in summary.subgoals[:_LARGEST_LEGEND]:
        y += _LEGEND_LINE
        colour = colour_of(subgoal.rank)
        dot(y, colour, 13)
        legend.text(
            sign,
            y,
            str(subgoal.rank),
            fontsize=7.5,
            fontweight="bold",
            color=writing_on(colour),
            horizontalalignment="center",
            verticalalignment="center_baseline",
        )
    if len(summary.subgoals) > _LARGEST_LEGEND:
        y += _LEGEND_LINE
        more = len(summary.subgoals) - _LARGEST_LEGEND
        write(sign - 0.12, y, f"and {more} more")
    y += 1.6 * _LEGEND_LINE
    if route.ways:
        legend.annotate(
            "",
            xy=(sign + 0.22, y),
            xytext=(sign - 0.22, y),
            arrowprops={
                "arrowstyle": "-|>,head_length=0.35,head_width=0.2",
                "color": SIGN,
                "linewidth": 1.3,
            },
        )
        _write_order(legend, np.array([sign - 0.04, y]), "2")
        write(sign + _KEY, y, route.order)
        y += _LEGEND_LINE
    if route.wide:
        legend.plot([sign - 0.2, sign + 0.2], [y, y], color=SIGN, linewidth=_widest(route))
        write(sign + _KEY, y, "the wider, the more often")
        y += _LEGEND_LINE
    dot(y, colour_of(1), 4)
    write(sign + _KEY, y, _key_of_observations(layout))
    if (summary.rank_of == 0).any():
        y += _LEGEND_LINE
        dot(y, UNEXPLAINED, 4)
        write(sign + _KEY, y, f"explained by no subgoal: {unexplained_share(summary)}")


def _column_width(name: str, texts: Sequence[str]) -> float:
    """Width of a column of the legend [inch]."""
    return max(_COLUMNS[name], _LETTER * max(map(len, texts), default=0) + 0.25)


def _key_of_observations(layout: _Layout) -> str:
    if layout.cell < ARROWS_FROM:
        return "an observation, in its subgoal's colour"
    return "observed: dot for stay, arrow for a move"
