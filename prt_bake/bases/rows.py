"""Relative errors of every basis, at queries that none of them was learned from, with intervals."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.bases.gaussians import GaussianFit
from prt_bake.bases.linear import Harmonics, LearnedBasis, sky_norm
from prt_bake.bases.wavelets import haar, keep_largest

Array = NDArray[np.float64]

DEGREES = 0, 1, 2, 3, 4, 6, 8, 12
LEARNED_APART, LEARNED_TOGETHER = (9, 36), (27, 48, 108)
WAVELETS = 9, 25, 64
GAUSSIANS = ((0, 1), (0, 2), (0, 4), (2, 1), (2, 2), (2, 3), (2, 4))
"""Degree of the harmonics, and number of Gaussians."""
_NUMBERS_OF_A_GAUSSIAN, _NUMBERS_OF_A_WAVELET = 6, 4
_RESAMPLED = 400


class Values(NamedTuple):
    """Ŝ of N queries over M cells, [N,M,3].

    Attributes:
        fitted: what bases approximate.
        checks: two estimates that errors are measured with; they are `fitted` itself unless Ŝ is path traced. The three
            are then independent, and errors contain the noise of the fit, but not that of the checks.
        lobes: the detail beyond degree 2 of the lobes that the network has; None if it has none.
        weights: [N], with which sums over the queries stand for the whole object.
    """

    fitted: Array
    checks: tuple[Array, Array]
    lobes: Array | None
    weights: Array


class Estimate(NamedTuple):
    """A relative error, and its 95 % interval over the choice of queries."""

    value: float
    low: float
    high: float


Approximation = Callable[[Values], Array]


@dataclass(frozen=True)
class Basis:
    """A basis, the numbers that it stores for a view bin, and its approximations [N,M,3] of values.

    of_transport: for Ŝ itself; None if the basis depends on the light. under: for the radiance under each light.
    """

    name: str
    numbers: int
    of_transport: Approximation | None
    under: tuple[Approximation, ...]


@dataclass(frozen=True)
class Row:
    """The relative errors of a basis: of Ŝ, and of radiance under each light."""

    name: str
    numbers: int
    transport: Estimate | None
    radiance: tuple[Estimate, ...]


def every_basis(training: Array, directions: Array, lights: list[Array], own_lobes: int = 0) -> Iterator[Basis]:
    """The bases that are compared.

    Args:
        training: [N,M,3], values at points that bases are learned from, times the roots of their weights.
        directions: [M,3], of the cells.
        lights: skies [T,M,3] in several rotations. What is weighted by skies is weighted by all but the one that it is
            measured under.
        own_lobes: the number of lobes that the network has.
    """

    def basis(name: str, numbers: int, approximate: Callable[[Array], Array]) -> Basis:
        return Basis(name, numbers, _of(approximate), (_of(approximate),) * len(lights))

    for degree in DEGREES:
        yield basis(f"SH degree {degree}", 3 * (degree + 1) ** 2, Harmonics(directions, degree).approximate)
    for together, counts, name in (
        (False, LEARNED_APART, "learned, channels apart"),
        (True, LEARNED_TOGETHER, "learned"),
    ):
        learned = LearnedBasis(training, max(counts), together)
        for count in counts:
            yield basis(name, count if together else 3 * count, learned.of(count))
    others = [np.concatenate(lights[:at] + lights[at + 1 :]) for at in range(len(lights) * (len(lights) > 1))]
    if others:
        weighted = [LearnedBasis(training, max(LEARNED_TOGETHER), True, sky_norm(skies)) for skies in others]
        for count in LEARNED_TOGETHER:
            yield Basis(
                "learned, weighted by other skies",
                count,
                None,
                tuple(_of(learned.of(count)) for learned in weighted),
            )
    yield from _wavelets(basis, [np.sqrt((haar(skies) ** 2).mean(axis=(0, 2)))[:, None] for skies in others])
    if own_lobes:
        approximate = _with_own_lobes(directions)
        numbers = 27 + _NUMBERS_OF_A_GAUSSIAN * own_lobes
        yield Basis("SH degree 2 and the network's lobes", numbers, approximate, (approximate,) * len(lights))
    for degree in sorted({degree for degree, _ in GAUSSIANS}):
        numbers_of_gaussians = [count for own, count in GAUSSIANS if own == degree]
        fit = GaussianFit(directions, degree, max(numbers_of_gaussians))
        for count in numbers_of_gaussians:
            name = f"SH degree {degree}" if degree else "a constant"
            numbers = 3 * (degree + 1) ** 2 + _NUMBERS_OF_A_GAUSSIAN * count
            yield basis(f"{name} and {count} Gaussian{'s' * (count > 1)}", numbers, fit.of(count))


def _wavelets(basis: Callable[..., Basis], in_light: list[Array]) -> Iterator[Basis]:
    for count in WAVELETS:
        numbers = _NUMBERS_OF_A_WAVELET * count
        yield basis("Haar, the largest", numbers, partial(keep_largest, count=count))
        if in_light:
            under = tuple(_of(partial(keep_largest, count=count, light=light)) for light in in_light)
            yield Basis("Haar, the largest in other skies", numbers, None, under)


def _of(approximate: Callable[[Array], Array]) -> Approximation:
    return lambda values: approximate(values.fitted)


def _with_own_lobes(directions: Array) -> Approximation:
    harmonics = Harmonics(directions, 2)

    def approximate(values: Values) -> Array:
        assert values.lobes is not None
        return harmonics.approximate(values.fitted) + values.lobes

    return approximate


def measured(basis: Basis, values: Values, lights: list[Array], seed: int) -> Row:
    """The errors of a basis at values, and under each of `lights`, skies [T,M,3] in several rotations."""
    own, found = None, None
    first, second = values.checks
    if basis.of_transport is not None:
        found = basis.of_transport(values)
        own = _error(found - first, found - second, first, second, values.weights, seed)
    under = []
    for approximate, skies in zip(basis.under, lights, strict=True):
        approximated = approximate(values) if found is None else found
        shaded, one, other = (radiance(part, skies) for part in (approximated, first, second))
        under.append(_error(shaded - one, shaded - other, one, other, values.weights, seed))
    return Row(basis.name, basis.numbers, own, tuple(under))


def radiance(values: Array, skies: Array) -> Array:
    """Radiance [N,T,3] of values [N,M,3] under skies [T,M,3], by one product of matrices for the three channels."""
    channels = skies.shape[2]
    apart = np.einsum("tmc,cd->mctd", skies, np.eye(channels)).reshape(-1, len(skies) * channels)
    return np.asarray(values.reshape(len(values), -1) @ apart).reshape(len(values), len(skies), channels)


def _error(first_wrong: Array, second_wrong: Array, first: Array, second: Array, weights: Array, seed: int) -> Estimate:
    """The relative error by products of two differences [N,…] and of two estimates of what is right."""
    wrong, right = (
        weights * np.einsum("nij,nij->n", one, other) for one, other in ((first_wrong, second_wrong), (first, second))
    )
    return relative_error(wrong, right, seed)


def relative_error(wrong: Array, right: Array, seed: int) -> Estimate:
    """√(Σ wrong / Σ right) of squares [N] at N queries, with the interval of the bootstrap over queries."""
    again = np.random.default_rng(seed).integers(len(right), size=(_RESAMPLED, len(right)))
    ratios = _root_ratio(wrong[again].sum(axis=1), right[again].sum(axis=1))
    low, high = np.percentile(ratios, [2.5, 97.5])
    return Estimate(float(_root_ratio(wrong.sum(), right.sum())), float(low), float(high))


def _root_ratio(wrong: Array, right: Array) -> Array:
    """√(wrong / right); 0 where noise makes it negative, or where nothing is right."""
    ratio = np.divide(wrong, right, out=np.zeros(np.shape(right)), where=np.asarray(right) > 0.0)
    return np.asarray(np.sqrt(np.maximum(ratio, 0.0)))
