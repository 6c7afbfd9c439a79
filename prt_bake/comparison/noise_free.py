"""How far a picture would be from its reference if neither had noise, each figure with its interval.

Squares: (image − reference)² − variance has the expectation of the squared difference without noise, whatever the
noise's distribution. Intervals come from 256 interleaved subsets of the pixels, each of which sees the whole picture:
they scatter by the noise, hardly by what the picture shows.

FLIP and SSIM are no squares: noise is seen as difference. Noise like that of the pictures is drawn again
(`prt_bake.comparison.noise`), and two ways lead back to none. *Renoised* (simulation and extrapolation, Cook and
Stefanski 1994): with noise added once more its variance is doubled, and a line through both leads to none. *Floor*:
what two equal pictures would have of such noise alone is taken off. Both are done where the figure grows about linearly
with the variance: FLIP^(1/0.35), and of SSIM 1/SSIM and its logarithm, which err to opposite sides; and both for the
mean of the whole picture, which is right where the pictures differ by about as much everywhere, and for means over
blocks of 8×8 pixels, which is right where they differ here and there: noise adds little to FLIP where the difference is
large, and all of itself elsewhere. (What comes out below nothing in a block stays so in their mean, or noise would
never come out as none.) The value is the mean of all ways; the interval spans them, how far single draws scatter, and a
fifth of what noise alone makes, known no better, but not more difference than is seen with the noise.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from formats.errors import QueryError
from formats.image.png import to_srgb
from prt_bake.comparison.flip import Exposures, flip_map, hdr_flip_map
from prt_bake.comparison.metrics import RELATIVE_FLOOR, checked, quarter_mask, quartered, ssim_map
from prt_bake.comparison.noise import NoiseLike, PixelErrors
from prt_bake.mathematics.noise_free import Interval, ratio

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MOST_DRAWS, _FEWEST_DRAWS, _PIXELS_DRAWN = 8, 3, 1 << 18
"""Of noise, for FLIP and SSIM: fewer of larger pictures, whose means scatter less, towards so many pixels in all."""
_SIDE = 16
"""Subsets of pixels along each axis."""
_TOO_NOISY = 0.15
"""Relative noise of a reference whose noise in a divisor cannot be told."""
_POWER = 0.35
"""With which mean FLIP of noise alone grows with its variance: 0.7 / 2, the power of colour differences in FLIP."""
_SIGMAS = 1.96
_BLUR = 1.5
"""Pixels: what stands for a picture without noise where the floor is measured."""
_LEAST_SSIM = 1e-3
_BLOCK = 8
"""Pixels along a side."""
_FLOOR_KNOWN = 0.2
"""Relative uncertainty of what noise alone makes, where it grows linearly with the variance; measured as a tenth."""


@dataclass(frozen=True)
class NoiseFree:
    """Figures without noise, and what the noise alone makes.

    Attributes:
        figures: intervals by the names of `Comparison`; of FLIP and SSIM only where pixels have noise of their own.
        of_noise: what two equal pictures would have of such noise.
    """

    figures: dict[str, Interval]
    of_noise: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**{name: figure.as_json() for name, figure in self.figures.items()}, "of_noise": self.of_noise}


def compare_without_noise(
    image: Any,
    reference: Any,
    errors: PixelErrors,
    mask: Any = None,
    exposure: float = 0.0,
    *,
    hdr: Exposures | None = None,
    seed: int = 0,
) -> NoiseFree:
    """The figures of `prt_bake.comparison.metrics.compare` with the noise taken out; HDR-FLIP over the exposures `hdr`.

    The error that a bake has left (`PixelErrors.shared`) is taken out of the squares alone, by its variance, and their
    intervals reach as far as it may carry them if all pixels err together; in FLIP and SSIM it stays.

    Raises as `compare`, and QueryError where errors and pictures differ in size.
    """
    ours, theirs, chosen = checked(image, reference, mask, exposure)
    if errors.image.shape != ours.shape:
        raise QueryError(
            f"compare: errors of shape {list(errors.image.shape)} where the pictures' {list(ours.shape)} is expected"
        )
    scaled = errors.scaled(2.0**exposure)
    figures, of_noise = _squares(ours, theirs, scaled, chosen, seed), {"mse": float(scaled.variance[chosen].mean())}
    if scaled.independent:
        seen, floors = _seen(ours, theirs, scaled, chosen, hdr, seed)
        figures, of_noise = figures | seen, of_noise | floors
    return NoiseFree(figures, of_noise)


def _squares(ours: Array, theirs: Array, errors: PixelErrors, chosen: Mask, seed: int) -> dict[str, Interval]:
    shared, count = errors.shared**2, _per_subset(np.ones(chosen.shape), chosen)
    squared = _per_subset(((ours - theirs) ** 2 - errors.variance).mean(axis=2), chosen)
    value = _per_subset((theirs**2 - errors.reference**2).mean(axis=2), chosen)
    signal = float(value.sum() / count.sum())
    by_signal = 1.0 / signal if signal > 0.0 else float("nan")
    whole = _correlated(ratio(squared, value, seed), float(shared[chosen].mean()) * by_signal)
    weight = 1.0 / (theirs**2 + RELATIVE_FLOOR**2)
    return {
        "mse": _correlated(ratio(squared, count, seed), float(shared[chosen].mean())),
        "relative_mse": _correlated(
            _relative(ours, theirs, errors, chosen, seed), float((shared * weight)[chosen].mean())
        ),
        "relative_rmse": Interval(*(_root(bound) for bound in vars(whole).values())),
    }


def _relative(ours: Array, theirs: Array, errors: PixelErrors, chosen: Mask, seed: int) -> Interval:
    """Squared difference over (reference² + 0.01²) without noise.

    The reference's noise is in the divisor too and stays there; the interval reaches to the figure without it, to
    second order in noise, and has no ends where that says nothing: at noise above 15 %.
    """
    difference, variance, noise = ours - theirs, errors.variance, errors.reference**2
    weight = 1.0 / (theirs**2 + RELATIVE_FLOOR**2)
    slope, bend = -2.0 * theirs * weight**2, (8.0 * theirs**2 * weight - 2.0) * weight**2
    squared = difference**2 - variance
    # E of (d − n)² w(R + n) for noise n: −2 d n meets w' n, and d² + n² − noise meets half of w'' n².
    excess = noise * (-2.0 * difference * slope + 0.5 * bend * (squared + 2.0 * noise))
    plain = _per_subset((squared * weight).mean(axis=2), chosen)
    count = _per_subset(np.ones(chosen.shape), chosen)
    found = ratio(plain, count, seed)
    if float((noise * weight)[chosen].mean()) > _TOO_NOISY**2:
        return Interval(found.value, np.nan, np.nan)
    off = -float(np.where(noise * weight < 0.2**2, excess, 0.0)[chosen].mean())
    return Interval(found.value, found.low + min(off, 0.0), found.high + max(off, 0.0))


def _root(squared: float) -> float:
    return float(np.sqrt(max(squared, 0.0))) if np.isfinite(squared) else np.nan


def _per_subset(values: Array, chosen: Mask) -> Array:
    """Sums of values [H,W] over the chosen pixels of each interleaved subset that has any."""
    rows, columns = np.nonzero(chosen)
    subset = (rows % _SIDE) * _SIDE + columns % _SIDE
    sums = np.bincount(subset, values[chosen], _SIDE**2)
    return np.asarray(sums[np.bincount(subset, minlength=_SIDE**2) > 0])


def _correlated(squared: Interval, shared: float) -> Interval:
    """A mean square less that of errors which pixels share, `shared` on average.

    By the triangle inequality their root mean square shifts that of the difference by at most itself; all in step, it
    is 1.96 sigma 19 times in 20.
    """
    if not shared > 0.0:
        return squared
    reach = _SIGMAS * np.sqrt(shared)
    low, high = (np.sqrt(max(bound, 0.0)) if np.isfinite(bound) else np.nan for bound in (squared.low, squared.high))
    least = max(low - reach, 0.0) ** 2 if low > 0.0 else min(squared.low, 0.0) - shared
    return Interval(squared.value - shared, float(min(least, squared.value - shared)), float((high + reach) ** 2))


def _seen(
    ours: Array, theirs: Array, errors: PixelErrors, chosen: Mask, hdr: Exposures | None, seed: int
) -> tuple[dict[str, Interval], dict[str, float]]:
    """FLIP and SSIM without noise, and of noise alone."""
    noise = NoiseLike(ours, theirs, errors, seed)
    smooth = _smooth(ours, theirs, errors)
    found = _blocks(ours, theirs, chosen, hdr)
    doubled, alone = [], []
    for _ in range(int(np.clip(_PIXELS_DRAWN // chosen.size, _FEWEST_DRAWS, _MOST_DRAWS))):
        first, second = noise.draw()
        doubled.append(_blocks(ours + first, theirs + second, chosen, hdr))
        alone.append(_blocks(smooth + first, smooth + second, chosen, hdr))
    figures, floors = {}, {}
    for name, (means, shares) in found.items():
        of_doubled, of_noise = (np.stack([d[name][0] for d in draws]) for draws in (doubled, alone))
        figures[name] = _to_none(means, of_doubled, of_noise, shares, _FLIP if "flip" in name else _SSIM)
        floors[name] = float((of_noise @ shares).mean()) if shares.size else float("nan")
    return figures, floors


def _blocks(ours: Array, theirs: Array, chosen: Mask, hdr: Exposures | None) -> dict[str, tuple[Array, Array]]:
    """Means of each figure over the chosen pixels of blocks, and the blocks' shares of those pixels."""
    shown, wanted = to_srgb(ours), to_srgb(theirs)
    figures = {
        "ssim": _in_blocks(ssim_map(shown, wanted), chosen, _BLOCK),
        "ssim_quarter": _in_blocks(ssim_map(quartered(shown), quartered(wanted)), quarter_mask(chosen), _BLOCK // 4),
        "flip": _in_blocks(flip_map(shown, wanted), chosen, _BLOCK),
    }
    if hdr is not None:
        figures["hdr_flip"] = _in_blocks(hdr_flip_map(ours, theirs, hdr), chosen, _BLOCK)
    return figures


def _in_blocks(values: NDArray[np.floating], chosen: Mask, side: int) -> tuple[Array, Array]:
    rows, columns = np.nonzero(chosen)
    block = (rows // side) * (values.shape[1] // side + 1) + columns // side
    counts = np.bincount(block)
    sums = np.bincount(block, values[chosen])
    filled = counts > 0
    return sums[filled] / counts[filled], counts[filled] / max(counts.sum(), 1)


def _smooth(ours: Array, theirs: Array, errors: PixelErrors) -> Array:
    """The less noisy picture for the most part, blurred: it stands for what both would show without noise."""
    image, reference = float((errors.image**2).mean()), float((errors.reference**2).mean())
    mixed = (ours * reference + theirs * image) / (image + reference)
    return np.asarray(gaussian_filter(mixed, (_BLUR, _BLUR, 0.0)))


class _Straight(NamedTuple):
    """A measure of a figure that grows about linearly with the noise's variance, 0 at no difference; and back."""

    to: Callable[[Array], Array]
    back: Callable[[Array], Array]


_FLIP = (
    _Straight(
        lambda flip: np.maximum(flip, 0.0) ** (1.0 / _POWER), lambda power: np.sign(power) * np.abs(power) ** _POWER
    ),
)
_SSIM = (
    _Straight(
        lambda ssim: 1.0 / np.maximum(ssim, _LEAST_SSIM) - 1.0, lambda inverse: 1.0 / (1.0 + np.maximum(inverse, -0.5))
    ),
    _Straight(lambda ssim: -np.log(np.maximum(ssim, _LEAST_SSIM)), lambda less: np.exp(-less)),
)


def _to_none(means: Array, doubled: Array, alone: Array, shares: Array, measures: tuple[_Straight, ...]) -> Interval:
    """A figure without noise from its means over blocks [n], those with its noise once more and those of noise alone
    [draws,n], and the blocks' shares [n] of the pixels.
    """
    if not shares.size or np.isnan(means).any():
        return Interval(float("nan"), float("nan"), float("nan"))
    whole = float(means @ shares), doubled @ shares, alone @ shares
    ways = np.array(
        [
            way
            for measure in measures
            for way in (*_by_block(means, doubled, alone, shares, measure), *_as_a_whole(*whole, measure))
        ]
    )
    value, low, high = ways[:, 0].mean(), ways[:, 1].min(), ways[:, 2].max()
    # On average noise adds difference: what is seen with it bounds what there is without.
    seen, scatter = whole[0], _SIGMAS * float(whole[1].std(ddof=1))
    low, high = (low, min(high, seen + scatter)) if measures is _FLIP else (max(low, seen - scatter), high)
    return Interval(*np.clip([value, low, high], 0.0, 1.0).tolist())


def _by_block(
    means: Array, doubled: Array, alone: Array, shares: Array, measure: _Straight
) -> Iterator[tuple[float, float, float]]:
    """Renoised and from the floor in each block: value, low and high of the mean."""
    here, twice, floor = (measure.to(part) for part in (means, doubled, alone))
    unsure = _FLOOR_KNOWN * floor.mean(axis=0)
    for noise in (twice - here, floor):
        less = here - noise.mean(axis=0)
        value, *bounds = (float(measure.back(less + by * unsure) @ shares) for by in (0.0, -1.0, 1.0))
        scatter = _SIGMAS * float((measure.back(here - noise) @ shares).std(ddof=1))
        yield value, min(bounds) - scatter, max(bounds) + scatter


def _as_a_whole(mean: float, doubled: Array, alone: Array, measure: _Straight) -> Iterator[tuple[float, float, float]]:
    """The same of the means over all pixels."""
    here, twice, floor = measure.to(np.array([mean])), measure.to(doubled), measure.to(alone)
    unsure = np.hypot(_FLOOR_KNOWN * floor.mean(), _SIGMAS * twice.std(ddof=1))
    for noise in (twice - here, floor):
        less = here - noise.mean()
        value, *bounds = (float(measure.back(less + by * unsure)[0]) for by in (0.0, -1.0, 1.0))
        yield value, min(bounds), max(bounds)
