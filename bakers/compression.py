"""Transform coding of coefficients: separable bases learned from a sample, and uniform quantisation.

The coefficients of a vertex are a matrix [B,KC] of view bins by harmonics and channels. A basis on each side,
orthonormal up to float32 rounding, concentrates most of the energy in few components. All components are divided by one
step, which is the optimal allocation of a total error over orthonormal components (reverse water-filling), and rounded
slightly towards zero. The many zeros compress well.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset.compact_file import deflate, digit_planes
from formats.asset.compact_record import FactorisedViews, LearnedViews

Array = NDArray[np.float64]

ROUNDING_OFFSET = 0.38
"""Rounding offset; 0.5 rounds to the nearest. A smaller offset makes more zeros at a finer step for the same error, 5 %
fewer bytes.
"""
TRUNCATION_SHARES = 0.1, 0.3, 0.5
"""Fractions of the squared error that truncating a learned basis over view bins may cause."""
CHANNEL_TRUNCATION_SHARE = 0.003
BASIS_SHARE = 0.03
"""Fraction of the squared error that quantising a learned basis may add."""
COARSEST_BASIS_STEP = 0.5
"""Largest quantisation step of a learned function, relative to its rms value."""
MOST_LEARNED_BINS = 2048
LARGEST_CODE = 2**30
_MOST_ITERATIONS = 12


@dataclass(frozen=True)
class Bases:
    """Bases that encode coefficients: one over view bins, and one over harmonics and channels, float32 [J,K,C]."""

    name: str
    views: FactorisedViews | LearnedViews
    channels: NDArray[np.float32]

    def analysis(self, kind: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        """Least-squares analysis matrices: of the views [R,B], and of the channels [KC,J]."""
        flat = self.channels.reshape(len(self.channels), -1).astype(np.float64)
        matrix = self.views.matrix
        return _left_inverse(matrix).astype(kind), _left_inverse(flat).T.astype(kind)

    def components(self, block: NDArray[Any], analysis: tuple[NDArray[Any], NDArray[Any]]) -> NDArray[Any]:
        """Components [n,R,J] of coefficients [n,B,K,C]."""
        views, channels = analysis
        flat = block.reshape(*block.shape[:2], -1).astype(views.dtype)
        return np.asarray(np.matmul(views, flat @ channels))

    def squares(self, components: NDArray[Any]) -> float:
        """Sum of squares of the coefficients that have the components [n,R,J]."""
        flat, matrix = self.channels.reshape(len(self.channels), -1).astype(np.float64), self.views.matrix
        view_gram, channel_gram = (matrix @ matrix.T).astype(components.dtype), (flat @ flat.T).astype(components.dtype)
        products = np.matmul(view_gram, components @ channel_gram)
        return float(np.einsum("nrj,nrj->", components, products, dtype=np.float64))


@dataclass(frozen=True)
class Trial:
    """Result of quantising a sample with some bases.

    view_component, channel_component: [P], the kept components, grouped by channel and by falling energy within a
    channel. squares: squared error on the sample. size: compressed bytes of the sample's codes. basis: bytes of the
    bases.
    """

    bases: Bases
    view_component: NDArray[np.int64]
    channel_component: NDArray[np.int64]
    step: float
    squares: float
    size: int
    basis: int


def candidate_bases(sample: NDArray[np.floating], rings: int, sectors: int, allowed: float) -> Iterator[Bases]:
    """Candidate bases for a sample [n,B,K,C] with the squared error `allowed`; B = 1 gives a single candidate."""
    count, bins, *last = sample.shape
    flat = sample.reshape(count, bins, -1)
    channels = _kept(_gram(flat, (0, 1)), CHANNEL_TRUNCATION_SHARE * allowed).reshape(-1, *last)
    if bins == 1:
        one = np.ones((1, 1), np.float32)
        yield Bases("no views", FactorisedViews(one, one), channels)
        return
    by_ring = flat.reshape(count, rings, sectors, -1)
    yield Bases(
        "rings × sectors",
        FactorisedViews(_kept(_gram(by_ring, (0, 2, 3)), 0.0), _kept(_gram(by_ring, (0, 1, 3)), 0.0)),
        channels,
    )
    if bins > MOST_LEARNED_BINS or allowed == 0.0:
        return
    energies, functions = _principal(_gram(flat, (0, 2)))
    for tail in TRUNCATION_SHARES:
        kept = _count(energies, tail * allowed)
        scale = np.sqrt(12.0 * BASIS_SHARE * allowed / (kept * bins * np.maximum(energies[:kept], 1e-300)))
        scale = np.minimum(scale, COARSEST_BASIS_STEP / np.sqrt(bins)).astype(np.float32)
        codes = np.rint(functions[:kept] / scale.astype(np.float64)[:, None]).astype(np.int32)
        yield Bases(f"learned views, {kept}", LearnedViews(codes, scale), channels)


def identity_bases(rings: int, sectors: int, terms: int, channels: int) -> Bases:
    """Bases whose components are the coefficients themselves; they can meet any error."""
    last = np.eye(terms * channels, dtype=np.float32).reshape(-1, terms, channels)
    return Bases("no bases", FactorisedViews(np.eye(rings, dtype=np.float32), np.eye(sectors, dtype=np.float32)), last)


def tried_bases(bases: Bases, sample: NDArray[np.floating], allowed: float, kind: Any) -> Trial | None:
    """The largest step whose squared error on the sample [n,B,K,C] is `allowed`, or None if truncation alone exceeds
    it; `kind` is the dtype of the components.
    """
    analysis = bases.analysis(kind)
    blocks = [bases.components(sample[first : first + 64], analysis) for first in range(0, len(sample), 64)]
    total = float(np.square(sample, dtype=np.float64).sum())
    rest = max(total - sum(bases.squares(block) for block in blocks), 0.0)
    if rest >= allowed > 0.0:
        return None
    width = len(bases.channels)
    components = np.ascontiguousarray(np.concatenate(blocks).reshape(len(sample), -1).T)
    del blocks
    energies = np.einsum("pn,pn->p", components, components, dtype=np.float64)
    order = np.argsort(-energies, kind="stable")
    kept = _count(energies[order], 0.02 * (allowed - rest))
    rest += float(energies[order[kept:]].sum())
    order = order[:kept]
    components = components[order]
    step, squares = _largest_step(components, rest, allowed)
    codes = quantised(components, step)
    live = np.flatnonzero(codes.any(axis=1) | (np.arange(len(codes)) == 0))
    live = live[np.argsort(order[live] % width, kind="stable")]
    kept_components = order[live]
    size = sum(len(deflate(plane)) for plane in digit_planes(codes[live]))
    basis = _basis_bytes(bases) + 3 * len(kept_components)
    return Trial(bases, kept_components // width, kept_components % width, step, squares, size, basis)


def quantised(components: NDArray[Any], step: float) -> NDArray[np.int32]:
    """Components as integer multiples of `step`, rounded slightly towards zero."""
    return np.asarray(np.sign(components) * np.floor(np.abs(components) / step + ROUNDING_OFFSET)).astype(np.int32)


def _largest_step(components: NDArray[Any], rest: float, allowed: float) -> tuple[float, float]:
    """The step at which quantisation and `rest` total 98.5 to 100 % of `allowed`, and that total."""
    largest = float(np.abs(components).max())
    if largest == 0.0 or allowed <= rest:
        return 1.0, rest
    low, high = largest / LARGEST_CODE, 4.0 * largest
    step, squares = np.sqrt(12.0 * (allowed - rest) / components.size), rest
    for _ in range(_MOST_ITERATIONS):
        step = min(max(step, low), high)
        squares = rest + _rounding(components, step)
        if 0.985 * allowed <= squares <= allowed:
            return step, squares
        if squares > allowed:
            high = step
        else:
            low = step
        guess = step * ((allowed - rest) * 0.993 / max(squares - rest, 1e-300)) ** 0.6
        step = guess if low < guess < high else float(np.sqrt(low * high))
    return low, rest + _rounding(components, low)


def _rounding(components: NDArray[Any], step: float) -> float:
    squares = 0.0
    for first in range(0, len(components), 1024):
        some = components[first : first + 1024]
        squares += float(np.square(some - quantised(some, step) * some.dtype.type(step), dtype=np.float64).sum())
    return squares


def _gram(values: NDArray[Any], over: tuple[int, ...]) -> Array:
    """Gram matrix [M,M] of the one axis that is not summed over, accumulated in blocks."""
    axis = next(each for each in range(values.ndim) if each not in over)
    gram = np.zeros((values.shape[axis],) * 2)
    for first in range(0, len(values), 64):
        moved = np.moveaxis(values[first : first + 64], axis, 0).reshape(len(gram), -1).astype(np.float32)
        gram += moved @ moved.T
    return gram


def _principal(gram: Array) -> tuple[Array, Array]:
    """Eigenvalues in falling order, and the orthonormal eigenvectors as rows. The largest entry of each is positive, so
    that the result does not depend on the solver.
    """
    energies, columns = np.linalg.eigh(gram)
    functions = columns.T[::-1]
    largest = np.take_along_axis(functions, np.abs(functions).argmax(axis=1)[:, None], axis=1)
    return np.maximum(energies[::-1], 0.0), functions * np.where(largest < 0.0, -1.0, 1.0)


def _kept(gram: Array, left_out: float) -> NDArray[np.float32]:
    energies, functions = _principal(gram)
    return functions[: _count(energies, left_out)].astype(np.float32)


def _count(energies: Array, left_out: float) -> int:
    """How many energies, sorted from the largest, to keep so that the others sum to at most `left_out`; at least 1."""
    tails = np.append(np.cumsum(energies[::-1])[::-1], 0.0)
    return max(1, int(np.argmax(tails <= left_out)))


def _left_inverse(functions: Array) -> Array:
    """Least-squares analysis matrix (F Fᵀ)⁻¹ F [R,B] of functions F [R,B]."""
    return np.asarray(np.linalg.lstsq(functions @ functions.T, functions, rcond=None)[0])


def _basis_bytes(bases: Bases) -> int:
    views = bases.views
    if isinstance(views, FactorisedViews):
        return int(views.rings.nbytes + views.sectors.nbytes + bases.channels.nbytes)
    return sum(len(deflate(plane)) for plane in digit_planes(views.codes)) + int(bases.channels.nbytes)
