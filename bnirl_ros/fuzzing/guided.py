"""Bad input for one door, led by what code it reaches: a process of its own for libFuzzer.

`python -m bnirl_ros.fuzzing.guided DOOR SECONDS FOLDER`. The fuzzer looks at which
branches of the package an input takes, and changes further those that took new ones. Input that
ends in a fault is left in the folder, and the status is not 0 then.
"""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

_WITH_KERNELS = ("checkpoint", "journal")  # doors for which good input takes an inference
_MEMORY = 2500  # [MB] of the process, numba and all
_LONGEST = 20  # [s] for one input
_SIZE = 20_000  # bytes of an input


@dataclass(frozen=True)
class Guided:
    """What became of it.

    Attributes:
        door: its name.
        tried: how many inputs were.
        reached: branches that they took, good input included.
        fault: what the fuzzer says of the first fault; empty for none.
    """

    door: str
    tried: int
    reached: int
    fault: str


def guided(door: str, seconds: int, folder: Path) -> Guided:
    """Let the fuzzer try a door for so long, in a process of its own.

    Args:
        door: its name.
        seconds: for how long, good input and imports not included.
        folder: where input is left that ends in a fault.
    """
    words = [sys.executable, "-m", __name__, door, str(seconds), str(folder)]
    ended = subprocess.run(words, capture_output=True, text=True, errors="replace")
    tried = re.findall(r"stat::number_of_executed_units: (\d+)", ended.stderr)
    reached = re.findall(r" ft: (\d+)", ended.stderr)
    fault = "" if ended.returncode == 0 else _what(ended.stderr)
    return Guided(door, int((tried or [0])[-1]), int((reached or [0])[-1]), fault)


def _what(said: str) -> str:
    """What the fuzzer says of a fault: the exception, or what it ended for."""
    lines = said.splitlines()
    told = [line for line in lines if "ERROR:" in line or re.match(r"\w*(Error|Warning)\b", line)]
    return "; ".join(told[:3]) or "\n".join(lines[-5:])


def main(door_name: str, seconds: str, folder: str) -> None:
    """Run libFuzzer, which ends the process."""
    import atheris

    if door_name in _WITH_KERNELS:
        # Numba cannot compile what was instrumented.
        importlib.import_module("bnirl_ros.inference.running")
    with atheris.instrument_imports(include=["bnirl_ros", "rosbags"]):
        from bnirl_ros.experiments.restraint import patience
        from bnirl_ros.fuzzing.campaign import entered
        from bnirl_ros.fuzzing.doors import door_called
        from bnirl_ros.fuzzing.mutation import mutated
    import random

    door = door_called(door_name)
    Path(folder).mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as work, TemporaryDirectory() as corpus, patience() as watched:
        for number, seed in enumerate(door.seeds):
            Path(corpus, f"seed{number}").write_bytes(seed)

        def try_one(data: bytes) -> None:
            what = entered(door, data, Path(work), watched)
            if what not in ("accepted", "refused"):
                raise RuntimeError(what)

        def change(data: bytes, most: int, seed: int) -> bytes:
            """Half of the time by ours, which knows numbers and words."""
            generator = random.Random(seed)
            if generator.random() < 0.5:
                return mutated(data, door.seeds, generator)[:most]
            return bytes(atheris.Mutate(data, most))

        options = {
            "max_total_time": seconds,
            "rss_limit_mb": _MEMORY,
            "timeout": _LONGEST,
            "max_len": _SIZE,
            "print_final_stats": 1,
            "seed": 1,
            "artifact_prefix": f"{folder}/{door_name.replace(' ', '_')}_",
        }
        words = [f"-{name}={value}" for name, value in options.items()]
        atheris.Setup([sys.argv[0], *words, corpus], try_one, custom_mutator=change)
        atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
