"""How cost grows with states, observations, candidates and episodes, and how far the limit is.

    make benchmark
    python benchmarks/growth.py --plots docs --page docs/performance.md

The second draws performance.png in the folder, and puts what is printed into the page.

Times are those of the processor, the least of several runs, of one thread; kernels are compiled
and cached first. Limits are measured on the same machine in the same run: memory by a triad
a = b + c d over arrays that no cache holds, arithmetic by loops over arrays that the innermost
caches hold. Where cost grows faster than it should, that is told, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
from numba import njit

from bnirl_ros.experiments.machine import machine
from bnirl_ros.experiments.study.simulated import Demonstrator, demonstrate
from bnirl_ros.inference.samplers import Model, sampler_of
from bnirl_ros.inference.settings import PAPER_PARAMETERS
from bnirl_ros.maps import GridMap, load_map
from bnirl_ros.mdp import band, first_passage
from bnirl_ros.mdp.goal_values import goal_values
from bnirl_ros.mdp.grid_world import GridWorld
from bnirl_ros.model.mixture import subgoal_mixture
from bnirl_ros.model.pursuits import pursuit_model
from bnirl_ros.views.colours import INK, colour_of
from bnirl_ros.views.map_panel import SIGN, import_matplotlib

BOUND = 1e-6  # on the relative error of first-passage values
TOGETHER = 8  # goals near each other
CORNER = 40  # cells to a side, of the part in which a demonstration lies
WAREHOUSE = Path("../shared/data/maps/warehouse.yaml")  # 1,006 x 1,674 cells, from elsewhere
SAMPLER_MAP = GridMap(np.ones((32, 32), dtype=np.bool_))
SETTLED = 20  # sweeps before any is timed
STEEPEST = 1.3  # exponent of the growth, where 1 is proportional
CORNER_BOUND = 3.0  # times what the smallest map takes, on the largest
LIMIT_CASE = (10_000, 1000)  # observations and candidates
RUNS = 3
SHORT = 0.02  # [s] a run is repeated until it takes about that

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Sizes:
    """What is measured.

    Attributes:
        sides: of open maps [cells].
        observations, candidates, episodes: of demonstrations, the fixed ones in `fixed`.
        fixed: observations, candidates and episodes, where another one is varied.
        counted: side of the map on which passes are counted [cells].
        triad: numbers in each array of the triad.
    """

    sides: tuple[int, ...] = (20, 50, 100, 200, 500, 1000)
    observations: tuple[int, ...] = (100, 300, 1000, 3000, 10_000, 30_000)
    candidates: tuple[int, ...] = (10, 30, 100, 300, 1000)
    episodes: tuple[int, ...] = (1, 4, 16, 64, 256)
    fixed: tuple[int, int, int] = (3000, 100, 16)
    counted: int = 300
    triad: int = 2**24


QUICK = Sizes(
    sides=(20, 50, 100, 150),
    observations=(100, 300, 1000),
    candidates=(10, 30, 100),
    episodes=(1, 4, 16),
    fixed=(1000, 30, 16),
    counted=100,
    triad=2**22,
)


@dataclass(frozen=True)
class Curve:
    """Times that grow with a size.

    Attributes:
        name: of what is timed.
        sizes, seconds: ascending sizes, and the time at each.
    """

    name: str
    sizes: Sequence[int]
    seconds: Sequence[float]

    @property
    def exponent(self) -> float:
        """Of the power of the size with which time grows, over the larger half of them."""
        larger = slice(min(len(self.sizes) // 2, len(self.sizes) - 2), None)
        logs = np.log(self.sizes[larger]), np.log(self.seconds[larger])
        return float(np.polyfit(*logs, 1)[0])


def least(run: Callable[[], object]) -> float:
    """The least processor time of several runs [s], after one that doesn't count."""
    run()
    begin = time.process_time()
    run()
    once = time.process_time() - begin
    repeats = max(1, int(SHORT / max(once, 1e-6)))
    times = [once]
    for _ in range(RUNS - 1):
        begin = time.process_time()
        for _again in range(repeats):
            run()
        times.append((time.process_time() - begin) / repeats)
    return min(times)


def near_goals(world: GridWorld, count: int) -> Ints:
    """State numbers of so many free cells, the nearest to one a third into the map."""
    states = np.flatnonzero(world.free)
    middle = np.array(world.free.shape[::-1]) // 3
    away = np.abs(world.cells_of(states) - middle).sum(axis=1)
    return np.sort(states[np.argsort(away, kind="stable")[:count]])


def solved(world: GridWorld, count: int) -> float:
    """Time [s] for the values of one goal on a whole map, of so many solved at once."""
    goals = near_goals(world, count)
    return least(lambda: world.first_passage(goals, BOUND)) / count


def in_corner(side: int) -> float:
    """Time [s] for one of the goals of a demonstration in the corner of a larger map."""
    world = GridWorld(np.ones((side, side), dtype=np.bool_))
    y, x = np.divmod(np.arange(CORNER * CORNER), CORNER)
    states = world.states_of(np.column_stack([x, y]))
    goals = states[:: len(states) // TOGETHER + 1]
    return least(lambda: goal_values(world, goals, states)) / len(goals)


def goal_value_curves(sizes: Sizes) -> list[Curve]:
    """Seconds for the values of one goal, against the number of states."""
    worlds = [GridWorld(np.ones((side, side), dtype=np.bool_)) for side in sizes.sides]
    states = [world.state_count for world in worlds]
    wide = [
        side for side in sizes.sides if side > 2 * CORNER
    ]  # else the map ends before the margin
    return [
        Curve("one goal", states, [solved(world, 1) for world in worlds]),
        Curve(f"each of {TOGETHER} near", states, [solved(world, TOGETHER) for world in worlds]),
        Curve("in the corner", [side * side for side in wide], [in_corner(s) for s in wide]),
    ]


def on_map(path: Path) -> tuple[int, float, float]:
    """Free cells of a map, and seconds for one goal alone, and for each of several."""
    world = GridWorld(load_map(path).free)
    return int(world.free.sum()), solved(world, 1), solved(world, TOGETHER)


class Demonstrations:
    """Models of the first part of a long demonstration on a map of 32 x 32 cells."""

    def __init__(self, observations: int) -> None:
        generator = np.random.default_rng(0)
        whole, subgoals = demonstrate(
            Demonstrator(), SAMPLER_MAP, generator, 20 + observations // 60
        )
        assert len(whole) >= observations
        self.world = GridWorld(SAMPLER_MAP.free)
        self.states = self.world.states_of(whole.cells)
        self.actions = whole.action
        first = self.world.states_of(subgoals)
        others = generator.permutation(np.setdiff1d(np.arange(self.world.state_count), first))
        self.candidates = np.concatenate([first, others])

    def model(self, name: str, observations: int, candidates: int, episodes: int) -> Model:
        """A model of so many observations, candidates, and episodes of equal length."""
        states, actions = self.states[:observations], self.actions[:observations]
        goals = np.sort(self.candidates[:candidates])
        if name == "paper":
            return subgoal_mixture(self.world, states, actions, goals, **PAPER_PARAMETERS)
        numbers = np.arange(observations) * episodes // observations
        starts = np.diff(numbers, prepend=-1) != 0
        return pursuit_model(self.world, states, actions, starts, goals)


def draw_time(model: Model) -> float:
    """Seconds for a draw of a chain that has settled."""
    sampler, generator = sampler_of(model), np.random.default_rng(1)
    state = sampler.initial_state(model, generator)
    sampler.advance(model, state, generator, sampler.room_for(model, (SETTLED,)))
    draws = sampler.room_for(model, (8,))
    return least(lambda: sampler.advance(model, state, generator, draws)) / len(draws)


def sampler_curves(demonstrations: Demonstrations, sizes: Sizes) -> dict[str, tuple[Curve, Curve]]:
    """Seconds for a draw of either sampler, against observations, candidates and episodes."""
    varied = {
        "observations": sizes.observations,
        "candidates": sizes.candidates,
        "episodes": sizes.episodes,
    }

    def curve(name: str, place: int, values: tuple[int, ...]) -> Curve:
        seconds = []
        for value in values:
            case = [*sizes.fixed[:place], value, *sizes.fixed[place + 1 :]]
            seconds.append(draw_time(demonstrations.model(name, *case)))
        return Curve(name, values, seconds)

    return {
        what: (curve("sequential", place, values), curve("paper", place, values))
        for place, (what, values) in enumerate(varied.items())
    }


@njit(nogil=True, cache=True)
def _triad(a, b, c, d):  # type: ignore[no-untyped-def]
    for index in range(a.shape[0]):
        a[index] = b[index] + d * c[index]


def bandwidth(count: int) -> float:
    """Bytes a second between memory and one core; what is written is read before, unseen."""
    a, b, c = (np.full(count, value) for value in (0.0, 1.0, 2.0))
    return 3 * 8 * count / least(lambda: _triad(a, b, c, 3.0))


@njit(nogil=True, cache=True, fastmath={"nnan", "ninf", "nsz"})
def _gather(neighbours, value, after):  # type: ignore[no-untyped-def]
    """What a pass does for each cell, but that no cell waits for the one before it."""
    for row in range(neighbours.shape[0]):
        total = best = value[row]
        for move in range(8):
            other = value[neighbours[row, move]]
            total += other
            best = max(best, other)
        after[row] = 0.03 * total + 0.6 * best


def gathering() -> float:
    """Seconds for a cell in a pass over cells in the caches, where no cell waits for another."""
    side = 40
    rows = np.arange(side * side)[:, np.newaxis]
    around = np.array([1, side + 1, side, side - 1, -1, -side - 1, -side, 1 - side])
    neighbours = ((rows + around) % len(rows)).astype(np.uint32)
    value, after = np.ones(len(rows)), np.empty(len(rows))
    return least(lambda: _gather(neighbours, value, after)) / len(rows)


@njit(nogil=True, cache=True)
def _filter(before, weights, likely, kept, switch, explained, slip, after):  # type: ignore[no-untyped-def]
    """The arithmetic of filtering an observation; no sum over candidates."""
    for candidate in range(after.shape[0]):
        value = before[candidate] * kept + switch * weights[candidate]
        after[candidate] = value * (explained * likely[candidate] + slip)


@njit(nogil=True, cache=True)
def _filter_on(before, weights, likely, after, steps):  # type: ignore[no-untyped-def]
    for _ in range(steps // 2):
        _filter(before, weights, likely, 0.6, 0.4, 0.9, 0.1, after)
        _filter(after, weights, likely, 0.6, 0.4, 0.9, 0.1, before)


def filtering() -> float:
    """Seconds for an observation and a candidate where all is in the innermost cache."""
    candidates, steps = 500, 2000
    rows = np.random.default_rng(0).random((4, candidates))
    return least(lambda: _filter_on(*rows, steps)) / (candidates * steps)


def passes(side: int, count: int) -> float:
    """How many times sweeps pass over each cell of an open map, for so many goals at once.

    They are counted by solving once with the loop around the sweeps interpreted.
    """
    world = GridWorld(np.ones((side, side), dtype=np.bool_))
    swept = 0
    name, first = ("_sweep_of_one", 2) if count == 1 else ("_sweep", 3)
    sweep = getattr(band, name)

    def counting(*arguments: Any) -> int:
        nonlocal swept
        inner, outer = arguments[first : first + 2]
        swept += outer - inner
        return sweep(*arguments)

    with (
        mock.patch.object(band, name, counting),
        mock.patch.object(first_passage, "settle", band.settle.py_func),
    ):
        world.first_passage(near_goals(world, count), BOUND)
    return swept / world.state_count


def print_goal_values(
    curves: list[Curve], large: tuple[str, tuple[int, float, float]] | None
) -> None:
    """Print a row for each number of states."""
    one, near, corner = curves
    in_corner = dict(zip(corner.sizes, corner.seconds, strict=True))
    print(
        f"Goal values, each goal                    alone      {TOGETHER} near, each    in corner"
    )
    print(f"{'':28} {'[ms]':>8} {'[ns/cell]':>9} {'[ms]':>8} {'[ns/cell]':>9} {'[ms]':>9}")

    def row(name: str, cells: int, alone: float, each: float, cornered: str = "") -> None:
        both = f"{1e3 * alone:8.3f} {1e9 * alone / cells:9.1f} "
        both += f"{1e3 * each:8.3f} {1e9 * each / cells:9.1f}"
        print(f"{name:28} {both} {cornered:>9}".rstrip(), flush=True)

    for states, alone, each in zip(one.sizes, one.seconds, near.seconds, strict=True):
        cornered = f"{1e3 * in_corner[states]:9.3f}" if states in in_corner else ""
        row(f"  {states:,} states, open", states, alone, each, cornered)
    if large is not None:
        name, (cells, alone, each) = large
        row(f"  {cells:,} free, {name}", cells, alone, each)
    exponents = [f"{f'n^{curve.exponent:.2f}':>8}" for curve in curves]
    print(f"{'  grows as':28} {exponents[0]} {'':9} {exponents[1]} {'':9} {exponents[2]:>9}")


def print_draws(curves: dict[str, tuple[Curve, Curve]], sizes: Sizes) -> None:
    """Print a row for each case of the samplers."""
    observations, candidates, episodes = sizes.fixed
    print()
    print("One draw                        sequential                     paper")
    print(f"{'':28} {'[ms]':>8} {'[ns/(obs cand)]':>15} {'[ms]':>8} {'[ns/obs]':>9}")
    for place, (what, (sequential, paper)) in enumerate(curves.items()):
        others = [
            f"{number:,} {name}"
            for name, number in zip(curves, (observations, candidates, episodes), strict=True)
            if name != what
        ]
        print(f"  {', '.join(others)}:")
        for value, first, second in zip(
            sequential.sizes, sequential.seconds, paper.seconds, strict=True
        ):
            case = [*sizes.fixed[:place], value, *sizes.fixed[place + 1 :]]
            print(
                f"{f'    {value:,} {what}':28} {1e3 * first:8.3f} "
                f"{1e9 * first / (case[0] * case[1]):15.2f} "
                f"{1e3 * second:8.3f} {1e9 * second / case[0]:9.1f}",
                flush=True,
            )
        powers = [f"{f'n^{curve.exponent:.2f}':>8}" for curve in (sequential, paper)]
        print(f"{'    grows as':28} {powers[0]} {'':15} {powers[1]}")


def print_limits(curves: list[Curve], demonstrations: Demonstrations, sizes: Sizes) -> None:
    """Print what the machine can do, what is done, and how many times better the limit is."""
    rate = bandwidth(sizes.triad)
    print()
    print(f"{'Limits':56} {'limit':>9} {'ours':>9} {'ratio':>6}")
    print(f"{'  GB a second from memory, triad':56} {rate / 1e9:9.1f}")

    def row(what: str, limit: float, ours: float, ratio: float) -> None:
        print(f"{f'    {what}':56} {limit:9.2f} {ours:9.2f} {ratio:6.1f}", flush=True)

    for curve, count in zip(curves, (1, TOGETHER), strict=False):
        # A pass reads the places of eight neighbours, and reads and writes a value of each goal.
        moved = 8 * 4 + 2 * 8 * count
        number = passes(sizes.counted, count)
        states = curve.sizes[-1]
        seconds = count * curve.seconds[-1] / number
        print(f"  {curve.name}, {states:,} states: {number:.1f} passes over each cell")
        limit = moved * states / rate
        row(
            f"ms a pass, {moved} bytes a cell from memory",
            1e3 * limit,
            1e3 * seconds,
            seconds / limit,
        )
        if count == 1:
            limit, ours = 1e9 * gathering(), 1e9 * seconds / states
            row("ns a cell and pass, in cache and none waits", limit, ours, ours / limit)
    observations, candidates = LIMIT_CASE if sizes is not QUICK else sizes.fixed[:2]
    model = demonstrations.model("sequential", observations, candidates, sizes.fixed[2])
    ours = 1e9 * draw_time(model) / (observations * candidates)
    print(f"  sequential draw, {observations:,} observations, {candidates:,} candidates")
    for what, seconds in {
        "arithmetic of filtering, in cache": filtering(),
        "8 bytes from memory": 8.0 / rate,
    }.items():
        row(f"ns for each of both, {what}", 1e9 * seconds, ours, 1e-9 * ours / seconds)


def too_steep(curves: list[Curve], draws: dict[str, tuple[Curve, Curve]]) -> list[str]:
    """What grows faster than it should, a line for each."""
    one, near, corner = curves
    proportional = {"goal values, one goal": one, "goal values, several": near}
    proportional |= {f"a draw, {c.name}, {what}": c for what, both in draws.items() for c in both}
    lines = [
        f"BROKEN: {what}: grows as n^{curve.exponent:.2f}, is to be at most n^{STEEPEST:g}"
        for what, curve in proportional.items()
        if curve.exponent > STEEPEST
    ]
    if corner.seconds[-1] > CORNER_BOUND * corner.seconds[0]:
        lines.append(f"BROKEN: a corner takes more than {CORNER_BOUND:g} times as long")
    return lines


def draw_plots(
    curves: list[Curve],
    draws: dict[str, tuple[Curve, Curve]],
    sizes: Sizes,
    large: tuple[str, tuple[int, float, float]] | None,
    path: Path,
) -> None:
    """Write the picture: four panels, logarithmic, with dashes where cost is proportional."""
    figure_class, canvas_class = import_matplotlib()
    figure = figure_class(figsize=(9.0, 7.0), dpi=144, facecolor="white", layout="constrained")
    canvas = canvas_class(figure)
    panels = figure.subplots(2, 2).reshape(-1)
    titles = {"states": "Goal values, each goal"}
    observations, candidates, episodes = sizes.fixed
    titles["observations"] = f"A draw: {candidates} candidates, {episodes} episodes"
    titles["candidates"] = f"A draw: {observations:,} observations, {episodes} episodes"
    titles["episodes"] = f"A draw: {observations:,} observations, {candidates} candidates"
    groups = [curves, *draws.values()]
    for axes, (what, title), group in zip(panels, titles.items(), groups, strict=True):
        for number, curve in enumerate(group, start=1):
            axes.plot(
                curve.sizes,
                1e3 * np.array(curve.seconds),
                marker="o",
                markersize=4.5,
                linewidth=1.6,
                color=colour_of(number),
                label=curve.name,
            )
        if what == "states" and large is not None:
            name, (cells, *seconds) = large
            for number, taken in enumerate(seconds, start=1):
                label = f"{name} map" if number == 1 else None
                axes.plot(
                    cells, 1e3 * taken, "D", color=colour_of(number), mfc="white", label=label
                )
        if what != "episodes":
            _guide(axes, group[0])
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(what, color=INK)
        axes.set_ylabel("processor time [ms]", color=INK)
        axes.set_title(title, fontsize=10.5, color=INK, loc="left")
        axes.grid(which="major", color="0.92", linewidth=0.8)
        axes.tick_params(colors=SIGN, labelsize=9)
        for side, spine in axes.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(SIGN)
        axes.legend(frameon=False, fontsize=8.5, labelcolor=INK)
    low, high = panels[3].get_ylim()
    panels[3].set_ylim(low / 2, high * 4)
    canvas.print_png(str(path))


def _guide(axes: Any, curve: Curve) -> None:
    """A line through the last point of a curve, below it, with cost in proportion to the size."""
    ends = np.array([curve.sizes[0], curve.sizes[-1]], dtype=np.float64)
    slope = 2.5e3 * curve.seconds[-1] / ends[1]
    axes.plot(ends, slope * ends, "--", color=SIGN, linewidth=1.0, label="proportional", zorder=1)


def put_into(page: Path, printed: str) -> None:
    """Put what was printed into the first block of text of a page."""
    before = page.read_text(encoding="utf-8")
    block = re.compile(r"```text\n.*?```", re.DOTALL)
    if not block.search(before):
        raise SystemExit(f"{page} has no block ```text to put the figures into")
    page.write_text(block.sub(lambda _: f"```text\n{printed}```", before, count=1), "utf-8")


class Printed:
    """Standard output that is remembered."""

    def __init__(self) -> None:
        self.text = ""
        self._before = sys.stdout

    def write(self, text: str) -> int:
        """Write, and remember."""
        self.text += text
        return self._before.write(text)

    def flush(self) -> None:
        """As of any file."""
        self._before.flush()


def main() -> int:
    """Print the tables; returns the exit status."""
    parser = argparse.ArgumentParser(description="How does cost grow, and how far is the limit?")
    parser.add_argument("--quick", action="store_true", help="smaller sizes only")
    parser.add_argument("--map", type=Path, default=WAREHOUSE, help="a large one (%(default)s)")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="for performance.png")
    parser.add_argument("--page", type=Path, help="whose first block of text is replaced")
    given = parser.parse_args()
    sizes = QUICK if given.quick else Sizes()
    printed = Printed()
    sys.stdout = printed  # type: ignore[assignment]
    print(machine())
    print()
    curves = goal_value_curves(sizes)
    has_map = given.map.exists() and not given.quick
    large = (given.map.stem, on_map(given.map)) if has_map else None
    print_goal_values(curves, large)
    demonstrations = Demonstrations(max(*sizes.observations, LIMIT_CASE[0]))
    draws = sampler_curves(demonstrations, sizes)
    print_draws(draws, sizes)
    print_limits(curves, demonstrations, sizes)
    if given.page:
        put_into(given.page, printed.text)
    if given.plots:
        draw_plots(curves, draws, sizes, large, given.plots / "performance.png")
    broken = too_steep(curves, draws)
    print("\n".join(broken), end="\n" * bool(broken))
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
