"""A demonstration from whatever file, and its map: the same for one and for many."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bnirl_ros.bags.demonstration import read_demonstration
from bnirl_ros.bags.raw_demonstration import is_raw, read_raw_demonstration
from bnirl_ros.demonstrations.csv_file import read_csv
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.discretising import Discretising
from bnirl_ros.demonstrations.placement import EPISODE_GAP, place
from bnirl_ros.demonstrations.recording import Recording
from bnirl_ros.errors import InputError
from bnirl_ros.maps.grid_map import GridMap


@dataclass(frozen=True)
class Remark:
    """A sentence for the user on what was read, or a warning."""

    sentence: str
    is_warning: bool = True


Tell = Callable[[Remark], object]
"""Told of remarks as they come up."""


@dataclass(frozen=True, eq=False)
class Reading:
    """How demonstrations are read.

    Attributes:
        moves: 4 or 8: which actions there are.
        discretising: for bags of raw motion.
        episode_gap: longest time between two poses of one episode, in other bags [s].
        remappings: recorded topic by the contract's name.
        grid_map: wins over the bags' own; None takes theirs. A CSV file needs it.
        as_given: whether raw motion is put on that map itself, not on a planning map made of it.
    """

    moves: int = 8
    discretising: Discretising = field(default_factory=Discretising)
    episode_gap: float = EPISODE_GAP
    remappings: Mapping[str, str] = field(default_factory=dict)
    grid_map: GridMap | None = None
    as_given: bool = False


@dataclass(frozen=True, eq=False)
class Taken:
    """What a file tells of a demonstration, and the map that it is for.

    Attributes:
        path: the file.
        told: in metres; or in cells of the map, from a CSV file.
        grid_map: the map, with the opened cells.
        opened: cells (x, y) of it that are free only since the robot was in them.
        is_assumed: whether the map is open space that was taken for lack of any.
        episode_gap: longest time between two poses of one episode [s].
        left_out: what could not be used, counted by fault.
        damage: a sentence on where the file is damaged; None for a sound one.
    """

    path: Path
    told: Recording | Demonstration
    grid_map: GridMap
    opened: tuple[tuple[int, int], ...] = ()
    is_assumed: bool = False
    episode_gap: float = EPISODE_GAP
    left_out: Counter[str] = field(default_factory=Counter)
    damage: str | None = None


@dataclass(frozen=True, eq=False)
class Placed:
    """A demonstration on its map.

    Attributes:
        demonstration: at least one observation.
        grid_map: the map.
        left_out: what could not be used, counted by fault.
        damage: a sentence on where the file is damaged; None for a sound one.
    """

    demonstration: Demonstration
    grid_map: GridMap
    left_out: Counter[str]
    damage: str | None


def is_csv(path: Path) -> bool:
    return path.suffix.lower() == ".csv"


def take(path: Path, reading: Reading, tell: Tell) -> Taken:
    """Read a demonstration from a rosbag2 folder, an MCAP file or a CSV file.

    Raises:
        InputError: it cannot be read, or has no map.
    """
    given = reading.grid_map
    if is_csv(path):
        if given is None:
            raise InputError(f"{path}: a CSV file tells no map; give one with --map")
        return Taken(path, read_csv(path, given, reading.moves), given)
    discretising, remappings = reading.discretising, reading.remappings
    episode_gap, grid_map = reading.episode_gap, given
    if is_raw(path, discretising, remappings):
        recorded, words = read_raw_demonstration(
            path, discretising, given, reading.moves, remappings.get("map", "map")
        )
        tell(Remark(f"Discretised: {words}", is_warning=False))
        episode_gap = discretising.longest_silence
        if not reading.as_given:
            grid_map = recorded.grid_map
    else:
        recorded = read_demonstration(path, remappings)
        grid_map = given or recorded.grid_map
    for warning in recorded.warnings:
        tell(Remark(warning))
    if grid_map is None:
        reasons = "".join(f" ({fault})" for fault in recorded.faults if "map" in fault)
        raise InputError(f"{path}: has no map that can be used{reasons}; give one with --map")
    own = grid_map is recorded.grid_map
    return Taken(
        path=path,
        told=recorded.recording,
        grid_map=grid_map,
        opened=recorded.opened if own else (),
        is_assumed=own and recorded.map_is_assumed,
        episode_gap=episode_gap,
        left_out=recorded.faults,
        damage=recorded.damage,
    )


def put(taken: Taken, grid_map: GridMap, moves: int, tell: Tell) -> Placed:
    """The demonstration on a map, which for one from a CSV file has the cells of its own.

    Raises:
        InputError: nothing of it lies on the map.
    """
    left_out = taken.left_out
    if isinstance(taken.told, Demonstration):
        demonstration = taken.told
    else:
        placement = place(taken.told, grid_map, moves, taken.episode_gap)
        demonstration, left_out = placement.demonstration, left_out + placement.faults
    for fault, count in left_out.items():
        tell(Remark(f"{taken.path}: left out {count} x {fault}"))
    if len(demonstration) == 0:
        raise InputError(
            f"{taken.path}: {taken.damage or 'no pose and action of equal stamps lie on the map'}"
            "; check its topics, their frame and the map"
        )
    return Placed(demonstration, grid_map, left_out, taken.damage)


def read(path: Path, reading: Reading, tell: Tell) -> Placed:
    """A demonstration on the given map, or on its own.

    Raises:
        InputError: as `take` and `put`.
    """
    taken = take(path, reading, tell)
    return put(taken, taken.grid_map, reading.moves, tell)
