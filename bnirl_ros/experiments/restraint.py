"""Limits for what is given bad input: it may neither take all memory nor for ever."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

PATIENCE = 60
"""Seconds after which reading a few hundred kilobytes counts as never ending."""

MEMORY = 2**29
"""Bytes by which the memory of the process that reads may grow."""


@contextmanager
def limited_memory() -> Iterator[Callable[[], int]]:
    """Memory beyond what is taken now and `MEMORY` is refused.

    Gives a function that tells how many bytes more than in the beginning were in use at most.
    """
    # From now on the most is counted anew, where the kernel does that.
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    begin = _in_use("VmRSS")
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, before[1]))
    try:
        yield lambda: max(0, _in_use("VmHWM") - begin)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _in_use(field: str) -> int:
    """Bytes of this process's memory, by the name of a field of /proc/self/status."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    (line,) = (each for each in lines if each.startswith(f"{field}:"))
    return int(line.split()[1]) * 1024


@contextmanager
def patience() -> Iterator[Callable[[], AbstractContextManager[None]]]:
    """Gives a context in which `PATIENCE` ends with a TimeoutError."""

    def stop(number: int, frame: object) -> None:
        raise TimeoutError(f"no end after {PATIENCE} s")

    @contextmanager
    def watched() -> Iterator[None]:
        signal.alarm(PATIENCE)
        try:
            yield
        finally:
            signal.alarm(0)

    before = signal.signal(signal.SIGALRM, stop)
    try:
        yield watched
    finally:
        signal.signal(signal.SIGALRM, before)
