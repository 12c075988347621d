"""Threads that compute beside others that wait for something to happen."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar

_STEP_BACK = 10  # how much nicer than others those threads are that are to stand behind them

_behind_others: ContextVar[bool] = ContextVar("behind_others", default=False)


def compute_behind_others() -> None:
    """From now on, let the workers of this thread wait for whoever else wants a core.

    A core that computes is handed over only when its turn ends, milliseconds later. The calling
    thread itself goes on as before: it may hold what others wait for, the interpreter, longer than
    its workers do.
    """
    _behind_others.set(True)


def workers(tasks: int, threads: int | None = None) -> ThreadPoolExecutor:
    """Threads for so many tasks side by side: one for each, or `threads`, or one for each core."""
    count = max(1, min(tasks, threads or os.cpu_count() or 1))
    return ThreadPoolExecutor(count, initializer=_step_back if _behind_others.get() else None)


def _step_back() -> None:
    if sys.platform == "linux":  # elsewhere it is the whole process that would step back
        os.nice(_STEP_BACK)
