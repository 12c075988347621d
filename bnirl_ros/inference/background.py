"""Inference in a thread of its own, so that whoever receives observations never waits for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from threading import Event

from bnirl_ros.demonstrations.placement import Placement, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.inference.chains import StoppedError
from bnirl_ros.inference.checkpoint import Checkpoint
from bnirl_ros.inference.intent import IntentFilter
from bnirl_ros.inference.posterior import Posterior, infer
from bnirl_ros.inference.running import RunningPosterior
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Summary, summarise
from bnirl_ros.inference.worker import Worker
from bnirl_ros.maps.grid_map import GridMap

# Sweeping time [s] between two results: soon for the first one after a change, then longer, so
# that the time is spent on sweeps.
_FIRST_ROUND = 0.1
_ROUND = 1.0
_CHECKPOINT_PERIOD = 10.0  # [s] at the least between two checkpoints
_CHECKPOINT_SHARE = 50  # of the time that one takes, if that is longer
_DRAWS = 4  # of each chain, between two looks at whether something has changed


@dataclass(frozen=True, eq=False)
class Result:
    """A result of the background inference.

    Attributes:
        grid_map: the map on which it was found.
        placement: the observations that it is about, and what did not fit.
        summary: what the posterior says; None while there is no observation.
        sweeps: sweeps of each chain.
        intent_filter: tells from now on what is pursued; None while there is no observation, and
            for a model that knows no order.
        posterior, settings: of an inference that was asked for; None for a running result.
    """

    grid_map: GridMap
    placement: Placement
    summary: Summary | None
    sweeps: int
    intent_filter: IntentFilter | None = None
    posterior: Posterior | None = None
    settings: Settings | None = None


class BackgroundInference(Worker):
    """Keeps a posterior up to date with a recorder."""

    def __init__(
        self,
        recorder: Recorder,
        settings: Settings,
        episode_gap: float,
        checkpoint: Checkpoint | None = None,
        keep: Callable[[bytes], None] | None = None,
    ) -> None:
        """Start the thread; it waits for a map and observations.

        Args:
            recorder: what to infer from.
            settings: of the inference.
            episode_gap: longest time between two poses of an episode [s].
            checkpoint: from which the chains are to go on.
            keep: called in the thread, now and then, with the bytes of a checkpoint.
        """
        super().__init__("inference", recorder, episode_gap)
        self._checkpoint, self._keep = checkpoint, keep
        self._keep_at = 0.0  # [s]
        self._settings = settings
        self._grid_map: GridMap | None = None
        self._paused = False
        self._requests: list[tuple[Future[Result], Callable[[Result], None] | None]] = []
        self._result: Result | None = None
        self._running: RunningPosterior | None = None
        self._watching: IntentFilter | None = None  # of the last result
        self._stands = False  # the last result was asked for, and nothing has changed since
        self._forget = False
        self._resets = 0
        self._stop = Event()
        self._thread.start()

    def use_map(self, grid_map: GridMap) -> None:
        """Put all observations on this map from now on; the same again changes nothing."""
        if self._grid_map and grid_map.is_same_as(self._grid_map):
            return
        self._update(_grid_map=grid_map, _changed=True)

    def use_settings(self, settings: Settings) -> None:
        """Go on with these settings."""
        self._update(_settings=settings, _changed=True)

    def pause(self, paused: bool) -> None:
        """Let running inference rest, or go on; inferences asked for are made all the same."""
        self._update(_paused=paused)

    @property
    def paused(self) -> bool:
        """Whether running inference rests."""
        return self._paused

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do, and all that was done can be taken."""
        with self._wake:
            return not self._at_work and not self._has_work()

    def reset(self) -> None:
        """Forget the chains and any result not yet taken; the recorder was cleared."""
        self._update(
            _forget=True,
            _changed=True,
            _result=None,
            _resets=self._resets + 1,
            _checkpoint=None,
        )

    def infer(self, finish: Callable[[Result], None] | None = None) -> Future[Result]:
        """Ask for an inference with fresh chains over all observations so far.

        The future gets the result, or the exception that says why there is none (an `InputError`
        for a user's mistake); it is cancelled when this is closed before.

        Args:
            finish: called with the result, in the thread, before the future gets it.
        """
        request: Future[Result] = Future()
        with self._wake:
            self._requests.append((request, finish))
            self._wake.notify()
        return request

    def take_result(self) -> Result | None:
        """The newest result since the last call, if there is one."""
        with self._wake:
            result, self._result = self._result, None
        return result

    def close(self) -> None:
        """End the thread, as soon as the sweeps under way are done."""
        self._stop.set()
        super().close()

    def _has_work(self) -> bool:
        changed = self._changed and self._grid_map is not None
        unfinished = self._running is not None and not self._running.finished
        running = changed or (unfinished and not self._stands)
        return bool(self._closed or self._requests or (running and not self._paused))

    def _run(self) -> None:
        while True:
            with self._wake:
                self._at_work = False
                self._wake.wait_for(self._has_work)
                self._at_work = True
                resets = self._resets
                if self._closed:
                    for waiting, _ in self._requests:
                        waiting.cancel()
                    return
                request, finish = self._requests.pop(0) if self._requests else (None, None)
            try:
                if request:
                    self._answer(request, finish, resets)
                else:
                    self._publish(self._next_running_result(), resets)
                self.error = ""
            except Exception as error:
                self._remember(error)
                self._running = None
                if request and not request.done():
                    request.set_exception(error)

    def _publish(self, result: Result, resets: int) -> None:
        """Offer a result, unless what it is about was forgotten meanwhile."""
        with self._wake:
            if resets == self._resets:
                self._result = result

    def _place(self) -> tuple[Placement, GridMap, Settings]:
        """What was recorded, on the present map."""
        with self._wake:
            self._changed = self._stands = False
            grid_map, settings = self._grid_map, self._settings
            if self._forget:
                self._running, self._forget = None, False
        if grid_map is None:
            raise InputError("there is no map yet; publish one, latched, on the topic map")
        recording = self._recorder.snapshot()
        return place(recording, grid_map, settings.moves, self._episode_gap), grid_map, settings

    def _answer(
        self,
        request: Future[Result],
        finish: Callable[[Result], None] | None,
        resets: int,
    ) -> None:
        """Infer with fresh chains."""
        try:
            placement, grid_map, settings = self._place()
            posterior = infer(placement.demonstration, grid_map, settings, stop=self._stop)
        except InputError as error:
            self._changed = True  # what is new was taken note of, but not taken in
            self.last_error = str(error)
            request.set_exception(error)
            return
        except StoppedError:
            request.cancel()
            return
        result = replace(
            self._result_of(posterior, grid_map, placement),
            posterior=posterior,
            settings=settings,
        )
        self._stands = True
        self._publish(replace(result, posterior=None), resets)
        try:
            if finish:
                finish(result)
        except InputError as error:
            self.last_error = str(error)
            request.set_exception(error)
        else:
            request.set_result(result)

    def _next_running_result(self) -> Result:
        """Take in what is new, and go on for a round."""
        if self._changed or self._running is None:
            placement, grid_map, settings = self._place()
            if len(placement.demonstration) == 0:
                self._running = None
                return Result(grid_map, placement, None, 0)
            before = self._running or self._resumed(grid_map, settings)
            self._running = RunningPosterior(placement, grid_map, settings, before)
            # At once, but for chains that would never get to sweep if all goes on changing.
            if self._running.ready and before and before.sweeps:
                return self._running_result()
        running = self._running
        if not running.sweeps:
            running.prepare()
        end = time.monotonic() + (_ROUND if running.sweeps else _FIRST_ROUND)
        while True:
            running.advance(_DRAWS)
            if self._changed or running.finished or running.full or time.monotonic() > end:
                break
        self._keep_if_due(running)
        return self._running_result()

    def _resumed(self, grid_map: GridMap, settings: Settings) -> RunningPosterior | None:
        """The chains of the checkpoint, if there is one; it is used once."""
        checkpoint, self._checkpoint = self._checkpoint, None
        try:
            return RunningPosterior.resumed(checkpoint, grid_map, settings) if checkpoint else None
        except InputError as error:
            self.last_error = str(error)
            return None

    def _keep_if_due(self, running: RunningPosterior) -> None:
        """Have a checkpoint kept: of chains that are done, and every few seconds of others."""
        begin = time.monotonic()
        if self._keep is None or (begin < self._keep_at and not running.finished):
            return
        try:
            self._keep(running.checkpoint().to_bytes())
        except InputError as error:
            self.last_error = str(error)
        end = time.monotonic()
        self._keep_at = end + max(_CHECKPOINT_PERIOD, _CHECKPOINT_SHARE * (end - begin))

    def _running_result(self) -> Result:
        running = self._running
        assert running is not None
        return self._result_of(running.posterior(), running.grid_map, running.placement)

    def _result_of(self, posterior: Posterior, grid_map: GridMap, placement: Placement) -> Result:
        """What a posterior says, and what tells the intent by it."""
        summary = summarise(posterior, grid_map)
        watching = None
        if posterior.settings.model == "sequential":
            watching = IntentFilter(posterior, summary, grid_map, self._watching)
        self._watching = watching
        sweeps = posterior.sampling.sweeps
        return Result(grid_map, placement, summary, sweeps, watching)
