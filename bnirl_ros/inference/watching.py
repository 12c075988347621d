"""Intent in a thread of its own, so that it is told at once, however long an inference takes."""

from __future__ import annotations

import time
from threading import Condition, Thread

from bnirl_ros.demonstrations.placement import place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.inference.intent import Intent, IntentFilter

_PERIOD = 0.1  # [s] between two looks at the recorder, at the least


class BackgroundWatch:
    """Keeps the intent of a demonstrator up to date with a recorder, in a thread of its own.

    All methods return at once. Whatever goes wrong in the thread is remembered and the next change
    tried again: it never ends before `close`.

    Attributes:
        error: what went wrong at the last try, in one sentence; empty if nothing did.
        last_error: what went wrong last, at whatever try.
    """

    def __init__(self, recorder: Recorder, episode_gap: float) -> None:
        """Start the thread; it waits for a filter."""
        self.error = self.last_error = ""
        self._recorder = recorder
        self._episode_gap = episode_gap
        self._filter: IntentFilter | None = None
        self._changed = False
        self._at_work = False
        self._closed = False
        self._intent: Intent | None = None
        self._stamp = 0
        self._wake = Condition()
        self._thread = Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def observations_arrived(self) -> None:
        """There is something new in the recorder."""
        if not self._changed:  # a plain look first: this is called for every message
            self._update(_changed=True)

    def use(self, intent_filter: IntentFilter | None) -> None:
        """Tell the intent by this filter, which is the thread's from now on, or none any more."""
        self._update(_filter=intent_filter, _changed=True, _intent=None)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do, and all that is known was taken."""
        with self._wake:
            return not self._at_work and not self._has_work() and self._intent is None

    def take(self) -> tuple[Intent, int] | None:
        """The newest intent since the last call, if there is one, and its pose's stamp [ns]."""
        with self._wake:
            intent, self._intent = self._intent, None
            return None if intent is None else (intent, self._stamp)

    def close(self) -> None:
        """End the thread."""
        self._update(_closed=True)
        self._thread.join()

    def _update(self, **values: object) -> None:
        with self._wake:
            vars(self).update(values)
            self._wake.notify()

    def _has_work(self) -> bool:
        return self._changed and self._filter is not None

    def _run(self) -> None:
        while True:
            with self._wake:
                self._at_work = False
                self._wake.wait_for(lambda: self._closed or self._has_work())
                self._at_work = True
                if self._closed:
                    return
                self._changed = False
                intent_filter = self._filter
            assert intent_filter is not None
            begin = time.monotonic()
            try:
                self._tell(intent_filter)
                self.error = ""
            except Exception as error:  # a thread that died would go unnoticed
                self.error = self.last_error = f"{type(error).__name__}: {error}"
            with self._wake:
                self._at_work = False
                left = _PERIOD - (time.monotonic() - begin)
                self._wake.wait_for(lambda: self._closed, timeout=left)

    def _tell(self, intent_filter: IntentFilter) -> None:
        """Offer the intent by a filter, unless another one is to be used by now."""
        recording = self._recorder.snapshot()
        moves = intent_filter.settings.moves
        placement = place(recording, intent_filter.grid_map, moves, self._episode_gap)
        intent = intent_filter.intent(placement)
        with self._wake:
            if intent_filter is self._filter and intent is not None:
                self._intent = intent
                self._stamp = int(recording.pose_stamps[intent.pose])
