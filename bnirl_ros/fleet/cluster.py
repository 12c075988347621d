"""Workers on a Dask cluster: its scheduler decides who does what, and what is done again."""

from __future__ import annotations

import logging
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bnirl_ros import __version__
from bnirl_ros.errors import InputError
from bnirl_ros.fleet.work import Answer, Answers, Value, Work, attempt

_TIMEOUT = 10.0
"""How long the scheduler has to answer [s]."""


def on_cluster(work: Work[Value], paths: Sequence[Path], address: str) -> Answers[Value]:
    """Do the work with every demonstration, and yield its number and answer as soon as it is done.

    A demonstration whose worker dies is given to another one, as often as the cluster's own
    configuration allows. Close the iterator to give up: what has not begun is not begun then.

    Args:
        work: what to do.
        paths: the files of the demonstrations, which every worker is to find there.
        address: of the scheduler, such as tcp://192.168.1.7:8786.

    Raises:
        InputError: dask.distributed is not installed; no scheduler answers, or it is gone before
            all is done; or the workers lack this package, or have another version of it.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise InputError(
            "--scheduler: needs dask.distributed, which is not installed; "
            "pip install 'bnirl_ros[dask]'"
        ) from None
    # That a worker's results are lost with it and made again is no news for who waits for them.
    logging.getLogger("distributed.client").setLevel(logging.ERROR)
    try:
        client = Client(address, timeout=_TIMEOUT)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}); name the address "
            "that it tells when it starts, such as tcp://192.168.1.7:8786"
        ) from None
    with client:
        # A task of its own: sent once, not with every demonstration, and made again when lost.
        shared = client.submit(_same, work, pure=False)
        number_of = {
            client.submit(attempt_there, shared, str(path), __version__, pure=False): number
            for number, path in enumerate(paths)
        }
        for future in as_completed(number_of):
            if future.status in ("cancelled", "lost"):
                raise InputError(
                    f"--scheduler {address}: the scheduler is gone; start it, and this, again"
                )
            number = number_of.pop(future)
            yield number, _answer_of(future, paths[number], address)


def _answer_of(future: Any, path: Path, address: str) -> Answer[Value]:
    """What became of a demonstration, by the future that is done."""
    error = future.exception()
    if error is None:
        answer: Answer[Value] = future.result()
        return answer
    if isinstance(error, (ImportError, OtherVersionError)):
        raise InputError(
            f"--scheduler {address}: a worker cannot do it ({error}); install bnirl_ros "
            f"{__version__} where the workers run"
        )
    words = str(error).splitlines()[0] if str(error) else ""
    return Answer(error=f"{path}: {type(error).__name__}: {words}")


class OtherVersionError(Exception):
    """A worker has another version of this package, which may give other numbers."""


def _same(work: Work[Value]) -> Work[Value]:
    return work


def attempt_there(work: Work[Value], name: str, version: str) -> Answer[Value]:
    """What becomes of a demonstration, in a worker of the cluster."""
    if version != __version__:
        raise OtherVersionError(f"it has bnirl_ros {__version__}, not {version}")
    path = Path(name)
    if not path.exists():
        return Answer(
            error=f"{path}: the worker on {socket.gethostname()} finds nothing there; put it "
            "where all workers of the cluster see it at the same path"
        )
    return attempt(work, path)
