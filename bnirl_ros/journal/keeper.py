"""Keeps what a node takes in while it takes it in, and gives it back after whatever ended it."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Event, Lock, Thread

from bnirl_ros.bags.demonstration import RecordedDemonstration
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.inference.checkpoint import Checkpoint, checkpoint_from
from bnirl_ros.journal.bag import Journal, open_journal

_CHECKPOINT = "checkpoint"  # the file's name, beside those of the journal


class Keeper:
    """Writes a recorder's poses and actions, maps, and the chains' state, in a thread of its own.

    The recorder gets what a journal holds whose process was cut off.

    Attributes:
        recovered: what that was; None where the journal is a new one.
        checkpoint: the chains' state that belongs to it, if there is one that can be used.
        warnings: sentences on what could not be recovered.
        error: why nothing can be written now, in a sentence; empty if all is written.
    """

    def __init__(self, folder: Path, recorder: Recorder, interval: float) -> None:
        """Recover, and begin to write.

        Args:
            folder: of the journals.
            recorder: whose messages are kept.
            interval: how long they wait at the most, unless the disk takes longer [s].

        Raises:
            InputError: nothing can be written there.
        """
        self.checkpoint: Checkpoint | None = None
        self.warnings: list[str] = []
        self.error = ""
        self._folder, self._recorder, self._interval = folder, recorder, interval
        self._map: bytes | None = None
        self._new_map: bytes | None = None
        self._lock = Lock()
        self._stop = Event()
        opened = open_journal(folder)
        if opened.damage:
            self.warnings.append(opened.damage)
        self._journal: Journal | None = opened.journal
        self.recovered: RecordedDemonstration | None = opened.recovered
        if opened.recovered:
            self._recover(opened.journal, opened.recovered)
        self._thread = Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    @property
    def journal(self) -> Path | None:
        """The bag that is written; None where there can be none."""
        return self._journal.folder if self._journal else None

    def map_arrived(self, data: bytes) -> None:
        """Keep a nav_msgs/OccupancyGrid in CDR, unless the next one comes at once."""
        self._map = self._new_map = data

    def keep_checkpoint(self, content: bytes) -> None:
        """Write the chains' state beside the journal: the new one or, if that fails, the old one.

        Raises:
            InputError: it cannot be written.
        """
        with self._lock:
            if self._journal:
                _replace(self._journal.folder / _CHECKPOINT, content)

    def begin_anew(self) -> None:
        """Finish the journal with all that came, and begin another one, with the same map."""
        with self._lock:
            self._finish()
            self._new_map = self._map
            self._write()

    def close(self) -> None:
        """Finish the journal with all that came."""
        self._stop.set()
        self._thread.join()
        with self._lock:
            self._finish()

    def _recover(self, journal: Journal, recovered: RecordedDemonstration) -> None:
        self._recorder.restore(recovered.recording)
        path = journal.folder / _CHECKPOINT
        try:
            if path.exists():
                self.checkpoint = checkpoint_from(path.read_bytes(), str(path))
        except OSError as fault:
            self.warnings.append(
                f"{path}: cannot be read ({fault.strerror}); the chains start anew"
            )
        except InputError as fault:
            self.warnings.append(str(fault))

    def _run(self) -> None:
        while not self._stop.wait(self._interval):
            with self._lock:
                self._write()

    def _write(self) -> None:
        """Have everything on the disk that came; where that fails, it goes with the next try."""
        try:
            if self._journal is None:
                self._journal = open_journal(self._folder, resume=False).journal
            map_data, self._new_map = self._new_map, None
            new = self._recorder.drain()
            if self.error or map_data or len(new.pose_stamps) or len(new.actions):
                self._journal.append(new, map_data)
            self.error = ""
        except Exception as fault:
            self.error = str(fault)

    def _finish(self) -> None:
        self._write()
        journal, self._journal = self._journal, None
        if journal is None:
            return
        try:
            journal.close()
            # Nobody goes on from a journal that was finished.
            (journal.folder / _CHECKPOINT).unlink(missing_ok=True)
        except (InputError, OSError) as fault:
            self.error = str(fault)


def _replace(path: Path, content: bytes) -> None:
    """Let a file have this content, which is on the disk, or its old one, whatever happens."""
    partial = path.with_name(f"{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as fault:
        partial.unlink(missing_ok=True)
        raise InputError(
            f"{path}: cannot be written ({fault.strerror}); make room there, or turn the journal "
            "off with the parameter journal"
        ) from fault
