"""The result files of an inference: subgoals.json, posterior.npz, subgoals.png, report.html."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.inference.posterior import Posterior
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Subgoal, Summary, middle_of
from bnirl_ros.maps.grid_map import GridMap
from bnirl_ros.model.pursuits import PRIORS
from bnirl_ros.views.plot import draw_summary
from bnirl_ros.views.pursuits import knows_pursuits, pursuits_by_episode
from bnirl_ros.views.report import report_page
from bnirl_ros.views.waypoints import Visits, visits_in_order

FORMAT = 1
"""Format number of subgoals.json; added fields keep it."""


def write_results(
    folder: Path,
    posterior: Posterior,
    summary: Summary,
    grid_map: GridMap,
    settings: Settings,
    report_title: str | None = None,
) -> list[Path]:
    """Write the three result files, each whole or not at all; returns their paths.

    With a title, report.html is written too, the page that `report_page` makes.

    Raises:
        InputError: the folder cannot be written to.
    """
    # Those of the posterior tell whether draws were thinned out to fit into memory.
    text = json.dumps(subgoals_document(summary, grid_map, posterior.settings), indent=2) + "\n"
    writers: dict[str, Callable[[Path], object]] = {
        "subgoals.json": lambda path: path.write_text(text, encoding="utf-8"),
        "posterior.npz": lambda path: write_arrays(path, posterior_arrays(posterior)),
        "subgoals.png": lambda path: draw_summary(summary, grid_map, path),
    }
    if report_title is not None:
        page = report_page(posterior, summary, grid_map, report_title)
        writers["report.html"] = lambda path: path.write_text(page, encoding="utf-8")
    return write_whole(folder, writers)


def write_whole(folder: Path, writers: Mapping[str, Callable[[Path], object]]) -> list[Path]:
    """Write files into a folder, each whole or not at all; returns their paths.

    Args:
        folder: made where it is not there.
        writers: by name of the file, what writes it to a path.

    Raises:
        InputError: the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # In a folder of our own nobody has laid a link that would let us write elsewhere.
        with TemporaryDirectory(prefix=".partial-", dir=folder) as partial:
            for name, write in writers.items():
                write(Path(partial, name))
                Path(partial, name).replace(folder / name)
    except OSError as error:
        raise unwritable(folder, error) from error
    return [folder / name for name in writers]


def write_contents(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files, each whole or not at all, whose contents are given by name.

    Raises:
        InputError: the folder cannot be written to.
    """

    def writer(content: bytes) -> Callable[[Path], object]:
        return lambda path: path.write_bytes(content)

    return write_whole(folder, {name: writer(content) for name, content in contents.items()})


def check_writable(folder: Path) -> None:
    """Find out whether results can be written, before time is spent on them.

    Raises:
        InputError: nothing can be written into the folder, or where it would be made.
    """
    place = folder
    while not place.exists():
        place = place.parent
    try:
        with TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise unwritable(folder, error) from error


def unwritable(folder: Path, error: OSError) -> InputError:
    """What to tell of a folder into which results cannot be written."""
    return InputError(
        f"{folder}: the results cannot be written there ({error.strerror}); choose another folder"
    )


def subgoals_document(summary: Summary, grid_map: GridMap, settings: Settings) -> dict[str, Any]:
    """The content of subgoals.json.

    A model that knows pursuits adds to each subgoal the expected number of its `pursuits`, and
    below `visit_sequence` how often the pursuits go round it (`repetitions`, 0 for no loop), the
    pursuits of each of the `episodes`, from `first` to `last` by rows of `observations` in
    posterior.npz, and the expected share of `unexplained` observations. `diagnostics` tell what
    `stopped` the sweeps and whether the chains have `converged`. `parameters` are there
    where the summary tells them, with median and central 90 % of the posterior. A feature subgoal
    has its coordinates as `feature`, all its `cells`, the `name` of the feature if it has one, and
    no single `cell`.
    """
    known = {parameter.name: parameter.median for parameter in summary.parameters}
    return {
        "format": FORMAT,
        "frame_id": grid_map.frame_id,
        "resolution": grid_map.resolution,
        "model": {
            "name": settings.model,
            "alpha": known.get("alpha", settings.fixed.get("alpha")),
            "eta": known.get("eta", settings.fixed.get("eta")),
            "discount": settings.discount,
            "success": settings.success,
        },
        "subgoals": [
            {
                "rank": subgoal.rank,
                "cell": list(subgoal.cell) if subgoal.feature is None else None,
                "position": list(subgoal.position),
                "probability": subgoal.probability,
                "observations": subgoal.observations,
                "visit_order": list(subgoal.visit_order),
                **({} if subgoal.pursuits is None else {"pursuits": subgoal.pursuits}),
                **_feature(subgoal),
            }
            for subgoal in summary.subgoals
        ],
        "visit_sequence": list(summary.visit_sequence),
        **_pursuits(summary),
        **_parameters(summary),
        "diagnostics": {
            "rhat": finite(summary.rhat),
            "ess": finite(summary.ess),
            "chains": summary.chains,
            "draws": summary.draws,
            **_sampling(summary),
        },
    }


def _sampling(summary: Summary) -> dict[str, Any]:
    """What the document tells of how the draws came about, and whether they suffice."""
    if summary.sampling is None:
        return {}
    return {
        "sweeps": summary.sampling.sweeps,
        "burn_in": summary.sampling.burn_in,
        "thin": summary.sampling.thin,
        "stopped": summary.sampling.stopped,
        "converged": summary.convergence.reached,
        "rhat_of": summary.convergence.rhat_of,
        "ess_of": summary.convergence.ess_of,
    }


def _feature(subgoal: Subgoal) -> dict[str, Any]:
    """What the document tells of a feature subgoal alone."""
    if subgoal.feature is None:
        return {}
    return {
        "feature": list(subgoal.feature),
        "cells": [list(cell) for cell in subgoal.cells],
        **({"name": subgoal.name} if subgoal.name else {}),
    }


def _pursuits(summary: Summary) -> dict[str, Any]:
    """What the document tells of pursuits and slips; nothing for a model that knows none."""
    if not knows_pursuits(summary):
        return {}
    return {
        "repetitions": summary.repetitions,
        "episodes": [
            {
                "episode": episode,
                "pursuits": [
                    {
                        "rank": pursuit.rank,
                        "first": pursuit.first,
                        "last": pursuit.last,
                        "arrived": pursuit.arrived,
                    }
                    for pursuit in pursuits
                ],
            }
            for episode, pursuits in pursuits_by_episode(summary).items()
        ],
        "unexplained": summary.unexplained,
    }


def _parameters(summary: Summary) -> dict[str, Any]:
    """What the document tells of the model's parameters, where the summary has any."""
    if not summary.parameters:
        return {}
    return {
        "parameters": {
            parameter.name: {
                "median": parameter.median,
                "interval": list(parameter.interval),
                "inferred": parameter.inferred,
            }
            for parameter in summary.parameters
        }
    }


def subgoals_in(document: Mapping[str, Any]) -> tuple[Subgoal, ...]:
    """The subgoals that the content of a subgoals.json tells."""
    return tuple(
        Subgoal(
            rank=entry["rank"],
            cell=tuple(entry["cell"])
            if entry["cell"]
            else middle_of(np.array(entry["cells"], dtype=np.int64)),
            position=(entry["position"][0], entry["position"][1]),
            probability=entry["probability"],
            observations=entry["observations"],
            visit_order=tuple(entry["visit_order"]),
            pursuits=entry.get("pursuits"),
            feature=tuple(entry["feature"]) if "feature" in entry else None,
            cells=tuple((x, y) for x, y in entry.get("cells", [])),
            name=entry.get("name", ""),
        )
        for entry in document["subgoals"]
    )


def read_document(path: Path) -> Mapping[str, Any]:
    """The content of a subgoals.json.

    Raises:
        InputError: the file cannot be read, is no JSON, or has another format number.
    """
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the subgoals.json of bnirl infer"
        ) from None
    # json lets through UnicodeDecodeError, a ValueError, and RecursionError for deep nesting.
    except (ValueError, RecursionError):
        raise InputError(
            f"{path}: this is not valid JSON; give the subgoals.json of bnirl infer"
        ) from None
    if not isinstance(document, Mapping) or "format" not in document:
        raise InputError(f"{path}: has no format number; give the subgoals.json of bnirl infer")
    if document["format"] != FORMAT:
        raise InputError(
            f"{path}: has the format {document['format']!r} where only {FORMAT} is known; infer "
            "again with this version"
        )
    return document


def read_visits(path: Path) -> Visits:
    """The subgoals of a subgoals.json in the order in which they were visited, at least one.

    Raises:
        InputError: as `read_document`, and where a field is missing or means nothing, or no
            subgoal was visited.
    """
    document = read_document(path)
    try:
        subgoals, sequence = subgoals_in(document), document["visit_sequence"]
        if set(sequence) - {subgoal.rank for subgoal in subgoals}:
            raise ValueError("'visit_sequence' has a rank that no subgoal has")
        repetitions = document.get("repetitions", 0)
        visits = visits_in_order(subgoals, sequence, repetitions, document["frame_id"])
        _check_visits(visits)
    except KeyError as error:
        fault = f"{error.args[0]!r} is missing"
    except (TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        fault = str(error)
    else:
        if not visits.subgoals:
            raise InputError(
                f"{path}: tells of no subgoal that was visited; infer from a longer demonstration"
            )
        return visits
    raise InputError(f"{path}: is not as bnirl infer writes it ({fault}); infer again")


def _check_visits(visits: Visits) -> None:
    """Raise ValueError, or TypeError, where a field is not what it should be."""
    if not isinstance(visits.frame_id, str) or not visits.frame_id:
        raise ValueError("'frame_id' is no name")
    ranks = [subgoal.rank for subgoal in visits.subgoals]
    if len(set(ranks)) < len(ranks):
        raise ValueError("'visit_sequence' has a rank twice")
    for subgoal in visits.subgoals:
        numbers = [*subgoal.position, subgoal.probability, *subgoal.visit_order]
        numbers += [] if subgoal.pursuits is None else [subgoal.pursuits]
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"the subgoal of rank {subgoal.rank} has a number that is not finite")


def posterior_arrays(posterior: Posterior) -> dict[str, npt.NDArray[Any]]:
    """The arrays of posterior.npz: those of the sequential model tell its parameters, too."""
    arrays: dict[str, npt.NDArray[Any]] = {
        "candidates": posterior.candidates.coordinates,
        "observations": posterior.demonstration.observations,
        "subgoal_of": posterior.draws.subgoal_of,
        "partition_of": posterior.draws.partition_of,
        "log_joint": posterior.draws.log_joint,
        "mode_subgoal_of": posterior.mode.subgoal_of,
        "mode_partition_of": posterior.mode.partition_of,
    }
    if posterior.settings.model == "sequential":
        arrays["parameters"] = posterior.draws.parameters
        arrays["parameter_names"] = np.array(list(PRIORS))
    return arrays


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write a compressed .npz, quickly, and with the same bytes for the same arrays.

    `np.savez_compressed` spends ten times as long on the draws of a long demonstration to save a
    little more space, and writes the time of day into the file.
    """
    with zipfile.ZipFile(path, "w") as archive:
        write_array: Any = np.lib.format.write_array
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            member._compresslevel = 1  # type: ignore[attr-defined]
            with archive.open(member, "w", force_zip64=True) as file:
                write_array(file, np.ascontiguousarray(values), allow_pickle=False)


def finite(value: float | None) -> float | None:
    """JSON has no infinity: chains that each stand still have no variance to judge by."""
    return value if value is not None and math.isfinite(value) else None
