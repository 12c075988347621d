"""Which action belongs to which pose: the only place where that is decided."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def pair_by_stamp(
    stamps: npt.NDArray[np.int64], others: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices into `stamps` (P,) and `others` (Q,) of the pairs with equal stamps.

    Where a stamp occurs several times, as when a bag is played in a loop, the first of one pairs
    with the first of the other, the second with the second, and so on. Each is used once at most.
    """
    if (np.diff(stamps) > 0).all() and (np.diff(others) > 0).all():  # as nearly always
        place = np.searchsorted(others, stamps)
        first = np.flatnonzero(place < len(others))
        first = first[others[place[first]] == stamps[first]]
        return first, place[first]
    stamp = np.concatenate([stamps, others])
    is_other = np.arange(len(stamp)) >= len(stamps)
    occurrence = np.concatenate([_occurrence(stamps), _occurrence(others)])
    order = np.lexsort((is_other, occurrence, stamp))
    before, after = order[:-1], order[1:]
    is_pair = (stamp[before] == stamp[after]) & (occurrence[before] == occurrence[after])
    first = np.argsort(before[is_pair])
    return before[is_pair][first], after[is_pair][first] - len(stamps)


def _occurrence(stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(P,) how many equal stamps come before each."""
    order = np.argsort(stamps, kind="stable")
    in_order = stamps[order]
    starts = np.searchsorted(in_order, in_order)
    occurrence = np.empty(len(stamps), dtype=np.int64)
    occurrence[order] = np.arange(len(stamps)) - starts
    return occurrence
