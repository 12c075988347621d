"""Many numbers below a bound: the distinct ones, and their order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def distinct(
    numbers: npt.NDArray[np.int64], bound: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """As `np.unique(numbers, return_inverse=True)`, in one pass, of numbers from 0 below a bound.

    Raises:
        IndexError: a number is not below the bound.
    """
    there = np.zeros(bound, dtype=np.bool_)
    there[numbers] = True
    found = np.flatnonzero(there)
    index = np.empty(bound, dtype=np.int64)
    index[found] = np.arange(len(found))
    return found, index[numbers]


def ascending(numbers: npt.NDArray[np.int64], bound: int) -> npt.NDArray[np.int64]:
    """As `np.argsort(numbers, kind="stable")`, of numbers from 0 below a bound.

    Numpy sorts those of two bytes by their digits, which takes a fifteenth of the time.
    """
    return np.argsort(numbers.astype(np.min_scalar_type(bound)), kind="stable")
