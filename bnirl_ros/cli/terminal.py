"""What is said on the way: warnings, and how far a thing is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bnirl_ros.terminal_text import plain, plain_lines


@contextmanager
def progress_bar(
    doing: str, total: int, before: str | None = None
) -> Iterator[Callable[[int], None] | None]:
    """A progress bar on a terminal's standard error; nothing elsewhere.

    Args:
        doing: what is done.
        total: in how many steps; whoever does it tells how many more are done. Where there turn
            out to be more, there are taken to be twice as many.
        before: what is done until the first ones are, if that is something else.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task(before or doing, total=None if before else total)

        def advance(steps: int) -> None:
            nonlocal total
            bar.update(task, description=doing, total=total, advance=steps)
            while bar.tasks[0].completed > total:
                total *= 2

        yield advance


def say(text: str) -> None:
    """Print lines in which names may be from anywhere, and do nothing to the terminal."""
    print(plain_lines(text), flush=True)


def warn(sentence: str) -> None:
    """Print a sentence on standard error, whatever names are in it."""
    print(plain(f"bnirl: {sentence}"), file=sys.stderr)
