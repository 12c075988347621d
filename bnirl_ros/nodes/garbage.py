"""When Python looks for garbage: while no message waits for it."""

from __future__ import annotations

import gc

_QUIET = 3.0  # [s] without a message, after which nobody is held up
_LONGEST = 60.0  # [s] between two searches, however much comes


class GarbageSearch:
    """Looks for garbage once messages have come and nothing comes any more.

    Python's own search runs whenever some hundred objects are new and holds up all threads: for a
    tenth of a second where numba is loaded. It is for circles of objects alone, of which there
    are few; everything else is freed at once, as ever.
    """

    def __init__(self) -> None:
        """Nothing has come yet."""
        self._heard = 0
        self._is_due = self._has_kept = False
        self._heard_at = self._searched_at = 0.0

    @staticmethod
    def only_here() -> None:
        """Leave all searching, in the whole process, to objects of this class."""
        gc.disable()

    def keep_all(self) -> None:
        """Never again look through what there is at the first call, such as modules and kernels.

        That is most of what there will ever be: a search takes a few milliseconds from then on.
        """
        if not self._has_kept:
            gc.freeze()
            self._has_kept = True

    def look(self, heard: int, now: float) -> None:
        """Search if it is time to.

        Args:
            heard: how many messages have come so far.
            now: by a clock that is never set [s].
        """
        if heard != self._heard:
            self._heard, self._heard_at, self._is_due = heard, now, True
        is_quiet = self._is_due and now - self._heard_at > _QUIET
        if is_quiet or now - self._searched_at > _LONGEST:
            gc.collect()
            self._is_due, self._searched_at = False, now
