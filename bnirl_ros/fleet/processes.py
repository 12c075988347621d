"""Workers on this machine: a process for each, of which any may die."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from threading import Thread, current_thread, main_thread

from bnirl_ros.fleet.work import Answer, Answers, Value, Work, attempt

_DIED_TWICE = (
    "the process that worked on it died twice, the second time with nothing beside it; it may "
    "need more memory than there is"
)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def in_processes(work: Work[Value], paths: Sequence[Path], processes: int) -> Answers[Value]:
    """Do the work with every demonstration, and yield its number and answer as soon as it is done.

    A demonstration whose process dies is tried again when all others are done, with the machine to
    itself: the process may have been killed for want of memory. Close the iterator to give up: it
    ends all processes at once.

    Args:
        work: what to do.
        paths: the files of the demonstrations.
        processes: how many work at the same time.
    """
    dead = []
    for number, answer in _in_processes(work, paths, range(len(paths)), processes):
        if answer:
            yield number, answer
        else:
            dead.append(number)
    for number, answer in _in_processes(work, paths, sorted(dead), 1):
        yield number, answer or Answer(error=f"{paths[number]}: {_DIED_TWICE}")


def _in_processes(
    work: Work[Value], paths: Sequence[Path], numbers: Iterable[int], processes: int
) -> Iterator[tuple[int, Answer[Value] | None]]:
    """The numbers with their answers, None where the process died.

    Each process has an executor of its own, for one that lost a process gives up all its work.
    """
    waiting = deque(numbers)
    idle: list[ProcessPoolExecutor] = [_worker() for _ in range(min(processes, len(waiting)))]
    running: dict[Future[Answer[Value]], tuple[int, ProcessPoolExecutor]] = {}
    others = set(multiprocessing.active_children())
    try:
        while waiting or running:
            with sparing_children():
                while idle and waiting:
                    future, worker = _submit(idle.pop(), work, paths[waiting[0]])
                    running[future] = waiting.popleft(), worker
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                number, worker = running.pop(future)
                try:
                    answer = future.result()
                except BrokenProcessPool:
                    answer, worker = None, _worker()
                idle.append(worker)
                yield number, answer
    except BaseException:
        for child in set(multiprocessing.active_children()) - others:
            child.terminate()
        raise
    finally:
        for worker in (*idle, *(worker for _, worker in running.values())):
            worker.shutdown(cancel_futures=True)


def _submit(
    worker: ProcessPoolExecutor, work: Work[Value], path: Path
) -> tuple[Future[Answer[Value]], ProcessPoolExecutor]:
    """What the worker will answer; or another worker, if that one died while it was idle."""
    try:
        return worker.submit(attempt, work, path), worker
    except BrokenProcessPool:
        return _submit(_worker(), work, path)


def _worker() -> ProcessPoolExecutor:
    # A process that was forked could inherit a lock from a thread that it does not have.
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _end_with_parent)


def _end_with_parent() -> None:
    """Let this process end when the one that started it does, even if that was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        os._exit(1)

    Thread(target=end, name="end with parent", daemon=True).start()


@contextmanager
def sparing_children() -> Iterator[None]:
    """Processes that are started meanwhile take no notice of Ctrl-C, which is for their parent.

    They would each write a traceback.
    """
    if current_thread() is not main_thread():  # only there handlers can be set
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
