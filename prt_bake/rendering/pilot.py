"""The pilot of a network's picture: it chooses the mixture of light and lobe with the least noise.

The pilot has separate random numbers and its samples are discarded, so that the picture stays unbiased.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from prt_bake.rendering.mixture import Mixture
from prt_bake.rendering.network_pass import NetworkTracer
from prt_bake.rendering.passes import PassTracer, pass_seed, random_subset

Array = NDArray[np.float64]

MAX_POINTS = 4
"""Points per pixel and pass."""
DIRECTIONS = 16
"""Directions per point, if there are enough samples. Another point costs as much as about eight directions, and within
a pixel the light changes less between points than between directions."""
_PASSES = 8
"""Passes of a picture, if there are enough samples, for a reliable error."""
_MIN_SHARE = 0.05
_TRUSTS = (0.125, 1.0, 8.0, 64.0)
_DEFAULT_TRUST = 8.0
"""With nearly all directions from the light: less noise than trust 64 under each of six skies."""
_PILOT_SEED = 0x51107
_PILOT_PASSES = 4
_PILOT_COST = 0.03
"""Share of the picture's evaluations."""
_PILOT_PIXELS = (64, 1024)
_CONFIDENCE = 3.0
"""Standard errors by which the noise of a mixture must be lower than that of the default: the minimum of many estimates
is biased, and a few pixels say nothing about a lamp that lobes rarely hit."""
_DEFAULT_SPP = 256
_POINT_COST, _LIGHT_COST, _LOBE_COST = 8.0, 1.15, 1.3
"""Costs of a point and of its directions, in evaluations of the network."""


def default_mixture(spp: int | None, sampling: str) -> Mixture:
    """The mixture of a picture of `spp` samples per pixel: the lobe for sampling "lobe", else the light.

    Directions per point grow first, then points, then passes.
    """
    per_pass = max(1, (spp or _DEFAULT_SPP) // _PASSES)
    points = min(MAX_POINTS, max(1, per_pass // DIRECTIONS))
    all_directions, no_directions = (min(DIRECTIONS, per_pass // points),) * points, (0,) * points
    return Mixture(no_directions, all_directions) if sampling == "lobe" else Mixture(all_directions, no_directions)


def candidates(default: Mixture) -> list[Mixture]:
    """Mixtures with at least 5 % of each method, from nearly all light to nearly all lobe.

    In all but one the larger number is that of `default`: low-discrepancy sequences are best at powers of two, and
    removing a few members costs more than their number. Each point gets a direction from the light, since lobes miss
    suns.
    """
    points, total = default.points, default.samples
    least = max(1, int(np.ceil(_MIN_SHARE * total / (1.0 - _MIN_SHARE))))
    half = total // 2
    counts = [(total, least), (total, max(total // 4, least)), (max(total // 4, points), total)]
    if half >= points:
        counts.insert(2, (half, half))
    return [Mixture(_distribute(light, points), _distribute(lobe, points)) for light, lobe in counts]


def _distribute(directions: int, points: int) -> tuple[int, ...]:
    """Directions per point of a pixel."""
    return tuple(directions // points + (point < directions % points) for point in range(points))


def choose_mixture(passes: PassTracer, tracer: NetworkTracer, spp: int | None, seed: int) -> Mixture:
    """The candidate with the least variance times cost, over a sample of the pixels that the object covers.

    The default, nearly all light, is replaced only by a candidate whose noise is significantly lower. Candidates have
    as many points as the tracer's mixture. All are subsets of one set of directions, which is evaluated once. `tracer`
    keeps that set.
    """
    choices = candidates(tracer.mixture)
    light, lobe = (_maxima([getattr(choice, method) for choice in choices]) for method in ("light", "lobe"))
    tracer.set_mixture(Mixture(light, lobe))
    covered = passes.pixels_on_object()
    budget = _PILOT_COST * len(covered) * (spp or _DEFAULT_SPP) / (_PILOT_PASSES * tracer.samples)
    pixels = random_subset(covered, int(np.clip(budget, *_PILOT_PIXELS)), seed)
    if not len(pixels):
        return choices[0]
    mixtures = [replace(choice, trust=trust) for choice in choices for trust in _TRUSTS]
    costs = [
        _POINT_COST * mixture.points + _LIGHT_COST * sum(mixture.light) + _LOBE_COST * sum(mixture.lobe)
        for mixture in mixtures
    ]
    noise = _variances(passes, tracer, pixels, seed, tuple(mixtures)) * np.array(costs)[:, None]
    return mixtures[significantly_least(noise, _TRUSTS.index(_DEFAULT_TRUST))]


def significantly_least(noise: Array, default: int) -> int:
    """The row of noise [M,P] at P pixels with the least mean, or `default` unless another is significantly lower."""
    mean = noise.mean(axis=1)
    if not mean[default] > 0.0:
        return default
    # The standard error of a ratio of means is that of the residuals, for any correlation between pixels; the residuals
    # of the default row are zero.
    residuals = noise - np.outer(mean / mean[default], noise[default])
    bound = mean + _CONFIDENCE * residuals.std(axis=1) / np.sqrt(noise.shape[1])
    return int(np.argmin(bound))


def _maxima(counts: list[tuple[int, ...]]) -> tuple[int, ...]:
    return tuple(max(per_point) for per_point in zip(*counts, strict=True))


def _variances(
    passes: PassTracer, tracer: NetworkTracer, pixels: NDArray[np.int64], seed: int, mixtures: tuple[Mixture, ...]
) -> Array:
    """Variances [M,P] of one pass at each pixel, the mean over channels, for each mixture."""
    means = []
    for number in range(_PILOT_PASSES):
        number_seed = pass_seed(seed ^ _PILOT_SEED, number)
        points = passes.points(pixels, number_seed)
        radiance, _evaluations = tracer.radiance_by_mixtures(points.on_object(), number_seed, mixtures)
        means.append(points.pixel_means(radiance))
    return np.asarray(np.var(means, axis=0, ddof=1).mean(axis=2))
