"""Suns on a baked asset: the sky is shaded by harmonics, suns by a maximum-entropy reconstruction of the transport.

An asset stores a few harmonics of its transport. Under a sun their sum rings: vertices that the sun does not reach glow
or become negative. Damping the harmonics of the light would blur the sun. Suns are therefore taken out of the skies
(`prt_bake.lights.sun_detection`) and shaded by the maximum-entropy reconstruction with the same harmonics
(`maximum_entropy`). Directional lights up to the width of a sun are shaded in the same way.

Radiance is linear in the scale of the light and additive in suns. It is additive in skies if the same suns are found in
their sum. It is not linear in the asset's coefficients.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.errors import QueryError, refuse_path
from formats.scene.lights import DirectionalLight
from formats.summary import summary
from prt_bake.lights.deringing import windowed
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, solid_angle
from prt_bake.lights.sun_detection import WIDEST, split_lighting
from prt_bake.mathematics.sphere import BinCoordinates, tangent_frame, to_world

Array = NDArray[np.float64]
SunTreatment = Literal["split", "window", "plain"]
"""split: suns are shaded separately, by maximum entropy. window: their harmonics are damped until they are nowhere
negative. plain: they stay in the harmonics."""

_POINT = 2.0
"""Degrees; narrower discs are treated as a point."""


@dataclass(frozen=True, eq=False)
class SunsApart:
    """A lighting divided for an asset.

    Attributes:
        harmonics: [K,3], the light to shade by harmonics.
        suns: to shade separately.
        whole: [K,3], harmonics of all the light, undamped.
        found: the number of suns, for every treatment.
    """

    harmonics: Array
    suns: tuple[DirectionalLight, ...]
    whole: Array
    found: int

    __repr__ = summary


def suns_apart(lighting: Lighting, degree: int, treatment: SunTreatment = "split") -> SunsApart:
    """Divide a lighting into harmonics and suns for an asset of a degree. Raises QueryError for an unknown treatment.

    >>> import prt_bake as prt
    >>> light = prt.suns_apart(prt.read_lighting("sun:0,1,0:3,3,3:0.5"), degree=2)
    >>> light.harmonics.shape, len(light.suns)
    ((9, 3), 1)
    """
    refuse_path("lighting", lighting, "prt.read_lighting")
    if treatment not in get_args(SunTreatment):
        raise QueryError(f"suns: expected {', '.join(map(repr, get_args(SunTreatment)))}, found {treatment!r}")
    # A constant light does not ring.
    split = lighting if degree == 0 else split_lighting(lighting)
    suns = tuple(sun for sun in split.suns if sun.angular_diameter <= WIDEST)
    if treatment == "plain" or degree == 0 or (split is lighting and not suns):
        whole = project_lighting(lighting, degree)
        return SunsApart(whole, (), whole, len(suns) if degree else 0)
    wide = tuple(sun for sun in split.suns if sun.angular_diameter > WIDEST)
    rest = np.zeros(((degree + 1) ** 2, 3))
    if split.skies or wide:
        rest = project_lighting(Lighting(split.skies, wide), degree)
    each = [project_lighting(Lighting((), (sun,)), degree) for sun in suns]
    whole = rest + sum(each)
    if treatment == "window":
        return SunsApart(rest + sum(windowed(sun) for sun in each), (), whole, len(suns))
    return SunsApart(rest, suns, whole, len(suns))


def sun_radiance(
    asset: Asset, suns: Sequence[DirectionalLight], vertices: NDArray[np.int64], at: BinCoordinates
) -> Array:
    """Radiance [n,3] of `vertices` [n] (ascending) towards the eye under suns alone; `at` as in `reconstruct`.

    It is negative only if the mean transport of the vertex is.
    """
    return np.asarray(radiance_of_each_sun(asset, suns, vertices, at).sum(axis=0))


def radiance_of_each_sun(
    asset: Asset, suns: Sequence[DirectionalLight], vertices: NDArray[np.int64], at: BinCoordinates
) -> Array:
    """The parts [S,n,3] of each sun in `sun_radiance`."""
    from prt_bake.shading.maximum_entropy import fit_maximum_entropy

    radiance = np.zeros((len(suns), len(vertices), 3))
    if not suns or not len(vertices):
        return radiance
    fitted = fit_maximum_entropy(_channels(asset, vertices, at))
    for number, sun in enumerate(suns):
        directions, irradiance = _points_of(sun)
        transport = fitted.evaluate(directions)
        radiance[number] = np.einsum(
            "ncd,dc->nc", np.broadcast_to(transport, (len(vertices), 3, len(directions))), irradiance
        )
    return radiance


def sun_gradient(
    asset: Asset, suns: Sequence[DirectionalLight], vertices: NDArray[np.int64], at: BinCoordinates
) -> Array:
    """∂/∂a_k [n,K,3] of `sun_radiance` by the coefficients between the view bins.

    To first order, an error of the coefficients changes radiance as under a light with these harmonics.
    """
    from prt_bake.shading.maximum_entropy import MaximumEntropyTransport, fit_maximum_entropy, radiance_gradient

    shape = (len(vertices), (asset.degree + 1) ** 2, 3)
    if not suns or not len(vertices):
        return np.zeros(shape)
    coefficients = _channels(asset, vertices, at)
    fitted = fit_maximum_entropy(coefficients)
    fields = (fitted.energy, fitted.logarithm, fitted.multipliers)
    by_channel = MaximumEntropyTransport(*(np.broadcast_to(part, (len(part), 3, *part.shape[2:])) for part in fields))
    return radiance_gradient(np.broadcast_to(coefficients, shape), by_channel, *_points(suns))


def _points(suns: Sequence[DirectionalLight]) -> tuple[Array, Array]:
    directions, irradiance = (np.concatenate(part) for part in zip(*map(_points_of, suns), strict=True))
    return directions, irradiance


def _channels(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates) -> Array:
    """Interpolated coefficients [n,K,C]; C is 1 if all channels are equal."""
    coefficients = interpolated_coefficients(asset, vertices, at)
    return coefficients[:, :, :1] if (coefficients == coefficients[:, :, :1]).all() else coefficients


def interpolated_coefficients(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates) -> Array:
    """Coefficients [n,K,3] of `vertices` [n] (ascending) between the view bins; `at` as in `reconstruct`."""
    from prt_bake.shading.reconstruction import coefficient_blocks, reconstruct

    harmonics = (asset.degree + 1) ** 2
    coefficients = np.empty((len(vertices), harmonics, 3))
    for part, block, rows in coefficient_blocks(asset.coefficients, vertices):
        places = BinCoordinates._make(field[part] for field in at)
        for k in range(harmonics):
            light = np.zeros((harmonics, 3))
            light[k] = 1.0
            coefficients[part, k] = reconstruct(block, rows, places, asset.sectors, light)
    return coefficients


def _points_of(sun: DirectionalLight) -> tuple[Array, Array]:
    """Directions [D,3] and irradiance [D,3] that replace a sun: its centre, or a quadrature over a wide disc."""
    if sun.angular_diameter <= _POINT:
        return sun.direction[None], sun.irradiance[None]
    nodes, turns = np.array([-1.0, 1.0]) / math.sqrt(3.0), 2.0 * math.pi * np.arange(6) / 6.0
    fall = np.repeat(solid_angle(sun) / (2.0 * math.pi) * (0.5 + 0.5 * nodes), len(turns))
    phi = np.concatenate([turns, turns + math.pi / 6.0])
    sine = np.sqrt(fall * (2.0 - fall))
    local = np.stack([sine * np.cos(phi), sine * np.sin(phi), 1.0 - fall], axis=1)
    axis = np.repeat(sun.direction[None], len(local), axis=0)
    return to_world(local, axis, tangent_frame(axis)), np.repeat(sun.irradiance[None] / len(local), len(local), axis=0)
