"""Sums of products in vector lanes, added in a fixed order.

The compiler keeps a sum's order, one product at a time, unless it is told that it may reorder; then the order hangs on
what else was compiled, and so would a result's last bits. Here the order is fixed, with vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

_LANES = 4
_VECTOR = ir.VectorType(ir.DoubleType(), _LANES)


def _sums_of_products(_typing: Any, a: Any, b: Any, size: Any) -> tuple[Any, Callable[..., Any]]:
    """The sums over k < size of a[i][k] b[j][k] for all i and, within, all j, as one tuple; for compiled code.

    Args:
        a, b: tuples of contiguous arrays of floats.
        size: not more than the arrays' lengths, which are not checked.

    Raises:
        TypingError: the arrays are not of contiguous floats.
    """
    for arrays in (a, b):
        if arrays.dtype != types.float64[::1]:
            raise TypingError(f"sums of products are over contiguous arrays of floats, got {arrays.dtype}")
    result = types.UniTuple(types.float64, len(a) * len(b))

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def addresses(of: Any, values: Any) -> list[Any]:
            arrays = (context.make_array(of.dtype)(context, builder, v) for v in cgutils.unpack_tuple(builder, values))
            return [array.data for array in arrays]

        def vectors(of: list[Any], k: Any) -> list[Any]:
            places = (builder.bitcast(builder.gep(address, [k]), _VECTOR.as_pointer()) for address in of)
            return [builder.load(place, align=8) for place in places]

        def numbers(of: list[Any], k: Any) -> list[Any]:
            return [builder.load(builder.gep(address, [k])) for address in of]

        def add(kind: Any, name: str, sums: list[Any], rows: list[Any], columns: list[Any]) -> None:
            multiply_add = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * 3), name)
            for sum_, (x, y) in zip(sums, ((x, y) for x in rows for y in columns), strict=True):
                builder.store(builder.call(multiply_add, [x, y, builder.load(sum_)]), sum_)

        first, second = (addresses(signature.args[n], arguments[n]) for n in range(2))
        size = arguments[2]
        zero, lanes = size.type(0), size.type(_LANES)
        whole = builder.and_(size, size.type(-_LANES))
        in_lanes = [cgutils.alloca_once_value(builder, _VECTOR(None)) for _ in range(len(result))]
        rest = [cgutils.alloca_once_value(builder, ir.DoubleType()(0.0)) for _ in range(len(result))]
        with cgutils.for_range_slice(builder, zero, whole, lanes) as (k, _):
            add(_VECTOR, f"llvm.fma.v{_LANES}f64", in_lanes, vectors(first, k), vectors(second, k))
        with cgutils.for_range_slice(builder, whole, size, size.type(1)) as (k, _):
            add(ir.DoubleType(), "llvm.fma.f64", rest, numbers(first, k), numbers(second, k))
        totals = []
        for vector, total in zip(map(builder.load, in_lanes), map(builder.load, rest), strict=True):
            for lane in range(_LANES):
                total = builder.fadd(total, builder.extract_element(vector, ir.IntType(32)(lane)))
            totals.append(total)
        return context.make_tuple(builder, result, totals)

    return result(a, b, types.intp), code


sums_of_products: Any = intrinsic(_sums_of_products)
