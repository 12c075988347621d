"""Small kernels that several samplers need.

For an argument that is a literal, or a variable that begins as one, numba compiles a kernel once
more, with all that it calls: numbers that are handed to large kernels are np.int64 from the start.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_AT_ONCE = 256  # of the exponentials: their intermediate results stay in the nearest cache
_LEAST_EXPONENT = -700.0
_LOG2_E = 1.4426950408889634
_LN_2_HIGH, _LN_2_LOW = (
    0.693147180369123816490,
    1.90821492927058770002e-10,
)  # of few bits; the rest
_ROUNDING = 6755399441055744.0  # 1.5 * 2^52
_EXPONENT_OF_ONE = np.int64(1023 << 52)


@njit(nogil=True, cache=True)
def categorical(weights, total, generator):  # type: ignore[no-untyped-def]
    """Index drawn with probability weights / total; never one of weight zero."""
    remaining = generator.random() * total
    last = 0
    for index in range(weights.shape[0]):
        if weights[index] > 0.0:
            last = index
            remaining -= weights[index]
            if remaining < 0.0:
                break
    return last


@njit(nogil=True, cache=True)
def number_in_order(labels, scratch):  # type: ignore[no-untyped-def]
    """Number labels (N,) below N from 0 in the order in which they first occur, in place.

    Negative ones stay as they are. `scratch` (N,) is overwritten.
    """
    scratch[:] = -1
    count = 0
    for index in range(labels.shape[0]):
        label = labels[index]
        if label >= 0:
            if scratch[label] < 0:
                scratch[label] = count
                count += 1
            labels[index] = scratch[label]


@njit(nogil=True, cache=True)
def count_draws(counts, subgoal_of, switched, sign):  # type: ignore[no-untyped-def]
    """Add the draws of a sequence to counts (G,), or with sign -1 take them out."""
    for index in range(subgoal_of.shape[0]):
        if switched[index]:
            counts[subgoal_of[index]] += sign


@njit(nogil=True, cache=True)
def row_sum(values):  # type: ignore[no-untyped-def]
    """The sum of values (M,), in an order that is the same on every machine.

    Eight sums side by side: one alone waits for each addition before the next, and leave to change
    the order would have it depend on the width of the machine's vectors.
    """
    count = values.shape[0]
    whole = count // 8 * 8
    a = b = c = d = e = f = g = h = 0.0
    for first in range(0, whole, 8):
        a += values[first]
        b += values[first + 1]
        c += values[first + 2]
        d += values[first + 3]
        e += values[first + 4]
        f += values[first + 5]
        g += values[first + 6]
        h += values[first + 7]
    total = ((a + e) + (c + g)) + ((b + f) + (d + h))
    for index in range(whole, count):
        total += values[index]
    return total


@njit(nogil=True, cache=True)
def exponentials(values, factor, result, scratch):  # type: ignore[no-untyped-def]
    """Fill result (M,) with exp(factor * values), where that is at most 1.

    Within a relative 1e-14; what would be below e^-700 is that. Every step is one that is taken
    for many values at once, which the library's exponential is not. `scratch` (M,) is overwritten.
    """
    bits = scratch.view(np.int64)
    for first in range(0, values.shape[0], _AT_ONCE):
        given, found = values[first : first + _AT_ONCE], result[first : first + _AT_ONCE]
        for index in range(given.shape[0]):
            exponent = factor * given[index]
            exponent = exponent if exponent > _LEAST_EXPONENT else _LEAST_EXPONENT
            found[index] = exponent
            # Adding so large a number rounds to a whole one, which its lowest bits then are.
            scratch[index] = exponent * _LOG2_E + _ROUNDING
        for index in range(given.shape[0]):
            whole = scratch[index] - _ROUNDING
            x = (found[index] - whole * _LN_2_HIGH) - whole * _LN_2_LOW  # |x| <= ln(2) / 2
            series = 1.0 / 39916800.0
            series = series * x + 1.0 / 3628800.0
            series = series * x + 1.0 / 362880.0
            series = series * x + 1.0 / 40320.0
            series = series * x + 1.0 / 5040.0
            series = series * x + 1.0 / 720.0
            series = series * x + 1.0 / 120.0
            series = series * x + 1.0 / 24.0
            series = series * x + 1.0 / 6.0
            series = series * x + 0.5
            series = series * x + 1.0
            found[index] = series * x + 1.0
        for index in range(given.shape[0]):
            bits[index] = (bits[index] << 52) + _EXPONENT_OF_ONE  # two to that power
        for index in range(given.shape[0]):
            found[index] *= scratch[index]
