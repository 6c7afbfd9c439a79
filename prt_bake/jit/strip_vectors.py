"""What numba has no words for in sums over the columns of pictures, as LLVM: two strips of a row at a time, by fours of
columns, each number widened once for all that is summed of it.
"""

from typing import Any

from llvmlite import ir
from numba import types

from prt_bake.jit import vectors

STRIDE = 520
"""From one wave of a strip to the next: rows a power of two apart would share few places of the first cache."""
STEP = 8
"""Columns of a strip come in so many."""
_WIDTH = 4
_DOUBLES = ir.VectorType(ir.DoubleType(), _WIDTH)
_FLOATS = ir.VectorType(ir.FloatType(), _WIDTH)
_KINDS = {types.float64: ir.DoubleType(), types.float32: ir.FloatType(), types.uint16: ir.IntType(16)}
_LONG, _INT = ir.IntType(64), ir.IntType(32)
_FUSED = ("contract",)


def _strip(into: str) -> Any:
    def strip(
        context: Any, numbers: Any, near: Any, far: Any, size: Any, waves: Any, first: Any,
        total: Any, place: Any, other: Any, weight: Any,
    ) -> Any:  # fmt: skip
        """Σ over `size` columns, a multiple of `STEP`, of a = numbers[near + i] and b = numbers[far + i]: a + b, then
        (a − b) · w₀, (a − b) · w₁, (a + b) · w₂ and (a + b) · w₃, the waves from waves[first] on, `STRIDE` apart.
        Into a total they also "add" weight · a and weight · b, to total[place + i] and total[other + i], or "set"
        them.
        """

        def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            def start(which: int, index: Any) -> Any:
                return vectors.element(target, builder, signature, arguments, which, index)

            one, two = start(0, arguments[1]), start(0, arguments[2])
            tables = [start(4, builder.add(arguments[5], _LONG(k * STRIDE))) for k in range(4)]
            zero = ir.Constant(_DOUBLES, [0.0] * _WIDTH)
            sums = [[vectors.untyped.alloca_once_value(builder, zero) for _ in range(5)] for _ in range(2)]
            if into:
                share = vectors.all_alike(builder, arguments[9], _WIDTH)
                totals = start(6, arguments[7]), start(6, arguments[8])
            with vectors.untyped.for_range(builder, builder.udiv(arguments[3], _LONG(STEP))) as step:
                for part, own in enumerate(sums):
                    i = builder.add(builder.mul(step.index, _LONG(STEP)), _LONG(part * _WIDTH))
                    a, b = (_doubles(builder, numbers.dtype, builder.gep(row, [i])) for row in (one, two))
                    if into:
                        for row, pixels in zip(totals, (a, b), strict=True):
                            at = builder.gep(row, [i])
                            kept = zero if into == "set" else _load(builder, at, _DOUBLES, 8)
                            _store(builder, _fused(builder, share, pixels, kept), at, 8)
                    even, odd = builder.fadd(a, b), builder.fsub(a, b)
                    builder.store(builder.fadd(builder.load(own[0]), even), own[0])
                    for table, kept, pixels in zip(tables, own[1:], (odd, odd, even, even), strict=True):
                        wave = _load(builder, builder.gep(table, [i]), _DOUBLES, 8)
                        builder.store(_fused(builder, wave, pixels, builder.load(kept)), kept)
            both = [builder.fadd(builder.load(x), builder.load(y)) for x, y in zip(*sums, strict=True)]
            return target.make_tuple(builder, signature.return_type, [vectors.sum_of(builder, x) for x in both])

        places = (types.intp,) * 3
        given = (numbers, *places, waves, types.intp, total, types.intp, types.intp, types.float64)
        return vectors.several(types.float64, 5)(*given), generate

    return vectors.intrinsic(strip)


strip_sums, strip_sums_set, strip_sums_added = (_strip(into) for into in ("", "set", "add"))


@vectors.intrinsic
def short_sums(
    context: Any, numbers: Any, channel: Any, begins: Any, shares: Any, terms: Any, first: Any, count: Any, image: Any,
    line: Any, length: Any, shift: Any,
) -> Any:  # fmt: skip
    """image[3·j + c] and line[c·length + j + shift], float32, = Σ shares[j·terms + k] · numbers[c·channel + begins[j] +
    k] over k below `terms`, a multiple of 4, for `count` j from `first` on, a multiple of 4.
    """

    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def at(which: int, index: Any) -> Any:
            return vectors.element(target, builder, signature, arguments, which, index)

        terms_of_one = arguments[4]
        channels = [at(0, builder.mul(arguments[1], _LONG(c))) for c in range(3)]
        with vectors.untyped.for_range(builder, builder.udiv(arguments[6], _LONG(_WIDTH))) as four:
            j = builder.add(arguments[5], builder.mul(four.index, _LONG(_WIDTH)))
            rows = []
            for q in range(_WIDTH):
                place = builder.add(j, _LONG(q))
                share, begin = at(3, builder.mul(place, terms_of_one)), builder.load(at(2, place))
                rows.append(
                    _three_sums(builder, share, [builder.gep(pixels, [begin]) for pixels in channels], terms_of_one)
                )
            means = [_across(builder, list(of_channel)) for of_channel in zip(*rows, strict=True)]
            floats = [builder.fptrunc(mean, _FLOATS) for mean in means]
            _store_pixels(builder, floats, at(7, builder.mul(j, _LONG(3))))
            for c, channel_floats in enumerate(floats):
                place = builder.add(builder.mul(arguments[9], _LONG(c)), builder.add(j, arguments[10]))
                _store(builder, channel_floats, at(8, place), 4)
        return target.get_dummy_value()

    sizes = (types.intp,) * 3
    return types.void(numbers, types.intp, begins, shares, *sizes, image, line, types.intp, types.intp), generate


def _three_sums(builder: Any, share: Any, pixels: list[Any], length: Any) -> list[Any]:
    """Σ share · pixels for three rows of pixels, four products at a time."""
    shares = _load(builder, share, _DOUBLES, 8)
    sums = [
        vectors.untyped.alloca_once_value(builder, builder.fmul(shares, _load(builder, row, _DOUBLES, 8)))
        for row in pixels
    ]
    with vectors.untyped.for_range_slice(builder, _LONG(_WIDTH), length, _LONG(_WIDTH)) as (k, _):
        shares = _load(builder, builder.gep(share, [k]), _DOUBLES, 8)
        for row, kept in zip(pixels, sums, strict=True):
            more = _load(builder, builder.gep(row, [k]), _DOUBLES, 8)
            builder.store(_fused(builder, shares, more, builder.load(kept)), kept)
    return [builder.load(kept) for kept in sums]


def _across(builder: Any, rows: list[Any]) -> Any:
    """The sums of four vectors, as one."""
    one, two = (
        builder.fadd(_mixed(builder, a, b, [0, 4, 2, 6]), _mixed(builder, a, b, [1, 5, 3, 7]))
        for a, b in (rows[:2], rows[2:])
    )
    return builder.fadd(_mixed(builder, one, two, [0, 1, 4, 5]), _mixed(builder, one, two, [2, 3, 6, 7]))


def _store_pixels(builder: Any, channels: list[Any], place: Any) -> None:
    """Four reds, greens and blues, float32, as pixels one after another."""
    both = _mixed(builder, channels[0], channels[1], list(range(8)))
    blues = _mixed(builder, channels[2], channels[2], list(range(8)))
    order = [channel * _WIDTH + pixel if channel < 2 else 8 + pixel for pixel in range(_WIDTH) for channel in range(3)]
    _store(builder, _mixed(builder, both, blues, order), place, 4)


def _mixed(builder: Any, a: Any, b: Any, places: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(places)), [_INT(p) for p in places]))


def _doubles(builder: Any, kind: Any, place: Any) -> Any:
    """The numbers at `place` as float64; of those that are not finite one may come out as another that is not."""
    stored = _load(builder, place, ir.VectorType(_KINDS[kind], _WIDTH), kind.bitwidth // 8)
    if kind == types.float64:
        return stored
    return builder.fpext(vectors.halves(builder, stored, _WIDTH) if kind == types.uint16 else stored, _DOUBLES)


def _fused(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=_FUSED), c, flags=_FUSED)


def _load(builder: Any, place: Any, kind: Any, align: int) -> Any:
    numbers = builder.load(builder.bitcast(place, kind.as_pointer()))
    numbers.align = align
    return numbers


def _store(builder: Any, numbers: Any, place: Any, align: int) -> None:
    builder.store(numbers, builder.bitcast(place, numbers.type.as_pointer()), align=align)
