"""The player: every message in order and at its time, whatever is asked for in between."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest
from hypothesis import strategies as st

from bnirl_ros.bags.player import Player, Source
from bnirl_ros.bags.qos import LATCHED, RELIABLE
from bnirl_ros.bags.read_ahead import ReadAhead
from bnirl_ros.bags.several import Bags, bags_in, latched_at
from bnirl_ros.bags.topics import RawMessage
from bnirl_ros.bags.writer import BagWriter
from bnirl_ros.demonstrations.messages import TOPIC_TYPES
from bnirl_ros.errors import InputError
from demonstration_support import SECOND, START, map_of_grid, walk, write_bag

TYPE = "std_msgs/msg/String"


def message(time: float, topic: str = "/a") -> RawMessage:
    return RawMessage(topic, TYPE, round(time * SECOND), b"%d" % round(time * SECOND))


class Time:
    """A clock that goes on when it is told to [s]."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def player_of(
    messages: list[RawMessage], latched: tuple[RawMessage, ...] = (), **options: object
) -> tuple[Player, Time]:
    """A player that has begun, of messages in order; `latched` is what is sent first."""

    def since(time: int) -> Iterator[RawMessage]:
        yield from (each for each in messages if each.log_time >= time)

    clock = Time()
    source = Source(messages[0].log_time, since, lambda time: list(latched))
    player = Player(source, clock=clock, **options)
    player.start()
    return player, clock


def played(player: Player, clock: Time, until: float = math.inf) -> list[tuple[float, int]]:
    """When since now each message is due, and its log time, with a clock that waits for it."""
    begin, found = clock.now, []
    while not player.finished:
        wait = player.due_in()
        if clock.now + wait - begin > until:
            clock.now = begin + until
            break
        clock.now += wait
        each = player.take()
        assert each is not None
        found.append((round(clock.now - begin, 6), each.log_time))
    return found


def seconds(found: list[tuple[float, int]]) -> list[tuple[float, float]]:
    return [(at, time / SECOND) for at, time in found]


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_messages_come_at_their_times_over_the_rate(rate: float) -> None:
    times = [0.0, 0.5, 0.5, 2.0, 7.25]
    player, clock = player_of([message(time) for time in times], rate=rate)
    assert seconds(played(player, clock)) == [(time / rate, time) for time in times]
    assert (player.due_in(), player.take(), player.rounds) == (math.inf, None, 1)


def test_nothing_comes_before_its_time_and_what_is_late_comes_at_once() -> None:
    player, clock = player_of([message(time) for time in (0.0, 1.0, 2.0, 3.0)])
    assert player.take() == message(0.0)
    clock.now += 0.999
    assert player.take() is None
    clock.now += 1.501
    assert player.take() == message(1.0)
    assert player.take() == message(2.0)
    assert player.take() is None
    assert player.due_in() == pytest.approx(0.5)  # and the pace is kept


def test_as_fast_as_possible_everything_is_due_in_order() -> None:
    messages = [message(time) for time in (0.0, 5.0, 500.0)]
    player, clock = player_of(messages, rate=None)
    assert [player.take() for _ in messages] == messages
    assert clock.now == 1000.0
    assert player.finished


def test_time_stands_still_in_a_pause() -> None:
    player, clock = player_of([message(time) for time in (0.0, 1.0, 2.0)])
    assert player.take() == message(0.0)
    clock.now += 0.25
    player.pause()
    clock.now += 100.0
    assert player.position == 0.25 * SECOND
    assert (player.due_in(), player.take()) == (math.inf, None)
    player.resume()
    assert seconds(played(player, clock)) == [(0.75, 1.0), (1.75, 2.0)]


def test_messages_are_played_one_by_one_in_a_pause_only() -> None:
    player, clock = player_of([message(time) for time in (0.0, 1.0, 3.0)], paused=True)
    assert player.play_next() == message(0.0)
    assert player.play_next() == message(1.0)
    assert player.position == SECOND
    player.resume()
    assert player.play_next() is None
    assert seconds(played(player, clock)) == [(2.0, 3.0)]


def test_the_pace_changes_from_where_we_are() -> None:
    player, clock = player_of([message(time) for time in (0.0, 4.0, 8.0)])
    player.take()
    clock.now += 2.0
    player.set_rate(4.0)
    assert player.position == 2 * SECOND
    assert seconds(played(player, clock)) == [(0.5, 4.0), (1.5, 8.0)]


def test_seeking_goes_both_ways_and_sends_what_was_latched() -> None:
    kept = message(0.5, "/map")
    player, clock = player_of(
        [message(time) for time in (0.0, 1.0, 2.0, 3.0)], latched=(kept,), paused=True
    )
    assert player.take() == kept  # also in a pause
    player.seek(round(2.5 * SECOND))
    assert player.take() == kept
    assert player.position == 2.5 * SECOND
    player.resume()
    assert seconds(played(player, clock)) == [(0.5, 3.0)]
    player.seek(0)
    assert not player.finished
    assert player.take() == kept
    assert seconds(played(player, clock))[0] == (0.0, 0.0)


def test_what_was_sent_early_is_not_sent_again() -> None:
    later = message(0.5, "/map")
    messages = [message(0.0), later, message(1.0), message(2.0, "/map")]
    player, clock = player_of(messages, latched=(later,))
    expected = [(0.0, 0.5), (0.0, 0.0), (1.0, 1.0), (2.0, 2.0)]
    assert seconds(played(player, clock)) == expected


def test_a_loop_begins_again_at_once() -> None:
    kept = message(0.0, "/map")
    player, clock = player_of([kept, message(1.0), message(3.0)], latched=(kept,), loop=True)
    found = seconds(played(player, clock, until=7.0))
    assert found == [
        *[(0.0, 0.0), (1.0, 1.0), (3.0, 3.0)],
        *[(3.0, 0.0), (4.0, 1.0), (6.0, 3.0)],
        *[(6.0, 0.0), (7.0, 1.0)],
    ]
    assert player.rounds == 2
    assert player.position == SECOND


def test_long_silences_are_cut() -> None:
    player, clock = player_of(
        [message(time) for time in (0.0, 1.0, 5000.0, 5001.0)], longest_silence=2.0
    )
    assert seconds(played(player, clock)) == [(0.0, 0.0), (1.0, 1.0), (3.0, 5000.0), (4.0, 5001.0)]


ORDERS = st.one_of(
    st.tuples(st.just("wait"), st.floats(0.0, 5.0)),
    st.tuples(st.sampled_from(["pause", "resume"]), st.none()),
    st.tuples(st.just("set_rate"), st.floats(0.1, 10.0)),
)


@hypothesis.given(
    times=st.lists(st.integers(0, 20), min_size=1, max_size=30).map(sorted),
    orders=st.lists(ORDERS, max_size=20),
)
def test_whatever_is_asked_all_come_in_order_and_none_too_soon(
    times: list[int], orders: list[tuple[str, float | None]]
) -> None:
    player, clock = player_of([message(time) for time in times])
    passed, paused, rate, found = float(times[0]), False, 1.0, []

    def take_all() -> None:
        while (each := player.take()) is not None:
            assert each.log_time / SECOND <= passed + 1e-6
            found.append(each.log_time / SECOND)

    for order, value in orders:
        if order == "wait":
            clock.now += value
            passed += 0.0 if paused else value * rate
            before = player.position
            take_all()
            assert player.position >= before
        elif order == "set_rate":
            player.set_rate(value)
            rate = value
        else:
            getattr(player, order)()
            paused = order == "pause"
        if order == "wait" and not paused:  # all that is past has come
            assert len(found) >= sum(time < passed - 1e-6 for time in times)
    player.resume()
    found += [time for _, time in seconds(played(player, clock))]
    assert found == times


# Reading ahead


def test_reading_ahead_changes_nothing() -> None:
    messages = [message(number, topic="/" + "a" * (number % 7 + 1)) for number in range(5000)]
    assert list(ReadAhead(iter(messages), limit=1000)) == messages
    assert list(ReadAhead(iter([]))) == []


def test_no_more_is_read_ahead_than_is_allowed() -> None:
    read = 0

    def endless() -> Iterator[RawMessage]:
        nonlocal read
        while True:
            read += 1
            yield RawMessage("/a", TYPE, read, bytes(10_000))

    ahead = ReadAhead(endless(), limit=500_000)
    for number in range(1, 200):
        assert next(ahead).log_time == number
        assert read < number + 80
    ahead.close()
    assert list(ahead) == []


def test_an_error_comes_after_what_was_read_before_it() -> None:
    def failing() -> Iterator[RawMessage]:
        yield message(1.0)
        raise InputError("bag: is gone")

    ahead = ReadAhead(failing())
    with pytest.raises(InputError, match="bag: is gone"):
        list(ahead)


# Several bags


def test_bags_are_read_as_one_in_order_of_time(tmp_path: Path) -> None:
    bags = [
        write_bag(tmp_path / "all" / "third", walk(start=START + 500 * SECOND)),
        write_bag(tmp_path / "all" / "day" / "first", [map_of_grid(), *walk()]),
        write_bag(tmp_path / "all" / "day" / "second", walk(start=START + 2 * SECOND)),
    ]
    assert bags_in(tmp_path / "all") == sorted(bags)
    assert bags_in(bags[0]) == [bags[0]]
    for paths in ([tmp_path / "all"], bags):
        several = Bags(paths)
        assert len(several) == 3
        times = [each.log_time for each in several.messages()]
        assert times == sorted(times)
        assert len(times) == 3 * len(walk()) + 1
        assert several.span == (times[0], times[-1])
        assert {topic.name: topic.messages for topic in several.topics()} == {
            "/map": 1,
            "/pose": 75,
            "/action": 72,
        }
        some = [time for time in times if START + 3 * SECOND <= time <= START + 501 * SECOND]
        since, until = START + 3 * SECOND, START + 501 * SECOND
        assert [each.log_time for each in several.messages(None, since, until)] == some
    with pytest.raises(InputError, match="none: does not exist"):
        Bags([bags[0], tmp_path / "none"])


@pytest.fixture
def latching(tmp_path: Path) -> Callable[..., list[int]]:
    """The times [s] of what is latched in a bag at a time."""
    with BagWriter(tmp_path / "bag") as writer:
        for topic, qos in (("/map", LATCHED), ("/tf_static", LATCHED), ("/pose", RELIABLE)):
            writer.add_topic(topic, TOPIC_TYPES["map" if qos is LATCHED else "pose"], qos)
        for second in range(10):
            writer.write_encoded("/pose", b"pose", second * SECOND)
        for topic, second in (("/map", 1), ("/map", 4), ("/tf_static", 2), ("/tf_static", 3)):
            writer.write_encoded(topic, b"%d" % second, second * SECOND)

    def at(second: int, early: int = 0) -> list[int]:
        depths = {"/map": 1, "/tf_static": 5}
        found = latched_at(Bags([tmp_path / "bag"]), depths, second * SECOND, early * SECOND)
        return [each.log_time // SECOND for each in found]

    return at


def test_the_last_latched_messages_are_found(latching: Callable[..., list[int]]) -> None:
    assert latching(9) == [2, 3, 4]
    assert latching(4) == [1, 2, 3]  # the one of that time comes by itself
    assert latching(2) == [1]
    assert latching(0) == []
    assert latching(0, early=2) == [1, 2]
    assert latching(2, early=9) == [1, 2, 3]
