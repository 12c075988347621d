"""A row of values for eight goals at once, in the lanes of one vector of the processor.

Numba makes vectors out of long loops. A loop over eight lanes it unrolls into single numbers, or
puts behind checks that take longer than the loop. So these two steps, and nothing else, are given
to the compiler as vectors, whatever the width of the processor's own. What they do is what the
two public functions say in plain numpy: these run where compilation is switched off, and the
compiled ones are tested against them.

Values are (rows * LANES,), and the neighbours of a row (rows, A - 1) uint32, four moves or eight.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

LANES = 8
"""Goals in a vector."""

LEAST = 1e-280
"""Smaller values are as good as none."""

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_ROWS = ir.VectorType(ir.IntType(64), LANES)
_INDEX = ir.IntType(32)
_INDICES = ir.VectorType(_INDEX, LANES)
_ALIGN = 8  # bytes: arrays of numpy begin anywhere


def relaxed_row(
    value: npt.NDArray[np.float64],
    neighbours: npt.NDArray[np.uint32],
    row: int,
    rows_of_goals: npt.NDArray[np.int64],
    law: Any,
    omega: float,
    wanted: float,
) -> bool:
    """Over-relax the values of a row by `omega`; returns whether any was not settled.

    That is one which differs from gamma max_a E[h] by more than its part `wanted`. In the lane of
    a goal that lies in this row it is 1.

    Args:
        value: changed in this row only.
        neighbours: rows of the neighbours.
        row: which it is.
        rows_of_goals: (LANES,) of each lane.
        law: a `bnirl_ros.mdp.band.Law`.
        omega, wanted: as above.
    """
    lanes = value.reshape(-1, LANES)
    old = lanes[row].copy()
    total = best = old
    for four in neighbours[row].reshape(-1, 4):
        a, b, c, d = lanes[four]
        total = total + ((a + b) + (c + d))
        best = np.maximum(best, np.maximum(np.maximum(a, b), np.maximum(c, d)))
    new = np.where(rows_of_goals == row, 1.0, law.other * total + law.chosen * best)
    lanes[row] = old + omega * (new - old)
    return bool((np.abs(new - old) > wanted * new + LEAST).any())


def raised_row(
    value: npt.NDArray[np.float64],
    neighbours: npt.NDArray[np.uint32],
    row: int,
    fades: tuple[float, ...],
) -> None:
    """Raise the values of a row to what its neighbours lend it, their own times `fades`."""
    lanes = value.reshape(-1, LANES)
    lent = np.array(fades)[:, np.newaxis] * lanes[neighbours[row]]
    lanes[row] = np.maximum(lanes[row], lent.max(axis=0))


class _Row:
    """Instructions on the vectors of a row and of its neighbours."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        value, neighbours, self._row = arguments[:3]
        self._build = builder
        self._value = context.make_array(signature.args[0])(context, builder, value).data
        self._table = context.make_array(signature.args[1])(context, builder, neighbours).data
        self.place = self._place_of(self._row)
        self.values = builder.load(self.place, align=_ALIGN)

    def neighbours(self, moves: int) -> list[Any]:
        """The values of so many neighbours."""
        build = self._build
        first = build.mul(self._row, ir.Constant(self._row.type, moves))
        vectors = []
        for move in range(moves):
            entry = build.gep(self._table, [build.add(first, ir.Constant(first.type, move))])
            place = self._place_of(build.zext(build.load(entry), first.type))
            vectors.append(build.load(place, align=_ALIGN))
        return vectors

    def put(self, vector: Any) -> None:
        """Make them the values of the row."""
        self._build.store(vector, self.place, align=_ALIGN)

    def larger(self, one: Any, other: Any) -> Any:
        """In each lane the larger of two."""
        return self._build.select(self._build.fcmp_ordered(">", one, other), one, other)

    def in_all_lanes(self, number: Any) -> Any:
        """The same number in each lane."""
        nothing = ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined)
        vector = self._build.insert_element(nothing, number, _INDEX(0))
        return self._build.shuffle_vector(vector, nothing, _INDICES([0] * LANES))

    def _place_of(self, row: Any) -> Any:
        lane = self._build.gep(self._value, [self._build.mul(row, ir.Constant(row.type, LANES))])
        return self._build.bitcast(lane, _VECTOR.as_pointer())


@intrinsic
def _relaxed_row(  # type: ignore[no-untyped-def]
    typingctx, value, neighbours, row, fades, rows_of_goals, chosen, other, omega, wanted, least
):
    signature = types.boolean(
        value, neighbours, types.uint64, fades, rows_of_goals, *(types.float64,) * 5
    )

    def instructions(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        of_row = _Row(context, build, signature, arguments)
        goals = context.make_array(signature.args[4])(context, build, arguments[4]).data
        goals = build.load(build.bitcast(goals, _ROWS.as_pointer()), align=_ALIGN)
        is_goal = build.icmp_signed("==", goals, of_row.in_all_lanes(arguments[2]))
        one = of_row.in_all_lanes(ir.Constant(ir.DoubleType(), 1.0))
        chosen, other, omega, wanted, least = map(of_row.in_all_lanes, arguments[5:])

        total = best = old = of_row.values
        near = of_row.neighbours(len(fades))
        for a, b, c, d in (near[i : i + 4] for i in range(0, len(near), 4)):
            total = build.fadd(total, build.fadd(build.fadd(a, b), build.fadd(c, d)))
            best = of_row.larger(best, of_row.larger(of_row.larger(a, b), of_row.larger(c, d)))
        new = build.fadd(build.fmul(other, total), build.fmul(chosen, best))
        new = build.select(is_goal, one, new)
        change = build.fsub(new, old)
        of_row.put(build.fadd(old, build.fmul(omega, change)))

        size = of_row.larger(change, build.fsub(old, new))
        enough = build.fadd(build.fmul(wanted, new), least)
        unsettled = build.bitcast(build.fcmp_ordered(">", size, enough), ir.IntType(LANES))
        return build.icmp_unsigned("!=", unsettled, ir.Constant(unsettled.type, 0))

    return signature, instructions


@intrinsic
def _raised_row(typingctx, value, neighbours, row, fades):  # type: ignore[no-untyped-def]
    signature = types.void(value, neighbours, types.uint64, fades)

    def instructions(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        of_row = _Row(context, build, signature, arguments)
        highest = of_row.values
        for move, near in enumerate(of_row.neighbours(len(fades))):
            fade = of_row.in_all_lanes(build.extract_value(arguments[3], move))
            highest = of_row.larger(build.fmul(fade, near), highest)
        of_row.put(highest)
        return context.get_dummy_value()

    return signature, instructions


def _are_rows(value: Any, neighbours: Any) -> bool:
    """Whether they are types of arrays whose rows lie one behind the other, as is taken above."""
    return bool(value.layout == "C" and neighbours.layout == "C")


@overload(relaxed_row)
def _relaxed_row_of_vectors(value, neighbours, row, rows_of_goals, law, omega, wanted):  # type: ignore[no-untyped-def]
    def relaxed(value, neighbours, row, rows_of_goals, law, omega, wanted):  # type: ignore[no-untyped-def]
        return _relaxed_row(
            value,
            neighbours,
            np.uint64(row),
            law.fades,
            rows_of_goals,
            law.chosen,
            law.other,
            omega,
            wanted,
            LEAST,
        )

    return relaxed if _are_rows(value, neighbours) and rows_of_goals.layout == "C" else None


@overload(raised_row)
def _raised_row_of_vectors(value, neighbours, row, fades):  # type: ignore[no-untyped-def]
    def raised(value, neighbours, row, fades):  # type: ignore[no-untyped-def]
        _raised_row(value, neighbours, np.uint64(row), fades)

    return raised if _are_rows(value, neighbours) else None
