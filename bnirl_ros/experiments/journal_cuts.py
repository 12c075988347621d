"""A power cut, simulated: a journal that is cut at any byte keeps all that was on the disk."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bnirl_ros.bags.cdr import encode
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.journal.bag import open_journal
from bnirl_ros.maps import GridMap
from bnirl_ros.views.belief import map_message

_SECOND = 1_000_000_000
_MAP = GridMap(np.ones((10, 10), dtype=bool))


@dataclass(frozen=True)
class Cuts:
    """What came of it.

    Attributes:
        tried: number of cuts.
        wrong: the lengths to which the file was cut where the journal lost something that was on
            the disk, or told something that was not.
    """

    tried: int
    wrong: tuple[int, ...]


def cut_everywhere(folder: Path, appends: int = 20, every: int = 1) -> Cuts:
    """Write a journal, then cut its file and recover it.

    Args:
        folder: to work in.
        appends: how often something is appended.
        every: of how many bytes one is cut at.
    """
    generator = np.random.default_rng(0)
    recorder = Recorder()
    journal = open_journal(folder / "whole").journal
    file = next(journal.folder.glob("*.mcap"))
    known = [(file.stat().st_size, 0, 0)]  # bytes, and the poses and actions that they hold
    for number in range(appends):
        for _ in range(int(generator.integers(1, 8))):
            stamp = len(recorder) * _SECOND
            x, y = generator.uniform(0.0, 10.0, 2)
            recorder.add_pose(stamp, "map", x, y)
            recorder.add_action(stamp, 1.0, 0.0)
        map_data = encode(map_message(_MAP, 0)) if number == 0 else None
        journal.append(recorder.drain(), map_data, now=number * _SECOND)
        written = recorder.snapshot()
        known.append((file.stat().st_size, len(written.pose_stamps), len(written.actions)))
    content, whole = file.read_bytes(), recorder.snapshot()
    journal.close()
    place = folder / "cut" / journal.folder.name
    place.mkdir(parents=True)
    lengths = range(0, len(content) + 1, every)
    wrong = []
    for length in lengths:
        for left in place.iterdir():
            left.unlink()
        (place / file.name).write_bytes(content[:length])
        opened = open_journal(place.parent)
        poses, actions = max(
            (poses, actions) for size, poses, actions in known if size <= max(length, known[0][0])
        )
        found = opened.recovered.recording if opened.recovered else Recorder().snapshot()
        # Of what was being written, too, what is whole may be found.
        if not (
            len(found.pose_stamps) >= poses
            and len(found.actions) >= actions
            and _begins_with(whole.pose_stamps, found.pose_stamps)
            and _begins_with(whole.positions, found.positions)
            and _begins_with(whole.action_stamps, found.action_stamps)
            and _begins_with(whole.actions, found.actions)
        ):
            wrong.append(length)
        opened.journal.close()
    return Cuts(len(lengths), tuple(wrong))


def _begins_with(whole: np.ndarray, found: np.ndarray) -> bool:
    return np.array_equal(whole[: len(found)], found)


def main(arguments: Sequence[str] | None = None) -> int:
    """Cut a journal at every byte; the status is 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="of how many bytes one is cut at")
    every = parser.parse_args(arguments).every
    with TemporaryDirectory() as folder:
        cuts = cut_everywhere(Path(folder), every=every)
    print(f"{cuts.tried} cuts of a journal, {len(cuts.wrong)} lost what was on the disk")
    return 1 if cuts.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
