"""A posterior as a page to hand round: one HTML file that needs no network."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from html import escape
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros import __version__
from bnirl_ros.bags.sources import STANDARD_INPUT
from bnirl_ros.inference.diagnostics import effective_sample_size, rhat
from bnirl_ros.inference.posterior import Posterior, watched_in
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Subgoal, Summary, middle_of
from bnirl_ros.limits import limits_of
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES, STEPS
from bnirl_ros.model.pursuits import PRIORS
from bnirl_ros.views.colours import Colour, colour_of, writing_on
from bnirl_ros.views.map_panel import ARROW, DistinctPairs, distinct_pairs
from bnirl_ros.views.pursuits import knows_pursuits, unexplained_share
from bnirl_ros.views.tables import after, interval_of, known, subgoal_columns, what_of
from bnirl_ros.views.ways import route_of

_MOST_OTHERS = 2000
"""Candidates that are shown beside the subgoals of the mode: the most probable ones."""

_LEAST = 0.005
"""Those less probable than this are not: the slider ends above."""

_MOST_DRAWS = 1000
"""Draws of each chain that a trace shows: of more, every second or third and so on."""

_NEARLY_AGREE = 1.05
"""R-hat above which chains are said not to agree before all else."""

_MOST_NAMES = 3
"""Demonstrations that a title names: more are counted."""


def title_of(paths: Sequence[Path]) -> str:
    """The title for a page of what was inferred from these files together."""
    if len(paths) > _MOST_NAMES:
        return f"{len(paths)} demonstrations"
    return ", ".join(
        "standard input" if path == STANDARD_INPUT else path.resolve().name for path in paths
    )


def report_page(posterior: Posterior, summary: Summary, grid_map: GridMap, title: str) -> str:
    """The page of a posterior, with all that it shows in it.

    Shown are the map with the observations coloured by subgoal, the subgoals and other candidates
    that are at least as probable as a slider says, the order of the visits, the traces of the
    chains, and the parameters. Whatever a demonstration brings, such as names, is written as text
    and never as markup; the page forbids itself any network. Equal arguments give equal pages.

    Args:
        posterior: the draws.
        summary: what they say.
        grid_map: the map on which they lie.
        title: heading of the page, such as the name of the demonstration.
    """
    counts = posterior.pursuit_counts()
    others = _others(posterior, summary, grid_map, counts)
    traces = _traces(posterior, counts)
    style = _file("report.css") + _colour_rules(summary)
    script = _file("report.js")
    page = Template(_file("report.html")).substitute(
        policy=(
            f"default-src 'none'; img-src data:; script-src '{_hash(script)}'; "
            f"style-src '{_hash(style)}'; base-uri 'none'; form-action 'none'"
        ),
        title=escape(title),
        generator=escape(f"bnirl_ros {__version__}"),
        lead=escape(_lead(summary)),
        tiles=_tiles(summary),
        map_label=escape(f"Map of {grid_map.free.shape[1]} x {grid_map.free.shape[0]} cells"),
        order=_order(summary),
        convergence=escape(_convergence(summary)),
        trace_rows=_trace_rows(traces),
        parameter_rows=_parameter_rows(summary, posterior.settings),
        setting_rows=_setting_rows(posterior.settings, grid_map),
        data=_as_script(_data(posterior, summary, grid_map, others, traces)),
        style=style,
        script=script,
        **_subgoal_table(summary),
    )
    # A file's name may hold bytes that are no UTF-8.
    return page.encode("utf-8", "replace").decode("utf-8")


def _file(name: str) -> str:
    """One of the files of which the page is made."""
    return files("bnirl_ros.views").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """By which a content security policy knows a script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode()


def _as_script(value: object) -> str:
    """JSON that may stand in a script element: nothing in it can end that."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _code(colour: Colour) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour)


def _colour_rules(summary: Summary) -> str:
    """Style rules for the colour of each rank: the policy knows no style of a single element."""
    return "".join(
        f".rank-{rank} {{ background: {_code(colour)}; color: {_code(writing_on(colour))}; }}\n"
        for rank in range(1, len(summary.subgoals) + 1)
        for colour in (colour_of(rank),)
    )


# What is there without a script


def _many(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"


def _lead(summary: Summary) -> str:
    """What was found, in a sentence."""
    observations = _many(len(summary.observations), "observation")
    episodes = _many(len(np.unique(summary.observations[:, 0])), "episode")
    if not summary.subgoals:
        return f"No subgoal explains any of {observations} in {episodes}."
    explain = "explains" if len(summary.subgoals) == 1 else "explain"
    subgoals = _many(len(summary.subgoals), "subgoal")
    share = ""
    if knows_pursuits(summary):
        percent = f"{100.0 * (1.0 - summary.unexplained):.4g}"
        share = "almost all of " if percent == "100" else f"{percent} % of "
    doubt = ""
    if summary.rhat is not None and summary.rhat > _NEARLY_AGREE:
        doubt = " The chains do not agree yet: with more sweeps this may change."
    return f"{subgoals} {explain} {share}{observations} in {episodes}.{doubt}"


def _tiles(summary: Summary) -> str:
    tiles = {
        "subgoals": f"{len(summary.subgoals):,}",
        "observations": f"{len(summary.observations):,}",
        "episodes": f"{len(np.unique(summary.observations[:, 0])):,}",
    }
    if knows_pursuits(summary):
        tiles["pursuits"] = f"{len(summary.pursuits):,}"
        tiles["unexplained"] = unexplained_share(summary)
    tiles["R-hat"] = known(summary.rhat, ".3f")
    tiles["effective sample size"] = known(summary.ess, ",.0f")
    return "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
        for name, value in tiles.items()
    )


def _row(cells: Iterable[str], attributes: str = "") -> str:
    """A row of a table, of the markup of its cells."""
    return f"<tr{attributes}>{''.join(cells)}</tr>\n"


def _cells(texts: Iterable[str], kind: str = "") -> list[str]:
    """Cells of one kind, of texts."""
    return [f'<td class="{kind}">{escape(text)}</td>' for text in texts]


def _subgoal_table(summary: Summary) -> dict[str, str]:
    """Head and rows of the table of the subgoals, by name in the template."""
    columns = subgoal_columns(summary.subgoals, summary.visit_sequence)
    del columns["place [m]"]  # The details of a subgoal tell it.
    ranks = columns.pop("rank")
    # Names of features may be long; cells stay on one line.
    kind = "number what" if "feature" in columns else "number"
    head = '<th scope="col"><span class="hidden-text">rank</span></th>' + "".join(
        f'<th scope="col" class="number">{escape(name)}</th>' for name in columns
    )
    rows = [
        _row(
            [
                f'<td><span class="rank rank-{rank}">{rank}</span></td>',
                *_cells([what], kind),
                *_cells(texts, "number"),
            ],
            f' data-rank="{rank}"',
        )
        for rank, what, *texts in zip(ranks, *columns.values(), strict=True)
    ]
    return {"subgoal_head": head, "subgoal_rows": "".join(rows)}


def _order(summary: Summary) -> str:
    """The subgoals in the order in which they were first visited, and how often it goes round."""
    if not summary.visit_sequence:
        return "<p>No subgoal was visited.</p>"
    of_rank = {subgoal.rank: subgoal for subgoal in summary.subgoals}
    chips = "".join(
        f'<li class="chip"><span class="rank rank-{rank}">{rank}</span>'
        f'<span class="where">{escape(what_of(of_rank[rank]))}</span></li>'
        for rank in summary.visit_sequence
    )
    words = "Subgoals in the order in which they were first visited"
    if summary.repetitions > 1:
        words += f"; the visits go round {summary.repetitions} times"
    return f'<p>{words}:</p><ol class="chips">{chips}</ol>'


def _convergence(summary: Summary) -> str:
    """What R-hat and effective sample size mean here."""
    drawn = f"{_many(summary.chains, 'chain')} of {_many(summary.draws, 'draw')}"
    if summary.rhat is None:
        return (
            f"{drawn}. R-hat is undefined, which it is for one chain, a few draws, or all the "
            "same ones; take more to see whether they agree."
        )
    agreed = summary.convergence
    worst = f"the worst R-hat is {summary.rhat:.3f}, of {agreed.rhat_of}"
    if summary.ess is not None:
        worst += f", and the smallest effective sample size {summary.ess:,.0f}, of {agreed.ess_of}"
    when = f" {after(summary.sampling)}" if summary.sampling else ""
    if agreed.reached:
        return f"{drawn}: {worst}. They have converged{when}."
    doubt = "more sweeps would make it more exact"
    if summary.rhat > _NEARLY_AGREE:
        doubt = "probabilities may be off; infer again with more sweeps"
    return f"{drawn}: {worst}. They have not converged{when}: {doubt}."


def _trace_rows(traces: Sequence[Mapping[str, Any]]) -> str:
    return "".join(
        _row(
            [
                f'<th scope="row">{escape(trace["name"])}</th>',
                *_cells([trace["rhat"], trace["ess"]], "number"),
            ]
        )
        for trace in traces
    )


def _parameter_rows(summary: Summary, settings: Settings) -> str:
    """Rows of the model's parameters; of a model that infers none, of those that it takes."""
    meaning = _meanings(settings)
    if summary.parameters:
        told = [
            (parameter.name, f"{parameter.median:.3g}", interval_of(parameter))
            for parameter in summary.parameters
        ]
    else:
        told = [(name, f"{value:.3g}", "fixed") for name, value in settings.fixed.items()]
    return "".join(
        _row(
            [
                f'<th scope="row">{escape(name)}</th>',
                *_cells([median], "number"),
                *_cells([interval], "nowrap"),
                *_cells([meaning[name]], "wide"),
            ]
        )
        for name, median, interval in told
    )


def _setting_rows(settings: Settings, grid_map: GridMap) -> str:
    """Rows of the settings that are no parameters, and of the map."""
    meaning = _meanings(settings)
    height, width = grid_map.free.shape
    x, y, yaw = grid_map.origin
    told = [
        (each.name, str(getattr(settings, each.name)), meaning[each.name])
        for each in fields(settings)
        if each.name not in PRIORS
    ]
    told += [
        ("map", f"{width} x {height} cells of {grid_map.resolution:.4g} m", "size of the map"),
        ("frame_id", grid_map.frame_id, "frame of the map"),
        ("origin", f"{x:.4g} m, {y:.4g} m, {yaw:.4g} rad", "lower left corner of the map"),
    ]
    return "".join(
        _row(
            [
                f'<th scope="row">{escape(name)}</th>',
                *_cells([value]),
                *_cells([words], "wide"),
            ]
        )
        for name, value, words in told
    )


def _meanings(settings: Settings) -> dict[str, str]:
    return {each.name: limits_of(each).description for each in fields(settings)}


# What the script draws


def _data(
    posterior: Posterior,
    summary: Summary,
    grid_map: GridMap,
    others: Sequence[tuple[Subgoal, int]],
    traces: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """All that the script knows."""
    height, width = grid_map.free.shape
    pairs = distinct_pairs(summary.observations, summary.rank_of)
    goals = [(subgoal, subgoal.rank) for subgoal in summary.subgoals] + list(others)
    route = route_of(summary)
    ranks = range(len(summary.subgoals) + 1)
    return {
        "width": width,
        "height": height,
        "resolution": grid_map.resolution,
        "frame": grid_map.frame_id,
        "map": _map_image(grid_map),
        "areas": _area_image([goal for goal, _ in goals], grid_map),
        "colours": [_code(colour_of(rank)) for rank in ranks],
        "actions": ACTION_NAMES,
        "steps": STEPS.tolist(),
        "arrow": ARROW.tolist(),
        "goals": [_goal(goal, counts_as) for goal, counts_as in goals],
        "pairs": {
            **dict(zip(("x", "y", "action", "rank"), pairs.keys.T.tolist(), strict=True)),
            "count": pairs.counts.tolist(),
            "turn": pairs.turn.tolist(),
            "sure": _sureness(posterior, summary, pairs),
        },
        "seen": pairs.index.tolist(),
        "episodes": _episodes(summary),
        "pursuits": [
            [pursuit.first, pursuit.last, pursuit.rank, pursuit.arrived]
            for pursuit in summary.pursuits
        ],
        "ways": [
            {
                "here": way.here.rank,
                "there": way.there.rank,
                "times": way.times,
                "numbers": way.numbers,
            }
            for way in route.ways
        ],
        "order": route.order,
        "traces": traces,
    }


def _goal(goal: Subgoal, counts_as: int) -> dict[str, Any]:
    """A subgoal of the mode, or another candidate, of rank 0."""
    return {
        "rank": goal.rank,
        "counts_as": counts_as,
        "label": what_of(goal),
        "cell": goal.cell,
        "place": [round(coordinate, 3) for coordinate in goal.position],
        "probability": round(goal.probability, 4),
        "observations": goal.observations,
        "pursuits": None if goal.pursuits is None else round(goal.pursuits, 2),
        "visits": goal.visit_order[:7],
    }


def _others(
    posterior: Posterior, summary: Summary, grid_map: GridMap, counts: npt.NDArray[np.int64]
) -> list[tuple[Subgoal, int]]:
    """Candidates that are no subgoals of the mode, the most probable first.

    Beside each the rank of the subgoal that it counts as, being near; 0 for none.
    """
    candidates = posterior.candidates
    probability = (counts > 0).mean(axis=0)
    pursuits = counts.mean(axis=0)
    counts_as = np.zeros(len(candidates), dtype=np.int64)
    counts_as[: len(summary.rank_of_candidate)] = summary.rank_of_candidate
    in_mode = {(subgoal.cell, subgoal.feature) for subgoal in summary.subgoals}
    names = grid_map.features.names if grid_map.features else {}
    others = []
    for index in np.argsort(-probability, kind="stable").tolist():
        if probability[index] < _LEAST or len(others) == _MOST_OTHERS:
            break
        cells = candidates.cells_of(index)
        cell = middle_of(cells)
        coordinates = tuple(candidates.coordinates[index].tolist())
        feature = coordinates if candidates.are_features else None
        if (cell, feature) in in_mode:
            continue
        x, y = grid_map.centres_of([cell])[0].tolist()
        goal = Subgoal(
            rank=0,
            cell=cell,
            position=(x, y),
            probability=float(probability[index]),
            observations=0,
            visit_order=(),
            pursuits=float(pursuits[index]) if summary.parameters else None,
            feature=feature,
            cells=tuple(map(tuple, cells.tolist())) if candidates.are_features else (),
            name=names.get(coordinates, "") if candidates.are_features else "",
        )
        others.append((goal, int(counts_as[index])))
    return others


def _sureness(posterior: Posterior, summary: Summary, pairs: DistinctPairs) -> list[float]:
    """For each distinct pair the share of the draws that agree on its subgoal with the mode."""
    # -2 stands for candidates that are no subgoal of the mode, and the last entry for a slip.
    rank_of = np.append(summary.rank_of_candidate, 0)
    rank_of[:-1][summary.rank_of_candidate == 0] = -2
    agreed = np.zeros(len(summary.rank_of), dtype=np.int64)
    drawn = posterior.draws.subgoal_of.reshape(-1, len(summary.rank_of))
    for subgoal_of in drawn:
        agreed += rank_of[subgoal_of] == summary.rank_of
    share = np.bincount(pairs.index, agreed, len(pairs.counts)) / pairs.counts / len(drawn)
    return np.round(share, 3).tolist()


def _episodes(summary: Summary) -> list[dict[str, int]]:
    """Where each episode begins among the observations, and how many there are."""
    names, first, counts = np.unique(
        summary.observations[:, 0], return_index=True, return_counts=True
    )
    return [
        {"number": name, "first": begin, "count": count}
        for name, begin, count in zip(names.tolist(), first.tolist(), counts.tolist(), strict=True)
    ]


def _traces(posterior: Posterior, counts: npt.NDArray[np.int64]) -> list[dict[str, Any]]:
    """Every quantity that differs from draw to draw, by chain."""
    draws = posterior.draws
    subgoals = (counts > 0).sum(axis=1).reshape(draws.log_joint.shape)
    quantities = {"log joint": draws.log_joint, "number of subgoals": subgoals}
    if not np.array_equal(draws.partition_count, subgoals):
        quantities["number of partitions"] = draws.partition_count
    if draws.parameters.shape[-1]:
        quantities |= {
            name: draws.parameters[..., column]
            for column, name in enumerate(PRIORS)
            if name not in posterior.settings.fixed
        }
    watched = watched_in(draws, posterior.demonstration, posterior.candidates)
    for name in (posterior.convergence.rhat_of, posterior.convergence.ess_of):
        if "subgoal" in name:  # the others are there already
            quantities[name.removeprefix("the ")] = watched[name].astype(np.int64)
    every = max(1, math.ceil(draws.log_joint.shape[1] / _MOST_DRAWS))
    return [
        {
            "name": name,
            "rhat": known(rhat(values), ".3f"),
            "ess": known(effective_sample_size(values), ",.0f"),
            "every": every,
            "chains": _as_drawn(values[:, ::every]),
        }
        for name, values in quantities.items()
    ]


def _as_drawn(values: npt.NDArray[Any]) -> list[list[float]]:
    """The values to as many digits as can be seen in a picture of all of them."""
    span = float(np.ptp(values))
    digits = max(0, 4 - math.floor(math.log10(span))) if span else 6
    if values.dtype.kind == "i":
        return values.tolist()
    return np.round(values, digits).tolist()


def _map_image(grid_map: GridMap) -> str:
    """The blocked cells, opaque on nothing, as a PNG in a data URI; north is up."""
    from PIL import Image

    image = Image.fromarray(np.where(grid_map.free[::-1], 0, 1).astype(np.uint8), "P")
    image.putpalette([255, 255, 255, 0, 0, 0])
    return _data_uri(image, transparency=0, bits=1)


def _area_image(goals: Sequence[Subgoal], grid_map: GridMap) -> str | None:
    """The 1-based number of the goal to which each cell belongs, as a colour; None for cells."""
    if not any(goal.cells for goal in goals):
        return None
    from PIL import Image

    number = np.zeros(grid_map.free.shape, dtype=np.uint32)
    for index, goal in enumerate(goals, start=1):
        cells = np.array(goal.cells)
        number[cells[:, 1], cells[:, 0]] = index
    parts = np.stack([number & 255, number >> 8 & 255, number >> 16], axis=-1)
    return _data_uri(Image.fromarray(parts[::-1].astype(np.uint8), "RGB"))


def _data_uri(image: Any, **options: Any) -> str:
    file = BytesIO()
    image.save(file, "PNG", optimize=True, **options)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
