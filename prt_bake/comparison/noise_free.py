"""Metrics corrected for the noise of both pictures, with confidence intervals.

Squared metrics: (image − reference)² − variance is an unbiased estimate of the noise-free squared difference for every
distribution of the noise. Confidence intervals come from 256 interleaved subsets of the pixels. Each subset covers the
whole picture, so the variance between subsets is that of the noise, hardly that of the content.

FLIP and SSIM are biased by noise. Noise like that of the pictures is resampled (`prt_bake.comparison.noise`), and two
estimators remove the bias. *Simulation–extrapolation* (SIMEX, Cook and Stefanski 1994): adding noise once more doubles
its variance, and a line through both values extrapolates to a variance of zero. *Noise floor*: the metric of two equal
pictures with such noise is subtracted. Both use transforms in which the metric is about linear in the variance:
FLIP^(1/0.35), and for SSIM 1/SSIM and its logarithm, whose biases have opposite signs. Both are applied to the mean of
the whole picture, which suits uniform differences, and to means over blocks of 8×8 pixels, which suits local ones:
noise adds little to FLIP if the difference is large, and its full floor elsewhere. Negative values of blocks are kept
in the mean, which would otherwise be biased. The value is the mean of all estimates. The interval covers all estimates,
the variance of the resampled noise, and an uncertainty of a fifth of the noise floor; it is bounded by the uncorrected
metric.
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

_MAX_DRAWS, _MIN_DRAWS, _PIXELS_DRAWN = 8, 3, 1 << 18
"""Resampled noise pictures for FLIP and SSIM; their number falls with the size, towards a total of _PIXELS_DRAWN."""
_SIDE = 16
"""Subsets of pixels along each axis."""
_MAX_REFERENCE_NOISE = 0.15
"""Relative noise of a reference above which the bias of a divisor cannot be bounded."""
_POWER = 0.35
"""Exponent of mean FLIP of noise alone over its variance: 0.7 / 2, the power of colour differences in FLIP."""
_QUANTILE = 1.96
_BLUR = 1.5
"""Pixels: the blur of the noise-free picture for the noise floor."""
_MIN_SSIM = 1e-3
_BLOCK = 8
"""Pixels along a side."""
_FLOOR_UNCERTAINTY = 0.2
"""Relative, in the linear transform; measured as a tenth."""


@dataclass(frozen=True)
class NoiseFree:
    """Metrics corrected for noise, and the noise floor.

    Attributes:
        figures: values with 95 % intervals by the names of `Comparison`; FLIP and SSIM only for independent noise.
        of_noise: the noise floor: the metrics of two equal pictures with such noise.
    """

    figures: dict[str, Interval]
    of_noise: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
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
    """The metrics of `prt_bake.comparison.metrics.compare`, corrected for noise; HDR-FLIP over the exposures `hdr`.

    The error of a bake (`PixelErrors.shared`) is corrected in squared metrics only, by its variance. Their intervals
    cover the case that the errors of all pixels are perfectly correlated. FLIP and SSIM include this error.

    Raises as `compare`, and QueryError if errors and pictures differ in size.
    """
    linear, linear_reference, chosen = checked(image, reference, mask, exposure)
    if errors.image.shape != linear.shape:
        raise QueryError(
            f"compare: expected errors of the pictures' shape {list(linear.shape)}, found {list(errors.image.shape)}"
        )
    scaled = errors.scaled(2.0**exposure)
    figures = _squared_metrics(linear, linear_reference, scaled, chosen, seed)
    floor = {"mse": float(scaled.variance[chosen].mean())}
    if scaled.independent:
        perceptual, floors = _perceptual_metrics(linear, linear_reference, scaled, chosen, hdr, seed)
        figures, floor = figures | perceptual, floor | floors
    return NoiseFree(figures, floor)


def _squared_metrics(
    image: Array, reference: Array, errors: PixelErrors, chosen: Mask, seed: int
) -> dict[str, Interval]:
    shared, count = errors.shared**2, _per_subset(np.ones(chosen.shape), chosen)
    squared = _per_subset(((image - reference) ** 2 - errors.variance).mean(axis=2), chosen)
    reference_squared = _per_subset((reference**2 - errors.reference**2).mean(axis=2), chosen)
    signal = float(reference_squared.sum() / count.sum())
    by_signal = 1.0 / signal if signal > 0.0 else float("nan")
    relative = _correct_shared(ratio(squared, reference_squared, seed), float(shared[chosen].mean()) * by_signal)
    weight = 1.0 / (reference**2 + RELATIVE_FLOOR**2)
    return {
        "mse": _correct_shared(ratio(squared, count, seed), float(shared[chosen].mean())),
        "relative_mse": _correct_shared(
            _relative_mse(image, reference, errors, chosen, seed), float((shared * weight)[chosen].mean())
        ),
        "relative_rmse": Interval(*(_root(bound) for bound in vars(relative).values())),
    }


def _relative_mse(image: Array, reference: Array, errors: PixelErrors, chosen: Mask, seed: int) -> Interval:
    """Squared difference over (reference² + 0.01²), corrected for noise.

    The bias by the reference's noise in the divisor is not corrected. The interval includes it to second order in the
    noise; above a relative noise of 15 % the interval has no bounds.
    """
    difference, variance, noise = image - reference, errors.variance, errors.reference**2
    weight = 1.0 / (reference**2 + RELATIVE_FLOOR**2)
    slope, curvature = -2.0 * reference * weight**2, (8.0 * reference**2 * weight - 2.0) * weight**2
    squared = difference**2 - variance
    # Bias of (d − n)² w(R + n) for noise n: the terms −2 d n · w' n and (d² + n² − noise) · ½ w'' n².
    bias = noise * (-2.0 * difference * slope + 0.5 * curvature * (squared + 2.0 * noise))
    weighted = _per_subset((squared * weight).mean(axis=2), chosen)
    count = _per_subset(np.ones(chosen.shape), chosen)
    found = ratio(weighted, count, seed)
    if float((noise * weight)[chosen].mean()) > _MAX_REFERENCE_NOISE**2:
        return Interval(found.value, np.nan, np.nan)
    correction = -float(np.where(noise * weight < 0.2**2, bias, 0.0)[chosen].mean())
    return Interval(found.value, found.low + min(correction, 0.0), found.high + max(correction, 0.0))


def _root(squared: float) -> float:
    return float(np.sqrt(max(squared, 0.0))) if np.isfinite(squared) else np.nan


def _per_subset(values: Array, chosen: Mask) -> Array:
    """Sums of values [H,W] over the chosen pixels of each interleaved subset; subsets without pixels are left out."""
    rows, columns = np.nonzero(chosen)
    subset = (rows % _SIDE) * _SIDE + columns % _SIDE
    sums = np.bincount(subset, values[chosen], _SIDE**2)
    return np.asarray(sums[np.bincount(subset, minlength=_SIDE**2) > 0])


def _correct_shared(squared: Interval, shared: float) -> Interval:
    """A mean square minus that of errors which pixels share, with the mean variance `shared`.

    By the triangle inequality such errors shift the root mean square by at most their own, which is below 1.96 standard
    errors in 95 % of the cases if all errors are perfectly correlated.
    """
    if not shared > 0.0:
        return squared
    reach = _QUANTILE * np.sqrt(shared)
    low, high = (np.sqrt(max(bound, 0.0)) if np.isfinite(bound) else np.nan for bound in (squared.low, squared.high))
    least = max(low - reach, 0.0) ** 2 if low > 0.0 else min(squared.low, 0.0) - shared
    return Interval(squared.value - shared, float(min(least, squared.value - shared)), float((high + reach) ** 2))


def _perceptual_metrics(
    image: Array, reference: Array, errors: PixelErrors, chosen: Mask, hdr: Exposures | None, seed: int
) -> tuple[dict[str, Interval], dict[str, float]]:
    """FLIP and SSIM corrected for noise, and their noise floors."""
    noise = NoiseLike(image, reference, errors, seed)
    smooth = _smooth(image, reference, errors)
    measured = _metrics_in_blocks(image, reference, chosen, hdr)
    doubled, floor = [], []
    for _ in range(int(np.clip(_PIXELS_DRAWN // chosen.size, _MIN_DRAWS, _MAX_DRAWS))):
        first, second = noise.draw()
        doubled.append(_metrics_in_blocks(image + first, reference + second, chosen, hdr))
        floor.append(_metrics_in_blocks(smooth + first, smooth + second, chosen, hdr))
    figures, floors = {}, {}
    for name, (means, shares) in measured.items():
        doubled_means, floor_means = (np.stack([draw[name][0] for draw in draws]) for draws in (doubled, floor))
        figures[name] = _extrapolate(means, doubled_means, floor_means, shares, _FLIP if "flip" in name else _SSIM)
        floors[name] = float((floor_means @ shares).mean()) if shares.size else float("nan")
    return figures, floors


def _metrics_in_blocks(
    image: Array, reference: Array, chosen: Mask, hdr: Exposures | None
) -> dict[str, tuple[Array, Array]]:
    """Means of each metric over the chosen pixels of blocks, and the blocks' shares of those pixels."""
    srgb, srgb_reference = to_srgb(image), to_srgb(reference)
    quarter = ssim_map(quartered(srgb), quartered(srgb_reference))
    figures = {
        "ssim": _block_means(ssim_map(srgb, srgb_reference), chosen, _BLOCK),
        "ssim_quarter": _block_means(quarter, quarter_mask(chosen), _BLOCK // 4),
        "flip": _block_means(flip_map(srgb, srgb_reference), chosen, _BLOCK),
    }
    if hdr is not None:
        figures["hdr_flip"] = _block_means(hdr_flip_map(image, reference, hdr), chosen, _BLOCK)
    return figures


def _block_means(values: NDArray[np.floating], chosen: Mask, side: int) -> tuple[Array, Array]:
    rows, columns = np.nonzero(chosen)
    block = (rows // side) * (values.shape[1] // side + 1) + columns // side
    counts = np.bincount(block)
    sums = np.bincount(block, values[chosen])
    filled = counts > 0
    return sums[filled] / counts[filled], counts[filled] / max(counts.sum(), 1)


def _smooth(image: Array, reference: Array, errors: PixelErrors) -> Array:
    """An approximately noise-free picture: both pictures, weighted by their inverse variance, and blurred."""
    variance, reference_variance = float((errors.image**2).mean()), float((errors.reference**2).mean())
    mixed = (image * reference_variance + reference * variance) / (variance + reference_variance)
    return np.asarray(gaussian_filter(mixed, (_BLUR, _BLUR, 0.0)))


class _Transform(NamedTuple):
    """A transform in which a metric is about linear in the variance of noise, and 0 for equal pictures; its inverse."""

    forward: Callable[[Array], Array]
    inverse: Callable[[Array], Array]


_FLIP = (
    _Transform(
        lambda flip: np.maximum(flip, 0.0) ** (1.0 / _POWER), lambda power: np.sign(power) * np.abs(power) ** _POWER
    ),
)
_SSIM = (
    _Transform(
        lambda ssim: 1.0 / np.maximum(ssim, _MIN_SSIM) - 1.0, lambda inverse: 1.0 / (1.0 + np.maximum(inverse, -0.5))
    ),
    _Transform(lambda ssim: -np.log(np.maximum(ssim, _MIN_SSIM)), lambda less: np.exp(-less)),
)


def _extrapolate(
    means: Array, doubled: Array, floor: Array, shares: Array, transforms: tuple[_Transform, ...]
) -> Interval:
    """A metric corrected for noise.

    means [n] over blocks; doubled [draws,n]: with the variance of the noise doubled; floor [draws,n]: of noise alone;
    shares [n]: of the blocks among the pixels.
    """
    if not shares.size or np.isnan(means).any():
        return Interval(float("nan"), float("nan"), float("nan"))
    overall = float(means @ shares), doubled @ shares, floor @ shares
    estimates = np.array(
        [
            estimate
            for transform in transforms
            for estimate in (
                *_block_estimates(means, doubled, floor, shares, transform),
                *_overall_estimates(*overall, transform),
            )
        ]
    )
    value, low, high = estimates[:, 0].mean(), estimates[:, 1].min(), estimates[:, 2].max()
    # On average noise increases the difference: the uncorrected metric is a bound.
    measured, margin = overall[0], _QUANTILE * float(overall[1].std(ddof=1))
    low, high = (low, min(high, measured + margin)) if transforms is _FLIP else (max(low, measured - margin), high)
    return Interval(*np.clip([value, low, high], 0.0, 1.0).tolist())


def _block_estimates(
    means: Array, doubled: Array, floor: Array, shares: Array, transform: _Transform
) -> Iterator[tuple[float, float, float]]:
    """Simulation–extrapolation and noise floor in each block: value, low and high of the mean."""
    single, twice, alone = (transform.forward(part) for part in (means, doubled, floor))
    uncertainty = _FLOOR_UNCERTAINTY * alone.mean(axis=0)
    for bias in (twice - single, alone):
        corrected = single - bias.mean(axis=0)
        value, *bounds = (
            float(transform.inverse(corrected + sign * uncertainty) @ shares) for sign in (0.0, -1.0, 1.0)
        )
        margin = _QUANTILE * float((transform.inverse(single - bias) @ shares).std(ddof=1))
        yield value, min(bounds) - margin, max(bounds) + margin


def _overall_estimates(
    mean: float, doubled: Array, floor: Array, transform: _Transform
) -> Iterator[tuple[float, float, float]]:
    """As `_block_estimates`, for the means over all pixels."""
    single, twice, alone = (transform.forward(part) for part in (np.array([mean]), doubled, floor))
    uncertainty = np.hypot(_FLOOR_UNCERTAINTY * alone.mean(), _QUANTILE * twice.std(ddof=1))
    for bias in (twice - single, alone):
        corrected = single - bias.mean()
        value, *bounds = (float(transform.inverse(corrected + sign * uncertainty)[0]) for sign in (0.0, -1.0, 1.0))
        yield value, min(bounds), max(bounds)
