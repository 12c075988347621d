"""Intent in a thread of its own, so that it is told at once, however long an inference takes."""

from __future__ import annotations

import time

from bnirl_ros.demonstrations.placement import place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.inference.intent import Intent, IntentFilter
from bnirl_ros.inference.worker import Worker

_PERIOD = 0.1  # [s] between two looks at the recorder, at the least


class BackgroundWatch(Worker):
    """Keeps the intent of a demonstrator up to date with a recorder."""

    def __init__(self, recorder: Recorder, episode_gap: float) -> None:
        """Start the thread; it waits for a filter."""
        super().__init__("watch", recorder, episode_gap)
        self._filter: IntentFilter | None = None
        self._intent: Intent | None = None
        self._stamp = 0
        self._thread.start()

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
            except Exception as error:
                self._remember(error)
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
                self._stamp = int(recording.pose_stamps[intent.pose - recording.forgotten[0]])
