"""How a network's picture is sampled: the mixture of light and lobe, chosen by a short pilot for the least noise.

The pilot's numbers are its own and its samples are thrown away, so that the picture stays unbiased.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from prt_bake.rendering.mixture import Mixture
from prt_bake.rendering.network_pass import NetworkTracer
from prt_bake.rendering.passes import PassTracer, pass_seed, some_of

Array = NDArray[np.float64]

MOST_POINTS = 4
"""Of a pixel in a pass."""
DIRECTIONS = 16
"""Of a point, where that many are asked for: to look at another point costs as much as about eight directions, and
within a pixel the light changes less from point to point than from one direction to the next."""
_PASSES = 8
"""A picture has at least so many, where it may, for its error to be trusted."""
_LEAST_SHARE = 0.05
_TRUSTS = (0.125, 1.0, 8.0, 64.0)
_USUAL_TRUST = 8.0
"""With nearly all of the light: less noise than trust 64 under each of six skies."""
_PILOT_SEED = 0x51107
_PILOT_PASSES = 4
_PILOT_COST = 0.03
"""Of the picture's evaluations."""
_PILOT_PIXELS = (64, 1024)
_SURELY = 3.0
"""Standard errors by which a mixture must promise less noise than the light nearly alone: the least of many estimates
flatters, and of a lamp that lobes seldom meet a few pixels know nothing."""
_USUAL_SPP = 256
_POINT_COST, _LIGHT_COST, _LOBE_COST = 8.0, 1.15, 1.3
"""Of a point and of its directions, in evaluations of the network for one direction more."""


def plain_mixture(spp: int | None, sampling: str) -> Mixture:
    """What a pass of a picture of `spp` samples a pixel draws: from the lobe where that is asked for alone, else from
    the light.

    Few points with many directions each, then more points; further samples make more passes.
    """
    a_pass = max(1, (spp or _USUAL_SPP) // _PASSES)
    points = min(MOST_POINTS, max(1, a_pass // DIRECTIONS))
    every, none = (min(DIRECTIONS, a_pass // points),) * points, (0,) * points
    return Mixture(none, every) if sampling == "lobe" else Mixture(every, none)


def candidates(plain: Mixture) -> list[Mixture]:
    """Mixtures with at least 5 % of each, from nearly all of the light to nearly all of the lobe.

    The larger number is the same in all but one: evenly placed numbers lie best in powers of two, and a few of them
    taken away cost more than those few. Each point gets a direction from the light: no lobe meets a sun. `plain` says
    how many points and directions there are.
    """
    points, whole = plain.points, plain.samples
    least = max(1, int(np.ceil(_LEAST_SHARE * whole / (1.0 - _LEAST_SHARE))))
    half = whole // 2
    counts = [(whole, least), (whole, max(whole // 4, least)), (max(whole // 4, points), whole)]
    if half >= points:
        counts.insert(2, (half, half))
    return [Mixture(_spread(light, points), _spread(lobe, points)) for light, lobe in counts]


def _spread(directions: int, points: int) -> tuple[int, ...]:
    """Over the points of a pixel."""
    return tuple(directions // points + (point < directions % points) for point in range(points))


def choose_mixture(passes: PassTracer, tracer: NetworkTracer, spp: int | None, seed: int) -> Mixture:
    """The candidate of least variance times cost, over some of the pixels that show nothing but the object.

    That is nearly all of the light, unless another is surely less noisy. Candidates have as many points as the tracer's
    own mixture. All are parts of one set of directions, which is evaluated once. `tracer` is left with that set.
    """
    choices = candidates(tracer.mixture)
    tracer.mix(Mixture(_most([choice.light for choice in choices]), _most([choice.lobe for choice in choices])))
    covered = passes.covered()
    budget = _PILOT_COST * len(covered) * (spp or _USUAL_SPP) / (_PILOT_PASSES * tracer.samples)
    pixels = some_of(covered, int(np.clip(budget, *_PILOT_PIXELS)), seed)
    if not len(pixels):
        return choices[0]
    trusted = [replace(choice, trust=trust) for choice in choices for trust in _TRUSTS]
    costs = [
        _POINT_COST * choice.points + _LIGHT_COST * sum(choice.light) + _LOBE_COST * sum(choice.lobe)
        for choice in trusted
    ]
    noise = _variances(passes, tracer, pixels, seed, tuple(trusted)) * np.array(costs)[:, None]
    return trusted[surely_least(noise, _TRUSTS.index(_USUAL_TRUST))]


def surely_least(noise: Array, usual: int) -> int:
    """The row of noise [M,P], known at some pixels, of least mean; `usual`, unless another is surely below that."""
    mean = noise.mean(axis=1)
    if not mean[usual] > 0.0:
        return usual
    # The ratio of two means has the spread of the residuals about it, whatever the pixels have in common; the usual
    # row's own are zero.
    residuals = noise - np.outer(mean / mean[usual], noise[usual])
    bound = mean + _SURELY * residuals.std(axis=1) / np.sqrt(noise.shape[1])
    return int(np.argmin(bound))


def _most(counts: list[tuple[int, ...]]) -> tuple[int, ...]:
    return tuple(max(of_point) for of_point in zip(*counts, strict=True))


def _variances(
    passes: PassTracer, tracer: NetworkTracer, pixels: NDArray[np.int64], seed: int, mixtures: tuple[Mixture, ...]
) -> Array:
    """Of one pass at each pixel, the mean over channels, by each mixture [M,P]."""
    seen = []
    for number in range(_PILOT_PASSES):
        one = pass_seed(seed ^ _PILOT_SEED, number)
        points = passes.points(pixels, one)
        radiance, _evaluations = tracer.radiance_by(*points.on_object(), one, mixtures)
        seen.append(points.pixel_means(radiance))
    return np.asarray(np.var(seen, axis=0, ddof=1).mean(axis=2))
