"""LLVM code for operations that numba lacks: prefetching, and weighted sums of stored rows in vector registers.

Rows are float32, int8, or float16 stored as uint16 bits. The processor converts float16 if it can (F16C, every 64-bit
ARM). Otherwise integer arithmetic does: shifting the bits of a float16 to their place in a float32 leaves a factor of
2^112, also for subnormal numbers. A table of all float16 values is slower than either.
"""

import platform
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic as _numbas
from numpy.typing import NDArray

# Libraries without type annotations.
untyped: Any = cgutils
several: Any = types.UniTuple
_FLOAT, _HALF, _BYTE = ir.FloatType(), ir.HalfType(), ir.IntType(8)
_DOUBLE = ir.DoubleType()
_SHORT, _INT, _LONG = ir.IntType(16), ir.IntType(32), ir.IntType(64)
_FUSED = ("contract",)
WIDEST = 16
"""Vector width for rows of at least that many numbers. The width is 4 for rows of at least 4, otherwise 1."""
_DECODED_ROWS = 4
_EIGHT = 8
_EIGHT_DOUBLES = ir.VectorType(_DOUBLE, _EIGHT)


def intrinsic(generator: Any) -> Any:
    """numba's decorator, which has no type annotations."""
    return _numbas(generator)


def width_for(size: int) -> int:
    """Vector width for rows of `size` numbers."""
    return WIDEST if size >= WIDEST else 4 if size >= 4 else 1


def laid_out(light: NDArray[np.floating]) -> NDArray[np.float32]:
    """The light [size,3] in the order in which kernels read rows: [runs,3,width], a run being one vector of a row.

    The last run ends with the row. Numbers that it shares with the run before have weight 0 in it.
    """
    numbers = np.zeros(light.size + 1, np.float32)
    numbers[:-1] = light.reshape(-1)
    return numbers[_layout(len(light))]


@cache
def _layout(size: int) -> NDArray[np.int64]:
    """Index into the flat light of each number of `laid_out`; 3·size for a 0."""
    width = width_for(size)
    runs = np.full((-(-size // width), 3, width), 3 * size)
    for run in range(len(runs)):
        first = min(run * width, size - width)
        new = run * width - first
        for channel in range(3):
            runs[run, channel, new:] = 3 * np.arange(first + new, first + width) + channel
    return runs


@intrinsic
def fetch_ahead(context: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of array[index]; the array is flat and contiguous. Any index is harmless."""

    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = builder.bitcast(pointer_to(target, builder, signature, arguments, 0, arguments[1]), _BYTE.as_pointer())
        form = ir.FunctionType(ir.VoidType(), [_BYTE.as_pointer(), _INT, _INT, _INT])
        hint = builder.module.declare_intrinsic("llvm.prefetch", [_BYTE.as_pointer()], form)
        # For reading, into all cache levels, as data.
        builder.call(hint, [place, _INT(0), _INT(3), _INT(1)])
        return target.get_dummy_value()

    return types.void(array, types.intp), generate


def _lit_rows(width: int) -> Any:
    def lit_rows(
        context: Any, rows: Any, size: Any, a: Any, b: Any, c: Any, d: Any, of_a: Any, of_b: Any, of_c: Any, of_d: Any,
        light: Any,
    ) -> Any:  # fmt: skip
        """(red, green, blue) of Σ weight · row under the light; rows of `size` numbers start at a, b, c and d."""

        def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            starts = [pointer_to(target, builder, signature, arguments, 0, start) for start in arguments[2:6]]
            weights = [broadcast(builder, weight, width) for weight in arguments[6:10]]

            def weighted(offset: Any) -> Any:
                return _weighted(builder, rows.dtype, [builder.gep(start, [offset]) for start in starts], weights)

            return _under_light(target, builder, signature, arguments[1], arguments[10], weighted, width)

        places, shares = [types.intp] * 5, [types.float32] * 4
        return several(types.float32, 3)(rows, *places, *shares, light), generate

    return intrinsic(lit_rows)


lit_rows_by_16, lit_rows_by_4, lit_rows_by_1 = (_lit_rows(width) for width in (16, 4, 1))


def _lit_row(width: int) -> Any:
    def lit_row(context: Any, row: Any, size: Any, start: Any, light: Any) -> Any:
        """(red, green, blue) under the light of the row of `size` float32 numbers that starts at `start`."""

        def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            first = pointer_to(target, builder, signature, arguments, 0, arguments[2])

            def loaded(offset: Any) -> Any:
                return _load(builder, builder.gep(first, [offset]), _FLOAT, width)

            return _under_light(target, builder, signature, arguments[1], arguments[3], loaded, width)

        return several(types.float32, 3)(row, types.intp, types.intp, light), generate

    return intrinsic(lit_row)


lit_row_by_16, lit_row_by_4, lit_row_by_1 = (_lit_row(width) for width in (16, 4, 1))


def _sum_rows(width: int) -> Any:
    def sum_rows(
        context: Any, rows: Any, size: Any, a: Any, b: Any, c: Any, d: Any, of_a: Any, of_b: Any, of_c: Any, of_d: Any,
        total: Any, place: Any,
    ) -> Any:  # fmt: skip
        """Set `size` numbers of `total` (float32), from `place` on, to Σ weight · row.

        The rows start at a, b, c and d of `rows`.
        """

        def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            starts = [pointer_to(target, builder, signature, arguments, 0, start) for start in arguments[2:6]]
            weights = [broadcast(builder, weight, width) for weight in arguments[6:10]]
            first = pointer_to(target, builder, signature, arguments, 10, arguments[11])
            runs = builder.udiv(builder.add(arguments[1], _LONG(width - 1)), _LONG(width))
            with untyped.for_range(builder, runs) as run:
                offset = _offset(builder, run.index, arguments[1], width)
                numbers = _weighted(builder, rows.dtype, [builder.gep(start, [offset]) for start in starts], weights)
                at = builder.bitcast(builder.gep(first, [offset]), numbers.type.as_pointer())
                builder.store(numbers, at, align=4)
            return target.get_dummy_value()

        return types.void(rows, *[types.intp] * 5, *[types.float32] * 4, total, types.intp), generate

    return intrinsic(sum_rows)


sum_rows_by_16, sum_rows_by_4, sum_rows_by_1 = (_sum_rows(width) for width in (16, 4, 1))


@intrinsic
def blend(
    context: Any, numbers: Any, a: Any, b: Any, c: Any, d: Any, of_a: Any, of_b: Any, of_c: Any, of_d: Any
) -> Any:
    """(red, green, blue): Σ weight · colour, for colours that start at a, b, c and d; reads one number beyond each."""

    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        places = [pointer_to(target, builder, signature, arguments, 0, start) for start in arguments[1:5]]
        weights = [broadcast(builder, weight, 4) for weight in arguments[5:9]]
        colour = _weighted(builder, numbers.dtype, places, weights)
        channels = [builder.extract_element(colour, _INT(channel)) for channel in range(3)]
        return target.make_tuple(builder, signature.return_type, channels)

    return several(types.float32, 3)(numbers, *[types.intp] * 4, *[types.float32] * 4), generate


@intrinsic
def eight_towards(
    context: Any, geometry: Any, lane: Any, eye_x: Any, eye_y: Any, eye_z: Any, local: Any, count: Any
) -> Any:
    """Set eight columns of local [3,n], from `count` on, to the directions to the eye from the vertices of a lane.

    A column has x and y, not normalised, and cosθ. geometry [lanes,10,8], float32, holds positions, normals and
    tangents. An eye on a vertex is seen along the normal.
    """

    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first = pointer_to(target, builder, signature, arguments, 0, builder.mul(arguments[1], _LONG(10 * _EIGHT)))
        rows = [
            builder.fpext(_load(builder, builder.gep(first, [_LONG(_EIGHT * i)]), _FLOAT, _EIGHT), _EIGHT_DOUBLES)
            for i in range(9)
        ]
        to_eye = [builder.fsub(broadcast(builder, arguments[2 + i], _EIGHT), rows[i], flags=_FUSED) for i in range(3)]
        normal, tangent = rows[3:6], rows[6:9]
        square, along = _dot(builder, to_eye, to_eye), _dot(builder, to_eye, normal)
        root = builder.call(_square_root(builder), [square])
        on_vertex = builder.fcmp_ordered("==", square, _constant(_DOUBLE, _EIGHT, 0.0))
        cosine = builder.select(on_vertex, _constant(_DOUBLE, _EIGHT, 1.0), builder.fdiv(along, root))
        across = _dot(builder, to_eye, _cross(builder, normal, tangent))
        local = target.make_array(signature.args[5])(target, builder, arguments[5])
        width = builder.extract_value(local.shape, 1)
        for row, numbers in enumerate((_dot(builder, to_eye, tangent), across, cosine)):
            at = builder.gep(local.data, [builder.add(builder.mul(width, _LONG(row)), arguments[6])])
            builder.store(numbers, builder.bitcast(at, _EIGHT_DOUBLES.as_pointer()), align=8)
        return target.get_dummy_value()

    return types.void(geometry, types.intp, *[types.float64] * 3, local, types.intp), generate


def _dot(builder: Any, a: list[Any], b: list[Any]) -> Any:
    terms = [builder.fmul(x, y, flags=_FUSED) for x, y in zip(a, b, strict=True)]
    return builder.fadd(builder.fadd(terms[0], terms[1], flags=_FUSED), terms[2], flags=_FUSED)


def _cross(builder: Any, a: list[Any], b: list[Any]) -> list[Any]:
    def minor(i: int, j: int) -> Any:
        return builder.fsub(
            builder.fmul(a[i], b[j], flags=_FUSED), builder.fmul(a[j], b[i], flags=_FUSED), flags=_FUSED
        )

    return [minor(1, 2), minor(2, 0), minor(0, 1)]


def _square_root(builder: Any) -> Any:
    form = ir.FunctionType(_EIGHT_DOUBLES, [_EIGHT_DOUBLES])
    return untyped.get_or_insert_function(builder.module, form, f"llvm.sqrt.v{_EIGHT}f64")


@intrinsic
def lit_run(context: Any, rows: Any, size: Any, start: Any, count: Any, weights: Any, light: Any) -> Any:
    """(red, green, blue) of Σ weights[r] · row under the light. The rows are contiguous from rows[start].

    `count`, the number of rows, is a multiple of 4; `size`, the numbers of a row, is at least 16.
    """

    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        length = arguments[1]
        first = pointer_to(target, builder, signature, arguments, 0, arguments[2])

        def weighted(offset: Any) -> Any:
            total = untyped.alloca_once(builder, ir.VectorType(_FLOAT, WIDEST))
            builder.store(_constant(_FLOAT, WIDEST, 0.0), total)
            steps = builder.udiv(arguments[3], _LONG(_DECODED_ROWS))
            with untyped.for_range(builder, steps) as step:
                row = builder.mul(step.index, _LONG(_DECODED_ROWS))
                numbers = [builder.add(row, _LONG(r)) for r in range(_DECODED_ROWS)]
                places = [builder.gep(first, [builder.add(builder.mul(r, length), offset)]) for r in numbers]
                shares = [
                    broadcast(builder, builder.load(pointer_to(target, builder, signature, arguments, 4, r)), WIDEST)
                    for r in numbers
                ]
                four = _weighted(builder, rows.dtype, places, shares)
                builder.store(builder.fadd(builder.load(total), four, flags=_FUSED), total)
            return builder.load(total)

        return _under_light(target, builder, signature, length, arguments[5], weighted, WIDEST)

    counts = (types.intp,) * 3
    return several(types.float32, 3)(rows, *counts, weights, light), generate


def _under_light(
    target: Any, builder: Any, signature: Any, size: Any, light: Any, row: Callable[[Any], Any], width: int
) -> Any:
    """Σ row(offset) · light for each channel, in vectors of `width` numbers."""
    totals = [untyped.alloca_once_value(builder, _constant(_FLOAT, width, 0.0)) for _ in range(3)]
    shares = target.make_array(signature.args[-1])(target, builder, light).data
    runs = builder.udiv(builder.add(size, _LONG(width - 1)), _LONG(width))
    with untyped.for_range(builder, runs) as run:
        offset = _offset(builder, run.index, size, width)
        numbers = row(offset)
        for channel, total in enumerate(totals):
            place = builder.gep(
                shares, [builder.mul(builder.add(builder.mul(run.index, _LONG(3)), _LONG(channel)), _LONG(width))]
            )
            lit = builder.fmul(numbers, _load(builder, place, _FLOAT, width), flags=_FUSED)
            builder.store(builder.fadd(builder.load(total), lit, flags=_FUSED), total)
    sums = [horizontal_sum(builder, builder.load(total)) for total in totals]
    return target.make_tuple(builder, signature.return_type, sums)


def _offset(builder: Any, run: Any, size: Any, width: int) -> Any:
    """Offset of a run of `width` numbers; the last one ends with the row."""
    begin, last = builder.mul(run, _LONG(width)), builder.sub(size, _LONG(width))
    return builder.select(builder.icmp_signed("<", begin, last), begin, last)


def _weighted(builder: Any, kind: Any, places: list[Any], weights: list[Any]) -> Any:
    """Σ weight · number at each place, as a balanced tree: in a chain each sum would wait for the one before."""
    terms = [
        builder.fmul(_widened(builder, kind, place, weight.type.count), weight, flags=_FUSED)
        for place, weight in zip(places, weights, strict=True)
    ]
    one, two = (builder.fadd(terms[i], terms[i + 1], flags=_FUSED) for i in (0, 2))
    return builder.fadd(one, two, flags=_FUSED)


def _widened(builder: Any, kind: Any, place: Any, width: int) -> Any:
    """The `width` numbers at `place`, converted to float32."""
    if kind == types.float32:
        return _load(builder, place, _FLOAT, width)
    if kind == types.int8:
        return builder.sitofp(_load(builder, place, _BYTE, width), ir.VectorType(_FLOAT, width))
    bits = _load(builder, place, _SHORT, width)
    if _processor_widens():
        return builder.fpext(builder.bitcast(bits, ir.VectorType(_HALF, width)), ir.VectorType(_FLOAT, width))
    return _shifted(builder, bits, width)


def _shifted(builder: Any, bits: Any, width: int) -> Any:
    """Finite float16 numbers, given as bits, converted to float32."""
    shifted = builder.shl(builder.sext(bits, ir.VectorType(_INT, width)), _constant(_INT, width, 13))
    # Clears the copies of the sign in the upper bits of the exponent.
    kept = builder.and_(shifted, _constant(_INT, width, 0x8FFFE000))
    return builder.fmul(builder.bitcast(kept, ir.VectorType(_FLOAT, width)), _constant(_FLOAT, width, 2.0**112))


def _processor_widens() -> bool:
    return platform.machine() in ("aarch64", "arm64") or bool(llvm.get_host_cpu_features().get("f16c", False))


def pointer_to(target: Any, builder: Any, signature: Any, arguments: Any, which: int, index: Any) -> Any:
    """Pointer to element `index` of the array in argument number `which`."""
    array = target.make_array(signature.args[which])(target, builder, arguments[which])
    return builder.gep(array.data, [index])


def _load(builder: Any, place: Any, kind: Any, width: int) -> Any:
    numbers = builder.load(builder.bitcast(place, ir.VectorType(kind, width).as_pointer()))
    numbers.align = {_FLOAT: 4, _SHORT: 2, _BYTE: 1}[kind]
    return numbers


def _constant(kind: Any, width: int, value: float) -> Any:
    return ir.Constant(ir.VectorType(kind, width), [ir.Constant(kind, value)] * width)


def broadcast(builder: Any, value: Any, width: int) -> Any:
    """A vector of `width` equal values."""
    one = builder.insert_element(ir.Constant(ir.VectorType(value.type, width), ir.Undefined), value, _INT(0))
    return builder.shuffle_vector(one, one, _constant(_INT, width, 0))


def horizontal_sum(builder: Any, numbers: Any) -> Any:
    """Sum over a vector, by adding its upper half to its lower half repeatedly."""
    width = numbers.type.count
    while width > 1:
        width //= 2
        low, high = (
            ir.Constant(ir.VectorType(_INT, width), [_INT(first + i) for i in range(width)]) for first in (0, width)
        )
        numbers = builder.fadd(
            builder.shuffle_vector(numbers, numbers, low), builder.shuffle_vector(numbers, numbers, high), flags=_FUSED
        )
    return builder.extract_element(numbers, _INT(0))
