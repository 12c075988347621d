"""The posterior of one demonstration, from its file to the result files, in a worker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from bnirl_ros.fleet.reading import Reading, Tell, read
from bnirl_ros.inference.posterior import infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import summarise
from bnirl_ros.maps import FeatureLayer, with_features
from bnirl_ros.views.report import title_of
from bnirl_ros.views.results import write_results


@dataclass(frozen=True, eq=False)
class Inferred:
    """What was inferred from one demonstration.

    Attributes:
        files: contents of the result files, by name.
        episodes, observations, subgoals: how many there are.
        rhat, ess: of the chains; None where undefined.
        converged: whether the chains have.
        left_out: what could not be used of the demonstration, counted by fault.
        damage: a sentence on where its file is damaged; None for a sound one.
    """

    files: Mapping[str, bytes]
    episodes: int
    observations: int
    subgoals: int
    rhat: float | None
    ess: float | None
    converged: bool
    left_out: Mapping[str, int]
    damage: str | None


def infer_from(
    path: Path,
    reading: Reading,
    settings: Settings,
    features: FeatureLayer | None,
    threads: int,
    report: bool,
    tell: Tell,
) -> Inferred:
    """Infer the subgoals of the demonstration in a file.

    The results are handed back, rather than written where they belong: a worker on another machine
    needs to read the files of demonstrations and nothing else.

    Args:
        path: the file.
        reading: how it is read.
        settings: of the inference.
        features: of the map's cells, where subgoals are to be told by features.
        threads: how many chains run at the same time.
        report: whether report.html is among the results.
        tell: told of remarks.

    Raises:
        InputError: the demonstration cannot be used.
    """
    placed = read(path, reading, tell)
    grid_map = with_features(placed.grid_map, features) if features else placed.grid_map
    posterior = infer(placed.demonstration, grid_map, settings, threads=threads)
    summary = summarise(posterior, grid_map)
    title = title_of([path]) if report else None
    with TemporaryDirectory() as folder:
        written = write_results(Path(folder), posterior, summary, grid_map, settings, title)
        files = {file.name: file.read_bytes() for file in written}
    return Inferred(
        files=files,
        episodes=int(placed.demonstration.starts.sum()),
        observations=len(placed.demonstration),
        subgoals=len(summary.subgoals),
        rhat=summary.rhat,
        ess=summary.ess,
        converged=summary.convergence.reached,
        left_out=placed.left_out,
        damage=placed.damage,
    )
