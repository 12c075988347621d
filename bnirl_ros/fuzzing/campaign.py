"""Bad input for one door after the other, and an account of what became of it."""

from __future__ import annotations

import random
import shutil
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from bnirl_ros.errors import InputError
from bnirl_ros.experiments.restraint import limited_memory, patience
from bnirl_ros.fuzzing.doors import Door, door_called
from bnirl_ros.fuzzing.mutation import mutated


@dataclass(frozen=True)
class Fault:
    """What must not happen, with the input for which it does.

    Attributes:
        data: the input.
        what: happens.
    """

    data: bytes
    what: str


@dataclass(frozen=True)
class Account:
    """What became of the input for a door.

    Attributes:
        door: its name.
        accepted, refused: how many inputs were.
        faults: those for which something else happened.
        slowest: the longest that one took [s].
        memory: by which the process grew at most [bytes].
    """

    door: str
    accepted: int
    refused: int
    faults: tuple[Fault, ...]
    slowest: float
    memory: int

    @property
    def tried(self) -> int:
        """How many inputs there were."""
        return self.accepted + self.refused + len(self.faults)


def entered(
    door: Door, data: bytes, folder: Path, watched: Callable[[], AbstractContextManager[None]]
) -> str:
    """What becomes of input: "accepted", "refused", or what must not happen.

    Args:
        door: that it comes to.
        data: the input.
        folder: an empty one, which is empty again afterwards.
        watched: a context that ends what takes too long.
    """
    try:
        with watched(), warnings.catch_warnings():
            # What numpy warns of, such as an overflow, users would see.
            warnings.simplefilter("error", RuntimeWarning)
            door.enter(data, folder)
    except InputError as refusal:
        return "refused" if str(refusal).strip() else "refused without a word"
    except Exception as fault:  # whatever it is, the campaign is to tell of it
        where = traceback.extract_tb(fault.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        return f"{type(fault).__name__} at {place}: {str(fault)[:200]}"
    finally:
        for each in folder.iterdir():
            shutil.rmtree(each) if each.is_dir() else each.unlink()
    return "accepted"


def campaign_of(name: str, inputs: int, seed: int) -> Account:
    """The campaign of the door with this name."""
    return campaign(door_called(name), inputs, seed)


def campaign(door: Door, inputs: int, seed: int = 0, most_faults: int = 20) -> Account:
    """Change good input in so many ways, and let it in.

    What was accepted may be changed further. Equal arguments try the same inputs.

    Args:
        door: to be tried.
        inputs: how many.
        seed: of the random changes.
        most_faults: after which it ends.
    """
    generator = random.Random(f"{seed} {door.name}")
    pool, faults = list(door.seeds), list[Fault]()
    counts = {"accepted": 0, "refused": 0}
    slowest = 0.0
    with TemporaryDirectory() as name, limited_memory() as grown, patience() as watched:
        folder = Path(name)
        for seed_input in door.seeds:
            what = entered(door, seed_input, folder, watched)
            if what != "accepted":
                faults.append(Fault(seed_input, f"good input: {what}"))
        while sum(counts.values()) + len(faults) < inputs and len(faults) < most_faults:
            data = mutated(generator.choice(pool), door.seeds, generator)
            begin = time.monotonic()
            what = entered(door, data, folder, watched)
            slowest = max(slowest, time.monotonic() - begin)
            if what not in counts:
                faults.append(Fault(data, what))
                continue
            counts[what] += 1
            if what == "accepted" and len(data) < 100_000 and generator.random() < 0.1:
                pool[len(door.seeds) :] = [*pool[len(door.seeds) :], data][-50:]
        memory = grown()
    return Account(
        door.name, counts["accepted"], counts["refused"], tuple(faults), slowest, memory
    )
