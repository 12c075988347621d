"""What is pursued now: against a filter of the whole episode, and in the thread that watches."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.demonstrations.messages import take_action, take_pose
from bnirl_ros.demonstrations.placement import EPISODE_GAP, Placement, place
from bnirl_ros.demonstrations.recording import Recorder
from bnirl_ros.errors import InputError
from bnirl_ros.inference import intent, watching
from bnirl_ros.inference.filtering import filtered, foreseen, middle_of_draws
from bnirl_ros.inference.intent import Intent, IntentFilter
from bnirl_ros.inference.posterior import Posterior, infer, pursuit_model_of
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Summary, summarise
from bnirl_ros.inference.watching import BackgroundWatch
from bnirl_ros.maps import parse_text_grid
from bnirl_ros.mdp.actions import ACTION_NAMES
from demonstration_support import (
    CORNERS,
    MAP,
    SECOND,
    START,
    TopicMessage,
    action_of,
    pose_at,
    walk,
)

ROUND = 49
"""Messages of a round of `walk`: 24 poses and actions, and the last pose."""

TAKE = {"pose": take_pose, "action": take_action}


def recorded(messages: Iterable[TopicMessage], recorder: Recorder | None = None) -> Recorder:
    recorder = recorder or Recorder()
    for name, message, _ in messages:
        assert TAKE[name](recorder, message) is None
    return recorder


def placed(messages: Iterable[TopicMessage]) -> Placement:
    return place(recorded(messages).snapshot(), MAP)


@cache
def learnt(**settings: Any) -> tuple[Posterior, Summary]:
    """Of three rounds."""
    quick = Settings(**{"chains": 2, "sweeps": 300, "burn_in": 100, **settings})
    posterior = infer(placed(walk(rounds=3)).demonstration, MAP, quick)
    return posterior, summarise(posterior, MAP)


def intent_filter(**settings: Any) -> IntentFilter:
    return IntentFilter(*learnt(**settings), MAP)


def by_hand(
    placement: Placement, settings: Mapping[str, Any]
) -> tuple[npt.NDArray[np.float64], tuple[int, int]]:
    """Probability of each subgoal by rank, and the cell, by a filter of all episodes at once."""
    posterior, summary = learnt(**settings)
    weights, parameters = middle_of_draws(posterior)
    whole = placement.demonstration
    cell, now = whole.cells[-1], filtered
    if whole.episode[-1] in whole.last_episode:
        # As if an action had been chosen at the last pose, before it is seen.
        cell, now = whole.last_cells[-1], lambda *of: (foreseen(*of),)  # type: ignore[assignment]
        whole = Demonstration(
            np.append(whole.episode, whole.episode[-1]),
            np.append(whole.cells, [cell], axis=0),
            np.append(whole.action, 0),
            whole.last_episode[:0],
            whole.last_cells[:0],
        )
    model = pursuit_model_of(whole, posterior.candidates, MAP, posterior.settings)
    belief = now(model, weights, parameters)[0][-1]
    radius = settings.get("arrival_radius", 0.0)
    taken: set[int] = set()
    masses = []
    for subgoal in summary.subgoals:
        apart = np.hypot(*(posterior.candidates.coordinates - subgoal.cell).T)
        near = {int(index) for index in np.flatnonzero(apart <= radius)} - taken
        taken |= near
        masses.append(belief[list(near)].sum())
    return np.array(masses), (int(cell[0]), int(cell[1]))


@pytest.mark.parametrize("settings", [{}, {"arrival_radius": 1.0}], ids=str)
def test_the_intent_is_what_a_filter_of_the_whole_tells(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(intent, "_AT_ONCE", 5)
    messages = walk(rounds=5)[3 * ROUND :]
    growing = intent_filter(**settings)
    for end in (1, 2, 3, 4, 21, 24, 25, 26, 40, ROUND, ROUND + 1, ROUND + 9, 2 * ROUND):
        placement = placed(messages[:end])
        told = growing.intent(placement)
        if end == 1:
            assert told is None  # a pose alone is no observation
            continue
        assert told is not None
        expected, cell = by_hand(placement, settings)
        np.testing.assert_allclose(told.probability, expected, rtol=1e-9, atol=1e-15)
        assert told.another == pytest.approx(1.0 - expected.sum(), abs=1e-12)
        assert told.cell == cell
        seen = messages[:end]
        if end == ROUND + 1:  # the next episode's first pose is no observation yet
            seen = messages[:ROUND]
        assert told.pose == sum(name == "pose" for name, _, _ in seen) - 1


def rank_of(cell: tuple[int, int]) -> int:
    return next(each.rank for each in learnt()[1].subgoals if each.cell == cell)


def told_after(count: int) -> Intent:
    """The intent after so many messages of a fourth round."""
    told = intent_filter().intent(placed(walk(rounds=4)[: 3 * ROUND + count]))
    assert told is not None
    return told


def test_on_arrival_the_next_subgoal_is_pursued() -> None:
    assert {each.cell for each in learnt()[1].subgoals} == set(CORNERS)
    # 6 steps lead to each corner; the first leads away from others.
    for side, corner in enumerate(CORNERS[1:]):
        rank = rank_of(corner)
        first, last = told_after(12 * side + 4), told_after(12 * side + 12)
        for told in (first, last):
            assert told.current is not None
            assert told.current.cell == corner
        assert last.probability[rank - 1] >= first.probability[rank - 1] > 0.5
        # The pose at the corner comes, and no action yet: it may be any of them from now on.
        arrived = told_after(12 * side + 13)
        assert arrived.cell == corner
        assert arrived.probability[rank - 1] < 0.5
        (following,) = {CORNERS[(side + 2) % 4]}
        gained = arrived.probability - last.probability
        assert gained[rank_of(following) - 1] > 0.0


def test_an_action_that_comes_late_is_taken_in_where_it_belongs() -> None:
    messages = walk(rounds=4)
    late = messages[: 3 * ROUND + 20]
    action = late.pop(3 * ROUND + 9)
    growing = intent_filter()
    assert growing.intent(placed(late)) is not None
    told = growing.intent(placed([*late, action]))
    assert told is not None
    np.testing.assert_allclose(told.probability, told_after(20).probability, rtol=1e-9)


def test_only_the_sequential_model_knows_what_is_pursued() -> None:
    with pytest.raises(InputError, match="only the sequential model"):
        intent_filter(model="paper")


def test_where_no_candidate_can_be_reached_nothing_is_told_until_one_can() -> None:
    rooms = parse_text_grid("...#.\n...#.\n...#.\n", "two rooms")
    east = ACTION_NAMES.index("E")

    def seen(cells: list[tuple[int, int]], first_pose: int = 0) -> Placement:
        none = np.zeros(0, dtype=np.int64)
        walked = Demonstration(
            np.zeros(len(cells), dtype=np.int64),
            np.array(cells),
            np.full(len(cells), east),
            none,
            none.reshape(0, 2),
        )
        return Placement(walked, first_pose + np.arange(len(cells)), none, 0, Counter())

    here = seen([(0, 0), (1, 0)])
    posterior = infer(here.demonstration, rooms, Settings(chains=1, sweeps=30, burn_in=10))
    growing = IntentFilter(posterior, summarise(posterior, rooms), rooms)
    first = growing.intent(here)
    assert growing.intent(seen([(4, 0), (4, 1)], first_pose=2)) is None
    again = growing.intent(here)
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first.probability, again.probability)


# The thread


@pytest.fixture
def watch() -> Iterator[Callable[[Recorder], BackgroundWatch]]:
    made: list[BackgroundWatch] = []

    def make(recorder: Recorder) -> BackgroundWatch:
        made.append(BackgroundWatch(recorder, EPISODE_GAP))
        return made[-1]

    yield make
    for each in made:
        each.close()


def until(happened: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + 60
    while not (value := happened()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return value


def test_the_thread_tells_of_every_change(
    watch: Callable[[Recorder], BackgroundWatch],
) -> None:
    messages = walk(rounds=4)
    recorder = recorded(messages[: 3 * ROUND + 10])
    watcher = watch(recorder)
    watcher.observations_arrived()  # there is nothing to tell it by
    assert watcher.idle
    assert watcher.take() is None
    watcher.use(intent_filter())
    assert not watcher.idle
    told, stamp = until(watcher.take)
    np.testing.assert_allclose(told.probability, told_after(10).probability)
    assert stamp == messages[3 * ROUND + 9][2]
    until(lambda: watcher.idle)
    recorded(messages[3 * ROUND + 10 : 3 * ROUND + 30], recorder)
    watcher.observations_arrived()
    told, stamp = until(watcher.take)
    np.testing.assert_allclose(told.probability, told_after(30).probability, rtol=1e-9)
    assert stamp == messages[3 * ROUND + 29][2]
    watcher.use(None)
    recorded([pose_at(0.5, 0.5, START), action_of(1.0, 0.0, START)], recorder)
    watcher.observations_arrived()
    assert watcher.idle
    assert watcher.take() is None


def test_the_thread_survives_what_goes_wrong(
    watch: Callable[[Recorder], BackgroundWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("out of luck")

    watcher = watch(recorded(walk(rounds=4)))
    with monkeypatch.context() as patch:
        patch.setattr(watching, "place", broken)
        watcher.use(intent_filter())
        until(lambda: watcher.error == "RuntimeError: out of luck")
    watcher.observations_arrived()
    _, stamp = until(watcher.take)
    assert stamp == START + 300 * SECOND + 12 * SECOND
    assert not watcher.error
    assert watcher.last_error
