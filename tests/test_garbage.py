"""Garbage is looked for while nobody waits, and all the same in the end."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from bnirl_ros.nodes.garbage import GarbageSearch


class Circle:
    """Refers to itself, so that only a search finds it."""

    def __init__(self) -> None:
        self.own = self


@pytest.fixture
def search() -> Iterator[GarbageSearch]:
    """A search that nothing else anticipates."""
    made = GarbageSearch()
    made.look(0, 100.0)
    made.only_here()
    yield made
    gc.unfreeze()
    gc.enable()


def dropped() -> weakref.ref[Circle]:
    """An object that nobody can reach any more."""
    return weakref.ref(Circle())


def test_garbage_stays_while_messages_come_and_goes_in_the_first_rest(
    search: GarbageSearch,
) -> None:
    garbage = dropped()
    for second in range(20):
        search.look(1000 * second, 100.0 + second)
        assert garbage() is not None
    search.look(19_000, 119.0 + 4.0)
    assert garbage() is None


def test_a_rest_is_searched_once_until_something_comes(search: GarbageSearch) -> None:
    search.look(1, 101.0)
    search.look(1, 110.0)
    garbage = dropped()
    search.look(1, 120.0)
    assert garbage() is not None
    search.look(2, 121.0)
    search.look(2, 125.0)
    assert garbage() is None


def test_messages_without_end_do_not_keep_garbage_for_ever(search: GarbageSearch) -> None:
    garbage = dropped()
    for second in range(90):
        search.look(second, 100.0 + second)
    assert garbage() is None


def test_what_is_kept_is_not_looked_through_again(search: GarbageSearch) -> None:
    before = gc.get_freeze_count()
    search.keep_all()
    kept = gc.get_freeze_count()
    assert kept > before + 1000
    some = [Circle() for _ in range(10)]
    search.keep_all()
    assert gc.get_freeze_count() == kept
    assert len(some) == 10
