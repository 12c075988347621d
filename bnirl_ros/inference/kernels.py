"""Small kernels that several samplers need.

Two of them need what numba does not have: sums in vectors, since a sum that numba makes vectors of
has another order on every machine, and the bits of a number. These are intrinsics, and beside each
is what it does in plain Python.

For an argument that is a literal, or a variable that begins as one, numba compiles a kernel once
more, with all that it calls: numbers that are handed to large kernels are np.int64 from the start.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

_SUMS = 32  # side by side: four vectors of eight
_LEAST_EXPONENT = -700.0
_LOG2_E = 1.4426950408889634
_LN_2_HIGH, _LN_2_LOW = (
    0.693147180369123816490,
    1.90821492927058770002e-10,
)  # of few bits; the rest
_ROUNDING = 6755399441055744.0  # 1.5 * 2^52


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

    Thirty-two sums side by side: one alone waits for each addition before the next, and leave to
    change the order would have it depend on the width of the machine's vectors.
    """
    total = sum_of_blocks(values)
    rest = values[values.shape[0] // _SUMS * _SUMS :]
    a = b = c = d = 0.0
    whole = rest.shape[0] // 4 * 4
    for first in range(0, whole, 4):
        a += rest[first]
        b += rest[first + 1]
        c += rest[first + 2]
        d += rest[first + 3]
    total += (a + c) + (b + d)
    for index in range(whole, rest.shape[0]):
        total += rest[index]
    return total


@njit(nogil=True, cache=True)
def exponentials(values, factor, result):  # type: ignore[no-untyped-def]
    """Fill result (M,) with exp(factor * values), where that is at most 1.

    Within a relative 1e-14; what would be below e^-700 is that. Every step is one that is taken
    for many values at once, which the library's exponential is not.
    """
    for index in range(values.shape[0]):
        exponent = factor * values[index]
        exponent = exponent if exponent > _LEAST_EXPONENT else _LEAST_EXPONENT
        # Adding so large a number rounds to a whole one, which its lowest bits then are.
        rounded = exponent * _LOG2_E + _ROUNDING
        whole = rounded - _ROUNDING
        x = (exponent - whole * _LN_2_HIGH) - whole * _LN_2_LOW  # |x| <= ln(2) / 2
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
        result[index] = (series * x + 1.0) * two_to_the(rounded)


def sum_of_blocks(values: npt.NDArray[np.float64]) -> float:
    """The sum of values (M,) but for the last M % 32: of every 32nd one first, then of those."""
    lanes = np.zeros(_SUMS)
    for first in range(0, len(values) // _SUMS * _SUMS, _SUMS):
        lanes = lanes + values[first : first + _SUMS]
    while len(lanes) > 1:
        lanes = lanes[: len(lanes) // 2] + lanes[len(lanes) // 2 :]
    return float(lanes[0])


@intrinsic
def _sum_of_blocks(typingctx, values):  # type: ignore[no-untyped-def]
    signature = types.float64(values)
    vector = ir.VectorType(ir.DoubleType(), 8)

    def halved(build: Any, numbers: list[Any]) -> Any:
        while len(numbers) > 1:
            middle = len(numbers) // 2
            pairs = zip(numbers[:middle], numbers[middle:], strict=True)
            numbers = [build.fadd(one, other) for one, other in pairs]
        return numbers[0]

    def instructions(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, build, arguments[0])
        count = build.extract_value(array.shape, 0)
        size = ir.Constant(count.type, _SUMS)
        sums = [cgutils.alloca_once_value(build, ir.Constant(vector, [0.0] * 8)) for _ in range(4)]
        with cgutils.for_range(build, build.sdiv(count, size)) as loop:
            first = build.gep(array.data, [build.mul(loop.index, size)])
            first = build.bitcast(first, vector.as_pointer())
            for place, lanes in enumerate(sums):
                more = build.load(build.gep(first, [ir.Constant(count.type, place)]), align=8)
                build.store(build.fadd(build.load(lanes), more), lanes)
        lanes = halved(build, [build.load(each) for each in sums])
        places = [ir.Constant(ir.IntType(32), lane) for lane in range(8)]
        return halved(build, [build.extract_element(lanes, place) for place in places])

    return signature, instructions


@overload(sum_of_blocks)
def _sum_of_blocks_of_vectors(values):  # type: ignore[no-untyped-def]
    if values.layout == "C":  # one value behind the other
        return lambda values: _sum_of_blocks(values)
    return None


def two_to_the(rounded: float) -> float:
    """2^k for a whole number k, given as k + 1.5 * 2^52, whose lowest bits it is."""
    return math.ldexp(1.0, int(rounded - _ROUNDING))


@intrinsic
def _two_to_the(typingctx, rounded):  # type: ignore[no-untyped-def]
    signature = types.float64(types.float64)

    def instructions(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        bits = build.bitcast(arguments[0], ir.IntType(64))
        exponent = build.shl(bits, ir.Constant(bits.type, 52))
        exponent = build.add(exponent, ir.Constant(bits.type, 1023 << 52))
        return build.bitcast(exponent, ir.DoubleType())

    return signature, instructions


@overload(two_to_the)
def _two_to_the_by_its_bits(rounded):  # type: ignore[no-untyped-def]
    return lambda rounded: _two_to_the(rounded)
