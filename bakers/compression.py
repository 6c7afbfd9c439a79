"""Compact forms of coefficients: separable bases learned from a sample, and whole numbers of one step.

Coefficients of a vertex are a matrix [B,KC], view bins times harmonics and channels. Each side is turned into a basis
that is orthonormal (to the rounding of what a file keeps) and makes most of the energy few numbers; these are divided
by one step for all, which is the best share-out of a total error over orthonormal components (reverse water-filling),
and rounded, a little towards zero. Zeros then pack well.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset.compact_file import deflated, digit_planes
from formats.asset.compact_record import FactorisedViews, LearnedViews

Array = NDArray[np.float64]

ROUND_UP = 0.38
"""What is added before the fraction is dropped; a half would round to the nearest. Less makes more zeros, of a finer
step for the same error: 5 % fewer bytes.
"""
TAILS = 0.1, 0.3, 0.5
"""Shares of the squared error that learned bases over view bins may leave out."""
TAIL_OF_CHANNELS = 0.003
SHARE_OF_BASIS = 0.03
"""Of the squared error, what rounding of a learned basis may add."""
COARSEST_BASIS = 0.5
"""Largest scale of a learned function, over the root mean square of its values."""
MOST_LEARNED_BINS = 2048
LARGEST_CODE = 2**30
_STEPS_TRIED = 12


@dataclass(frozen=True)
class Form:
    """A way to keep coefficients: a basis over view bins, and one over harmonics and channels, float32 [J,K,C]."""

    name: str
    views: FactorisedViews | LearnedViews
    channels: NDArray[np.float32]

    def analysis(self, kind: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        """What turns coefficients into numbers by least squares: of the views [R,B], and of the channels [KC,J]."""
        flat = self.channels.reshape(len(self.channels), -1).astype(np.float64)
        matrix = self.views.matrix
        return _left_inverse(matrix).astype(kind), _left_inverse(flat).T.astype(kind)

    def numbers(self, block: NDArray[Any], analysis: tuple[NDArray[Any], NDArray[Any]]) -> NDArray[Any]:
        """The numbers [n,R,J] of coefficients [n,B,K,C]."""
        views, channels = analysis
        flat = block.reshape(*block.shape[:2], -1).astype(views.dtype)
        return np.asarray(np.matmul(views, flat @ channels))

    def squares(self, numbers: NDArray[Any]) -> float:
        """Σ of the squares of the coefficients that numbers [n,R,J] stand for."""
        flat, matrix = self.channels.reshape(len(self.channels), -1).astype(np.float64), self.views.matrix
        of_views, of_channels = (matrix @ matrix.T).astype(numbers.dtype), (flat @ flat.T).astype(numbers.dtype)
        seen = np.matmul(of_views, numbers @ of_channels)
        return float(np.einsum("nrj,nrj->", numbers, seen, dtype=np.float64))


@dataclass(frozen=True)
class Trial:
    """A form on a sample: which components are kept, the step, and what it comes to.

    view_component, channel_component: [P], by channel, within one those with the most energy first.
    squares: of the error on the sample. size: bytes of the codes of the sample, packed. basis: bytes of the bases.
    """

    form: Form
    view_component: NDArray[np.int64]
    channel_component: NDArray[np.int64]
    step: float
    squares: float
    size: int
    basis: int


def forms(sample: NDArray[np.floating], rings: int, sectors: int, allowed: float) -> Iterator[Form]:
    """Forms worth trying for a sample [n,B,K,C] whose squared error may be `allowed`; with B = 1 there is one."""
    count, bins, *last = sample.shape
    flat = sample.reshape(count, bins, -1)
    channels = _kept(_gram(flat, (0, 1)), TAIL_OF_CHANNELS * allowed).reshape(-1, *last)
    if bins == 1:
        one = np.ones((1, 1), np.float32)
        yield Form("no views", FactorisedViews(one, one), channels)
        return
    by_ring = flat.reshape(count, rings, sectors, -1)
    yield Form(
        "rings × sectors",
        FactorisedViews(_kept(_gram(by_ring, (0, 2, 3)), 0.0), _kept(_gram(by_ring, (0, 1, 3)), 0.0)),
        channels,
    )
    if bins > MOST_LEARNED_BINS or allowed == 0.0:
        return
    energies, functions = _principal(_gram(flat, (0, 2)))
    for tail in TAILS:
        kept = _count(energies, tail * allowed)
        scale = np.sqrt(12.0 * SHARE_OF_BASIS * allowed / (kept * bins * np.maximum(energies[:kept], 1e-300)))
        scale = np.minimum(scale, COARSEST_BASIS / np.sqrt(bins)).astype(np.float32)
        codes = np.rint(functions[:kept] / scale.astype(np.float64)[:, None]).astype(np.int32)
        yield Form(f"learned views, {kept}", LearnedViews(codes, scale), channels)


def untransformed(rings: int, sectors: int, terms: int, channels: int) -> Form:
    """The form whose numbers are the coefficients themselves: it meets any error."""
    last = np.eye(terms * channels, dtype=np.float32).reshape(-1, terms, channels)
    return Form("no bases", FactorisedViews(np.eye(rings, dtype=np.float32), np.eye(sectors, dtype=np.float32)), last)


def tried(form: Form, sample: NDArray[np.floating], allowed: float, kind: Any) -> Trial | None:
    """The largest step with which a form's squared error on the sample [n,B,K,C] is `allowed`, or None if none is;
    `kind` is the type of the numbers.
    """
    analysis = form.analysis(kind)
    blocks = [form.numbers(sample[first : first + 64], analysis) for first in range(0, len(sample), 64)]
    total = float(np.square(sample, dtype=np.float64).sum())
    rest = max(total - sum(form.squares(block) for block in blocks), 0.0)
    if rest >= allowed > 0.0:
        return None
    width = len(form.channels)
    numbers = np.ascontiguousarray(np.concatenate(blocks).reshape(len(sample), -1).T)
    del blocks
    energies = np.einsum("pn,pn->p", numbers, numbers, dtype=np.float64)
    order = np.argsort(-energies, kind="stable")
    kept = _count(energies[order], 0.02 * (allowed - rest))
    rest += float(energies[order[kept:]].sum())
    order = order[:kept]
    numbers = numbers[order]
    step, squares = _largest_step(numbers, rest, allowed)
    codes = quantised(numbers, step)
    live = np.flatnonzero(codes.any(axis=1) | (np.arange(len(codes)) == 0))
    live = live[np.argsort(order[live] % width, kind="stable")]
    components = order[live]
    size = sum(len(deflated(plane)) for plane in digit_planes(codes[live]))
    basis = _basis_bytes(form) + 3 * len(components)
    return Trial(form, components // width, components % width, step, squares, size, basis)


def quantised(numbers: NDArray[Any], step: float) -> NDArray[np.int32]:
    """Numbers as whole ones of `step`, rounded a little towards zero."""
    return np.asarray(np.sign(numbers) * np.floor(np.abs(numbers) / step + ROUND_UP)).astype(np.int32)


def _largest_step(numbers: NDArray[Any], rest: float, allowed: float) -> tuple[float, float]:
    """The step with which rounding and `rest` together come to 98.5 to 100 % of `allowed`, and what they come to."""
    largest = float(np.abs(numbers).max())
    if largest == 0.0 or allowed <= rest:
        return 1.0, rest
    low, high = largest / LARGEST_CODE, 4.0 * largest
    step, squares = np.sqrt(12.0 * (allowed - rest) / numbers.size), rest
    for _ in range(_STEPS_TRIED):
        step = min(max(step, low), high)
        squares = rest + _rounding(numbers, step)
        if 0.985 * allowed <= squares <= allowed:
            return step, squares
        if squares > allowed:
            high = step
        else:
            low = step
        guess = step * ((allowed - rest) * 0.993 / max(squares - rest, 1e-300)) ** 0.6
        step = guess if low < guess < high else float(np.sqrt(low * high))
    return low, rest + _rounding(numbers, low)


def _rounding(numbers: NDArray[Any], step: float) -> float:
    squares = 0.0
    for first in range(0, len(numbers), 1024):
        some = numbers[first : first + 1024]
        squares += float(np.square(some - quantised(some, step) * some.dtype.type(step), dtype=np.float64).sum())
    return squares


def _gram(values: NDArray[Any], over: tuple[int, ...]) -> Array:
    """Products of the one axis that is not summed over, added up in blocks: [M,M]."""
    axis = next(each for each in range(values.ndim) if each not in over)
    gram = np.zeros((values.shape[axis],) * 2)
    for first in range(0, len(values), 64):
        moved = np.moveaxis(values[first : first + 64], axis, 0).reshape(len(gram), -1).astype(np.float32)
        gram += moved @ moved.T
    return gram


def _principal(gram: Array) -> tuple[Array, Array]:
    """Energies, falling, and the orthonormal functions that have them as rows; the largest value of each is positive,
    so that they do not depend on who solved for them.
    """
    energies, columns = np.linalg.eigh(gram)
    functions = columns.T[::-1]
    largest = np.take_along_axis(functions, np.abs(functions).argmax(axis=1)[:, None], axis=1)
    return np.maximum(energies[::-1], 0.0), functions * np.where(largest < 0.0, -1.0, 1.0)


def _kept(gram: Array, left_out: float) -> NDArray[np.float32]:
    energies, functions = _principal(gram)
    return functions[: _count(energies, left_out)].astype(np.float32)


def _count(energies: Array, left_out: float) -> int:
    """How many of falling energies must be kept so that the others come to `left_out` at most; at least one."""
    tails = np.append(np.cumsum(energies[::-1])[::-1], 0.0)
    return max(1, int(np.argmax(tails <= left_out)))


def _left_inverse(functions: Array) -> Array:
    """What gives the weights of functions [R,B] that fit values best: (F Fᵀ)⁻¹ F [R,B]."""
    return np.asarray(np.linalg.lstsq(functions @ functions.T, functions, rcond=None)[0])


def _basis_bytes(form: Form) -> int:
    views = form.views
    if isinstance(views, FactorisedViews):
        return int(views.rings.nbytes + views.sectors.nbytes + form.channels.nbytes)
    return sum(len(deflated(plane)) for plane in digit_planes(views.codes)) + int(form.channels.nbytes)
