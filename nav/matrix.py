"""Products of small matrices for kernels, eight columns at a time in the processor's vector registers.

The compiler makes vectors of loops over long arrays, but none of those over the fifteen columns of a covariance, so
that the innermost loop is written here in the language of the compiler (LLVM). Each element is summed one term after
the other, as written: the result does not depend on how wide the registers are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nav._jit import inlined
from nav.samples import Array

# isort: split
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

LANES = 8  # columns of a product that are summed at a time, so that it must have as many
_REAL, _LANE = ir.DoubleType(), ir.IntType(32)
_VECTOR = ir.VectorType(_REAL, LANES)


@inlined
def multiply(out: Array, A: Array, B: Array, first: int, stop: int, C: Array, D: Array, columns: int) -> None:
    """Fill the first ``columns`` of ``out`` (r, columns or wider) with those of A[:, first:stop] B[first:stop] + C' D.

    ``A`` (r, stop or wider), ``B`` (stop or longer, columns or wider), ``C`` (k, r or wider), ``D`` (k, columns or
    wider), columns at least `LANES`; either product may be empty, and ``out`` is none of the factors.
    """
    if columns < LANES:
        raise ValueError("a product must have eight columns")
    rows, terms = len(out), len(C)
    for block in range((columns + LANES - 1) // LANES):
        column = min(LANES * block, columns - LANES)  # the last columns may be found twice, to the same bits
        for third in range((rows + 2) // 3):
            i = 3 * third
            j, k = min(i + 1, rows - 1), min(i + 2, rows - 1)
            _tile(out, i, j, k, column, None, A, B, first, stop, C, D, terms)  # type: ignore[call-arg]


@inlined
def add_symmetric(P: Array, C: Array, D: Array) -> None:
    """Add C' D to ``P`` (n, n) in place, ``C`` and ``D`` (k, n), where ``P`` and the sum are symmetric.

    What is above the diagonal is found, and copied to below; the sums begin with P and go on one term after the other.
    """
    n, terms = len(P), len(C)
    blocks = n // LANES
    narrow = n - LANES * blocks  # columns left of the first block
    for i in range(narrow):
        for j in range(i, narrow):
            for k in range(terms):
                P[i, j] += C[k, i] * D[k, j]
    for third in range((n + 2) // 3 if blocks else 0):
        i = 3 * third
        j, k = min(i + 1, n - 1), min(i + 2, n - 1)
        # from the one that holds the diagonal; what it changes left of that is overwritten below
        for block in range(max(0, (i - narrow) // LANES), blocks):
            _tile(P, i, j, k, narrow + LANES * block, P, C, D, 0, 0, C, D, terms)  # type: ignore[call-arg]
    for i in range(n):
        for j in range(i):
            P[i, j] = P[j, i]


def _at(context: Any, builder: Any, kind: types.Array, array: Any) -> Callable[[Any, Any, Any], Any]:
    """The address of an element of ``array``, for reading and writing a ``target`` there."""
    struct = context.make_array(kind)(context, builder, array)
    stride = cgutils.unpack_tuple(builder, struct.strides, 2)[0]  # type: ignore[no-untyped-call]

    def address(row: Any, column: Any, target: Any) -> Any:
        offset = builder.add(builder.mul(row, stride), builder.mul(column, ir.Constant(column.type, 8)))
        start = builder.bitcast(struct.data, ir.IntType(8).as_pointer())
        return builder.bitcast(builder.gep(start, [offset]), target.as_pointer())

    return address


@intrinsic
def _tile(
    typing: Any, out: Any, i: Any, j: Any, k: Any, column: Any, base: Any, A: Any, B: Any, first: Any, stop: Any,
    C: Any, D: Any, terms: Any,
) -> Any:  # fmt: skip
    """Rows i, j and k of `multiply`, `LANES` columns from ``column`` on; to those of ``base``, if it is one, added."""
    begins = not isinstance(base, types.NoneType)
    for array in (out, A, B, C, D, *([base] if begins else [])):
        if array.ndim != 2 or array.dtype != types.float64 or array.layout == "F":
            raise TypingError(f"a factor or product must have rows of float64, not be {array}")
    signature = types.void(out, i, j, k, column, base, A, B, first, stop, C, D, terms)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = {at: _at(context, builder, signature.args[at], values[at]) for at in (0, 6, 7, 10, 11)}
        rows, column = values[1:4], values[4]
        nothing, first_lane = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(ir.VectorType(_LANE, LANES), [0] * LANES)
        nought = ir.Constant(_VECTOR, [0.0] * LANES)
        sums = [cgutils.alloca_once(builder, _VECTOR) for _ in rows]  # type: ignore[no-untyped-call]
        start = _at(context, builder, signature.args[5], values[5]) if begins else None
        for row, total in zip(rows, sums, strict=True):
            builder.store(builder.load(start(row, column, _VECTOR), align=8) if start else nought, total)

        def add(start: Any, end: Any, left: Callable[[Any, Any], Any], right: Callable[[Any, Any, Any], Any]) -> None:
            step = ir.Constant(start.type, 1)
            with cgutils.for_range_slice(builder, start, end, step, intp=start.type) as (term, _):
                lanes = builder.load(right(term, column, _VECTOR), align=8)
                for row, total in zip(rows, sums, strict=True):
                    one = builder.insert_element(nothing, builder.load(left(row, term)), ir.Constant(_LANE, 0))
                    all_ = builder.shuffle_vector(one, nothing, first_lane)
                    builder.store(builder.fadd(builder.load(total), builder.fmul(all_, lanes)), total)

        add(values[8], values[9], lambda row, term: arrays[6](row, term, _REAL), arrays[7])
        zero = ir.Constant(values[12].type, 0)
        add(zero, values[12], lambda row, term: arrays[10](term, row, _REAL), arrays[11])
        for row, total in zip(rows, sums, strict=True):
            builder.store(builder.load(total), arrays[0](row, column, _VECTOR), align=8)
        return context.get_dummy_value()

    return signature, generate
