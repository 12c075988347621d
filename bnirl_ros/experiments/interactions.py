"""From which cells the players of Overcooked interact: what the subgoals of a kitchen should be.

`python -m bnirl_ros.experiments.interactions` counts it in the recordings of human play. In
`random3` 937 interactions had an effect, 97 % of them from six cells, each with 10 % or more; no
other cell has more than 1.1 %.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from bnirl_ros.errors import InputError
from bnirl_ros.experiments.make_bags import LAYOUTS
from bnirl_ros.experiments.overcooked import add_option, read_interactions


def shares(cells: npt.NDArray[np.int64]) -> list[tuple[tuple[int, int], float]]:
    """Each distinct one of the cells (M, 2) with its share of them, the largest first."""
    found, counts = np.unique(cells, axis=0, return_counts=True)
    return [
        ((int(found[index, 0]), int(found[index, 1])), float(counts[index] / len(cells)))
        for index in np.argsort(-counts, kind="stable")
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 for missing or wrong recordings."""
    parser = argparse.ArgumentParser(
        prog="interactions", description="Count from which cells players interact with effect."
    )
    add_option(parser)
    options = parser.parse_args(arguments)
    try:
        for layout in LAYOUTS:
            cells = read_interactions(options.overcooked, layout)
            print(f"{layout}: {len(cells)} interactions had an effect")
            for cell, share in shares(cells):
                print(f"  {cell}  {share:6.1%}")
    except InputError as error:
        print(f"interactions: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
