"""What the tests of the command share: to run it, and to look at what it wrote."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bnirl_ros

QUICK = ("--sweeps", "60", "--burn-in", "20")
FILES = ["posterior.npz", "subgoals.json", "subgoals.png"]


@dataclass(frozen=True)
class Ended:
    """How a command ended, and what it said."""

    status: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """Those on standard error."""
        return self.err.splitlines()


Command = Callable[..., Ended]


def in_process(*arguments: str | Path, cwd: Path | None = None) -> subprocess.Popen[str]:
    """The command in a process of its own, not waited for."""
    return subprocess.Popen(
        [sys.executable, "-m", "bnirl_ros.cli", *map(str, arguments)],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(bnirl_ros.__file__).parents[1])},
    )


def ended(process: subprocess.Popen[str]) -> Ended:
    try:
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    return Ended(process.returncode, out, err)


def document_in(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "subgoals.json").read_text(encoding="utf-8"))


def arrays_in(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "posterior.npz", allow_pickle=False) as archive:
        return dict(archive)


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of the results that are the same for the same posterior."""
    return {name: (folder / name).read_bytes() for name in FILES[:2]}


def assert_refused(end: Ended, *words: str) -> None:
    """Status 1, nothing on standard output, and one line that says all of the words."""
    assert end.status == 1, end
    assert end.out == ""
    assert len(end.lines) == 1, end.err
    assert end.err.startswith("bnirl: ")
    for word in words:
        assert word in end.err
