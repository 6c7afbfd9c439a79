"""How a network's picture is sampled: the mixture of light and lobe, chosen by a short pilot for the least noise.

The pilot's numbers are its own and its samples are thrown away, so that the picture stays unbiased.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from prt_bake.renderer.mixture import Mixture
from prt_bake.renderer.network_pass import NetworkTracer
from prt_bake.renderer.passes import PassTracer, pass_seed, some_of

Array = NDArray[np.float64]

POINTS = 4
"""Points of a pixel in a pass."""
MOST_DIRECTIONS = 16
_USUAL_DIRECTIONS = 8
_PASSES = 8
"""A picture has at least so many, where it may, for its error to be trusted."""
_LEAST_SHARE = 0.05
_TRUSTS = (0.125, 1.0, 8.0, 64.0)
_PILOT_SEED = 0x51107
_PILOT_PASSES = 4
_PILOT_COST = 0.03
"""Of the picture's evaluations."""
_PILOT_PIXELS = (32, 1024)
_CLEARLY = 0.9
"""A mixture must promise at most this much of the purest ones' noise: the least of many estimates flatters."""
_USUAL_SPP = 256
_LIGHT_COST, _LOBE_COST = 1.15, 1.3
"""A direction's, in evaluations of the network."""


def directions_a_point(spp: int | None) -> int:
    """How many directions each point of a pixel gets in a pass: the more, the more evenly they lie."""
    if spp is None:
        return _USUAL_DIRECTIONS
    return max(1, min(MOST_DIRECTIONS, spp // (POINTS * _PASSES)))


def plain_mixture(directions: int, sampling: str) -> Mixture:
    """All from the lobe where it is asked for alone, else all from the light."""
    every, none = (directions,) * POINTS, (0,) * POINTS
    return Mixture(none, every) if sampling == "lobe" else Mixture(every, none)


def candidates(directions: int) -> list[Mixture]:
    """Mixtures with at least 5 % of each, from nearly all of the light to nearly all of the lobe.

    The larger number is the same in all but one: evenly placed numbers lie best in powers of two, and a few of them
    taken away cost more than those few. Each point gets a direction from the light: no lobe meets a sun.
    """
    whole = POINTS * directions
    least = max(1, int(np.ceil(_LEAST_SHARE * whole / (1.0 - _LEAST_SHARE))))
    half = whole // 2
    counts = [(whole, least), (whole, max(whole // 4, least)), (max(whole // 4, POINTS), whole)]
    if directions > 1:
        counts.insert(2, (half, half))
    return [Mixture(_spread(light), _spread(lobe)) for light, lobe in counts]


def _spread(directions: int) -> tuple[int, ...]:
    """Over the points of a pixel."""
    return tuple(directions // POINTS + (point < directions % POINTS) for point in range(POINTS))


def choose_mixture(passes: PassTracer, tracer: NetworkTracer, directions: int, spp: int | None, seed: int) -> Mixture:
    """The candidate of least variance times cost, over some of the pixels that show the object.

    All candidates are parts of one set of directions, which is evaluated once. `tracer` is left with that set.
    """
    choices = candidates(directions)
    tracer.mix(Mixture(_most([choice.light for choice in choices]), _most([choice.lobe for choice in choices])))
    covered = passes.covered()
    budget = _PILOT_COST * len(covered) * (spp or _USUAL_SPP) / (_PILOT_PASSES * tracer.samples)
    pixels = some_of(covered, int(np.clip(budget, *_PILOT_PIXELS)), seed)
    if not len(pixels):
        return choices[0]
    trusted = [replace(choice, trust=trust) for choice in choices for trust in _TRUSTS]
    costs = [_LIGHT_COST * sum(choice.light) + _LOBE_COST * sum(choice.lobe) for choice in trusted]
    noise = _variances(passes, tracer, pixels, seed, tuple(trusted)) * costs
    purest = [len(_TRUSTS) - 1, len(trusted) - len(_TRUSTS)]
    pure, best = min(purest, key=lambda i: noise[i]), int(np.argmin(noise))
    return trusted[best] if noise[best] < _CLEARLY * noise[pure] else trusted[pure]


def _most(counts: list[tuple[int, ...]]) -> tuple[int, ...]:
    return tuple(max(of_point) for of_point in zip(*counts, strict=True))


def _variances(
    passes: PassTracer, tracer: NetworkTracer, pixels: NDArray[np.int64], seed: int, mixtures: tuple[Mixture, ...]
) -> Array:
    """Of one pass, the mean over pixels and channels, by each mixture [M]."""
    seen = []
    for number in range(_PILOT_PASSES):
        one = pass_seed(seed ^ _PILOT_SEED, number)
        points = passes.points(pixels, one)
        radiance, _evaluations = tracer.radiance_by(*points.on_object(), one, mixtures)
        seen.append(points.pixel_means(radiance))
    return np.asarray(np.var(seen, axis=0, ddof=1).mean(axis=(1, 2)))
