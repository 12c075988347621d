"""A thread that works on what a recorder gets, so that whoever receives it never waits."""

from __future__ import annotations

from threading import Condition, Thread

from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.threads import compute_behind_others


class Worker:
    """What threads that work on a recorder have in common; what they do is in `_run`.

    All methods return at once. Whatever goes wrong in the thread is remembered and the next change
    tried again: it never ends before `close`.

    Attributes:
        error: what went wrong at the last try, in one sentence; empty if nothing did.
        last_error: what went wrong last, at whatever try.
    """

    def __init__(self, name: str, recorder: Recorder, episode_gap: float) -> None:
        """A thread that is still to be started, when all that it needs is there.

        Args:
            name: of the thread.
            recorder: on which it works.
            episode_gap: longest time between two poses of an episode [s].
        """
        self.error = self.last_error = ""
        self._recorder = recorder
        self._episode_gap = episode_gap
        self._changed = False
        self._closed = False
        self._at_work = False
        self._wake = Condition()
        self._thread = Thread(target=self._begin, name=name, daemon=True)

    def observations_arrived(self) -> None:
        """There is something new in the recorder."""
        if not self._changed:  # a plain look first: this is called for every message
            self._update(_changed=True)

    def close(self) -> None:
        """End the thread, as soon as what is under way is done."""
        self._update(_closed=True)
        self._thread.join()

    def _begin(self) -> None:
        compute_behind_others()
        self._run()

    def _run(self) -> None:
        raise NotImplementedError

    def _update(self, **values: object) -> None:
        with self._wake:
            vars(self).update(values)
            self._wake.notify()

    def _remember(self, error: Exception) -> None:
        """Tell of an error instead of ending: a thread that died would go unnoticed."""
        self.error = self.last_error = f"{type(error).__name__}: {error}"
