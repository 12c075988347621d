"""`bnirl predict`: from a file to predictions.csv and a table."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bnirl_ros.cli.inference import (
    DEMONSTRATION,
    add_inference,
    inferred,
    placed,
    read,
    remappings_of,
    settings_of,
    told_of,
)
from bnirl_ros.cli.terminal import say, warn
from bnirl_ros.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from bnirl_ros.demonstrations.demonstration import Demonstration
    from bnirl_ros.inference.posterior import Posterior
    from bnirl_ros.inference.scoring import Losses
    from bnirl_ros.maps.grid_map import GridMap
    from bnirl_ros.views.predictions import Foreseen


def add(commands: Any) -> None:
    """The subcommand and its options."""
    parser = commands.add_parser(
        "predict",
        help="foresee the actions of a demonstrator like the recorded one",
        description="Infer the subgoals of a recorded demonstration, and foresee with them: each "
        "action of others, given its episode so far, or what is done first by who begins in a "
        "cell.",
    )
    parser.add_argument("demonstration", metavar="DEMO", type=Path, help=DEMONSTRATION)
    add_inference(parser)
    foreseen = parser.add_mutually_exclusive_group()
    foreseen.add_argument(
        "--held-out",
        action="append",
        default=[],
        type=Path,
        metavar="OTHER",
        help="a demonstration on the same map (rosbag2 folder, .mcap or .csv), to foresee action "
        "by action and to measure how well; may be given several times",
    )
    foreseen.add_argument(
        "--cell",
        action="append",
        default=[],
        type=_cell,
        metavar="x,y",
        help="a cell to begin in; may be given several times (all visited cells; all free ones "
        "with --candidates free)",
    )
    parser.set_defaults(run=_predict, command=parser)


def _predict(options: argparse.Namespace) -> int:
    """`bnirl predict`: from a file to predictions.csv and a table."""
    settings = settings_of(options.command, options)
    remappings = remappings_of(options.command, options.remap)

    from bnirl_ros.inference.prediction import beginning_in
    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.views.predictions import cell_table, loss_table, write_predictions
    from bnirl_ros.views.results import check_writable
    from bnirl_ros.views.tables import convergence, verdict

    demonstration, grid_map, damage = read(options, settings, remappings)
    for cell in options.cell:
        if fault := grid_map.fault_of(cell):
            raise InputError(f"--cell: {fault}; choose a free one")
    others = []
    for path in options.held_out:
        if path.resolve() == options.demonstration.resolve():
            warn(f"{path}: is what was learnt from; how well it is foreseen tells little")
        held_out, _, also_damaged = placed(path, grid_map, options, settings, remappings, True)
        others.append((str(path), held_out))
        damage = damage or also_damaged
    check_writable(options.out)
    posterior = inferred(demonstration, grid_map, settings)
    if not others:
        cells = options.cell or _places_to_begin(posterior, grid_map)
        others = [("", beginning_in(cells))]
    everything = [_foreseen(posterior, *other, grid_map) for other in others]
    written = write_predictions(options.out, everything, posterior.candidates)
    if options.held_out:
        say(loss_table(_losses(posterior, everything, grid_map)))
        say(_how_much(everything))
    else:
        say(cell_table(everything[0], posterior.candidates, grid_map))
    say(f"learnt from {convergence(summarise(posterior, grid_map))}")
    say(verdict(posterior.convergence, posterior.sampling))
    say(f"Written: {', '.join(str(file) for file in written)}")
    return told_of(damage)


def _cell(text: str) -> tuple[int, int]:
    """A cell `x,y` from the command line."""
    try:
        x, y = map(int, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be x,y, two whole numbers such as 3,1, not {text!r}"
        ) from None
    return x, y


def _foreseen(
    posterior: Posterior, source: str, demonstration: Demonstration, grid_map: GridMap
) -> Foreseen:
    from bnirl_ros.inference.prediction import predict
    from bnirl_ros.views.predictions import Foreseen

    try:
        return Foreseen(source, demonstration, predict(posterior, demonstration, grid_map))
    except InputError as error:
        raise InputError(f"{source or '--cell'}: {error}") from None


def _places_to_begin(posterior: Posterior, grid_map: GridMap) -> npt.NDArray[np.int64]:
    """(U, 2) the visited cells, or the free ones where these are candidates."""
    import numpy as np

    from bnirl_ros.inference.posterior import grid_world

    world = grid_world(grid_map, posterior.settings)
    visited = posterior.demonstration.cells, posterior.demonstration.last_cells
    states = np.unique(world.states_of(np.concatenate(visited)))
    if posterior.settings.candidates == "free":
        states = np.flatnonzero(world.free)
    # Cells without features may be in a part of the map that has no candidate.
    return world.cells_of(states[posterior.candidates.reachable_from(world, states)])


def _losses(
    posterior: Posterior, everything: Sequence[Foreseen], grid_map: GridMap
) -> dict[str, Losses]:
    """What each prediction loses at all that was held out, by its name."""
    import numpy as np

    from bnirl_ros.inference.posterior import grid_world
    from bnirl_ros.inference.prediction import predict_from_mode
    from bnirl_ros.inference.scoring import WITHOUT_MODEL, Losses, losses

    world = grid_world(grid_map, posterior.settings)
    lost: dict[str, list[Losses]] = {}
    for each in everything:
        other = each.demonstration
        foreseen = {
            "predictive": each.prediction.probability,
            "likeliest subgoal (19)": predict_from_mode(posterior, other, grid_map).probability,
        }
        for name, prediction in WITHOUT_MODEL.items():
            foreseen[name] = prediction(posterior.demonstration, other, world)
        for name, probability in foreseen.items():
            lost.setdefault(name, []).append(losses(probability, other, world))
    return {
        name: Losses(
            log=np.concatenate([part.log for part in parts]),
            zero_one=np.concatenate([part.zero_one for part in parts]),
        )
        for name, parts in lost.items()
    }


def _how_much(everything: Sequence[Foreseen]) -> str:
    """One line on what was held out."""
    actions = sum(len(each.demonstration) for each in everything)
    episodes = sum(int(each.demonstration.starts.sum()) for each in everything)
    return f"{actions} actions in {episodes} episodes held out; a blocked move counts as staying"
