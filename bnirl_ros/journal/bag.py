"""The journal: a demonstration bag that only grows, and that is read whatever cut it off."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

import numpy as np

from bnirl_ros.bags.demonstration import RecordedDemonstration, read_demonstration
from bnirl_ros.bags.qos import LATCHED, RELIABLE
from bnirl_ros.bags.reader import Bag
from bnirl_ros.bags.writer import BagPart, BagWriter
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.demonstrations.recording import Recording
from bnirl_ros.errors import InputError
from bnirl_ros.journal.messages import encoded_actions, encoded_poses

_NUMBERED = re.compile(r"(\d{4,})_[\w-]+")  # the name of a journal: clocks may go backward
_LONGEST = 60 * 10**9  # [ns] over which messages are spread that came since the last ones
_FINISHED = "metadata.yaml"  # makes a folder a bag: it comes last


@dataclass(frozen=True, eq=False)
class Opened:
    """A journal that is written from now on.

    Attributes:
        journal: that one.
        recovered: what it held already, if it was cut off; else None.
        damage: a sentence on what could not be read of that; empty for nothing.
    """

    journal: Journal
    recovered: RecordedDemonstration | None = None
    damage: str = ""


class Journal(BagWriter):
    """An append-only bag: what `append` was given is on the disk when it returns.

    Where it cannot be written it waits in memory for the next call. Each process writes a file of
    its own: what is on the disk already is never touched.

    Args:
        folder: the bag, held by this process alone.
        earlier: its files, of processes that have ended.
        lock: the folder, opened and locked; closed with the journal.
    """

    def __init__(self, folder: Path, earlier: tuple[BagPart, ...], lock: int) -> None:
        super().__init__(folder)
        self._earlier = earlier
        self._file_name = f"{folder.name}_{len(earlier)}.mcap"
        self._partial = folder / self._file_name  # is there while it is written
        self._lock = lock
        self._spool: _Spool
        self._time = max((part.span[1] for part in earlier if part.span), default=0)

    @property
    def folder(self) -> Path:
        """The bag."""
        return self._folder

    def open(self) -> None:
        """Begin this process's file, and have it on the disk.

        Raises:
            InputError: the folder cannot be written to.
        """
        try:
            self.__enter__()
            for name, type_name in TOPIC_TYPES.items():
                self.add_topic(f"/{name}", type_name, LATCHED if name == "map" else RELIABLE)
            self._sync()
            os.fsync(self._lock)  # so that the file has its name on the disk, too
        except (OSError, InputError):
            os.close(self._lock)
            raise

    def append(
        self, new: Recording, map_data: bytes | None = None, now: int | None = None
    ) -> None:
        """Add what was taken in since the last call, and have it on the disk.

        Args:
            new: poses and actions. Their log times lie evenly between the last call and now.
            map_data: a nav_msgs/OccupancyGrid in CDR that came meanwhile; None for none.
            now: the time [ns]; that of the machine by default.

        Raises:
            InputError: it could not be written; the next call writes it, too.
        """
        poses, actions = encoded_poses(new), encoded_actions(new)
        begin = self._time
        now = time.time_ns() if now is None else now
        # A clock that was put back must not change the order in which all this is read.
        self._time = end = max(now, begin + max(len(poses), len(actions)) + 1)
        begin = max(begin, end - _LONGEST)
        if map_data is not None:
            self.write_encoded("/map", map_data, begin + 1)
        for topic, messages in (("/pose", poses), ("/action", actions)):
            times = np.linspace(begin, end, len(messages) + 1).astype(np.int64)[1:]
            for data, log_time in zip(messages, times.tolist(), strict=True):
                self.write_encoded(topic, data, log_time)
        self._sync()

    def close(self) -> None:
        """Finish the bag. One without poses and actions is removed: there is nothing in it.

        Raises:
            InputError: it could not be finished; what is on the disk stays, to be recovered.
        """
        counts = {channel.name: channel.messages for channel in self._channels.values()}
        try:
            if self._earlier or counts["/pose"] or counts["/action"]:
                self._finish()
            else:
                self._partial.unlink()
                self._folder.rmdir()
        except OSError as fault:
            raise self._refusal(fault) from fault
        finally:
            self._spool.let_go()
            self._writer = None
            os.close(self._lock)

    def _sync(self) -> None:
        self._open_writer().flush()  # type: ignore[no-untyped-call]
        try:
            self._spool.sync()
        except OSError as fault:
            raise self._refusal(fault) from fault

    def _refusal(self, fault: OSError) -> InputError:
        return InputError(
            f"{self._folder}: the journal cannot be written ({fault.strerror}); make room there, "
            "or turn it off with the parameter journal"
        )

    def _open_file(self) -> IO[bytes]:
        self._spool = _Spool(self._partial)
        return cast("IO[bytes]", self._spool)


class _Spool:
    """What is still to be written of a file, in memory, and the file: it gets all, or nothing."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self._waiting = bytearray()
        self._size = 0  # of the file

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._size + len(self._waiting)

    def flush(self) -> None:
        """Nothing is written before `sync`."""

    def sync(self) -> None:
        """Have everything on the disk; where that fails the file is as it was before."""
        try:
            left = memoryview(self._waiting)
            while left:
                written = self._file.write(left)
                if not written:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                left = left[written:]
            os.fsync(self._file.fileno())
        except OSError:
            left.release()
            self._file.truncate(self._size)
            self._file.seek(self._size)
            raise
        left.release()
        self._size += len(self._waiting)
        self._waiting.clear()

    def close(self) -> None:
        self.sync()
        self._file.close()

    def let_go(self) -> None:
        """Close the file, be anything waiting or not."""
        self._file.close()


def open_journal(folder: Path, *, resume: bool = True) -> Opened:
    """The last journal in a folder, if its process was cut off; else a new one.

    Journals are numbered, and have the time of day in their name. One that another process writes
    is left alone.

    Args:
        folder: of the journals; made where it is not there.
        resume: whether one that was cut off is gone on with.

    Raises:
        InputError: nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        last = _last_journal(folder)
        if resume and last is not None and not (last / _FINISHED).exists():
            lock = _locked(last)
            if lock is not None:
                return _resumed(last, lock)
        return Opened(_new(folder, last))
    except OSError as fault:
        raise InputError(
            f"{folder}: no journal can be written there ({fault.strerror}); name another "
            "journal_folder, or turn the journal off with the parameter journal"
        ) from fault


def _last_journal(folder: Path) -> Path | None:
    found = {
        int(match[1]): path
        for path in folder.iterdir()
        if (match := _NUMBERED.fullmatch(path.name)) and path.is_dir()
    }
    return found[max(found)] if found else None


def _locked(folder: Path) -> int | None:
    """A folder's descriptor with a lock that ends with this process; None if another has one."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _new(folder: Path, last: Path | None) -> Journal:
    number = 1 if last is None else int(last.name.split("_")[0]) + 1
    while True:
        path = folder / time.strftime(f"{number:04}_%Y_%m_%d-%H_%M_%S")
        try:
            path.mkdir()
        except FileExistsError:
            number += 1  # another node has just begun one
            continue
        lock = _locked(path)
        assert lock is not None, "nobody else knows of it yet"
        journal = Journal(path, (), lock)
        journal.open()
        return journal


def _resumed(folder: Path, lock: int) -> Opened:
    files = sorted(folder.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
    parts = tuple(_part_of(file) for file in files)
    recovered, damage = None, ""
    if any(part.span for part in parts):
        try:
            recovered = read_demonstration(folder)
            damage = recovered.damage or ""
        except InputError as fault:  # it was cut off in the very first write, or lies in ruins
            damage = str(fault)
    journal = Journal(folder, parts, lock)
    journal.open()
    return Opened(journal, recovered, damage)


def _part_of(file: Path) -> BagPart:
    """What can be read of a file, of which there may be no more than its name."""
    try:
        bag = Bag(file)
    except InputError:
        return BagPart(file.name, {}, None)
    return BagPart(file.name, {topic.name: topic.messages for topic in bag.topics()}, bag.span)
