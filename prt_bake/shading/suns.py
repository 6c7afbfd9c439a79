"""Suns on a baked asset: what of a lighting is shaded by harmonics, and what by the transport in the suns' directions.

An asset holds a few harmonics of its transport, and under a sun their sum rings: a vertex that no light of the sun
reaches glows or is below 0. No light that is written as harmonics mends that without blurring the sun. Suns are
therefore taken out of the skies (`suns`) and met by a positive transport with the same harmonics
(`positive_transport`). Directional lights up to the width of a sun are treated in the same way.

Radiance stays linear in the scale of the light and additive in suns, and in skies as long as the same suns are found in
their sum; it is not linear in the asset's coefficients.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.asset.compact_record import CompactCoefficients
from formats.errors import QueryError, refuse_path
from formats.scene.lights import DirectionalLight
from prt_bake.lights.deringing import windowed
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting, solid_angle
from prt_bake.lights.suns import WIDEST, split_lighting
from prt_bake.mathematics.sphere import BinCoordinates, tangent_frame, to_world

Array = NDArray[np.float64]
SunTreatment = Literal["split", "window", "plain"]
"""split: suns apart, by a positive transport. window: their harmonics damped until they are nowhere below 0.
plain: in the harmonics like all other light."""

_POINT = 2.0
"""Degrees; discs up to this wide are taken as their middle."""
_BYTES_AT_ONCE = 64 << 20


@dataclass(frozen=True, eq=False)
class SunsApart:
    """Harmonics [K,3] to shade with, and the suns to shade apart; whole [K,3]: harmonics of all the light, undamped.

    found: how many suns there were, whatever was done with them.
    """

    harmonics: Array
    suns: tuple[DirectionalLight, ...]
    whole: Array
    found: int


def suns_apart(lighting: Lighting, degree: int, treatment: SunTreatment = "split") -> SunsApart:
    """Divide a lighting for an asset of a degree; raises QueryError for an unknown treatment."""
    refuse_path("lighting", lighting, "prt.read_lighting")
    if treatment not in get_args(SunTreatment):
        raise QueryError(f"suns: expected {', '.join(map(repr, get_args(SunTreatment)))}, found {treatment!r}")
    # A single harmonic cannot ring.
    split = lighting if treatment == "plain" or degree == 0 else split_lighting(lighting)
    suns = tuple(sun for sun in split.suns if sun.angular_diameter <= WIDEST)
    if split is lighting and (treatment == "plain" or degree == 0 or not suns):
        whole = project_lighting(lighting, degree)
        return SunsApart(whole, (), whole, 0)
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
    """Radiance [n,3] that `vertices` [n] (ascending) send to the eye under suns alone; `at` as in `reconstruct`.

    Not negative, but where the vertex's mean transport itself is.
    """
    from prt_bake.shading.maximum_entropy import positive_transport

    radiance = np.zeros((len(vertices), 3))
    if not suns or not len(vertices):
        return radiance
    directions, irradiance = _points(suns)
    transport = positive_transport(_channels(asset, vertices, at)).towards(directions)
    radiance += np.einsum("ncd,dc->nc", np.broadcast_to(transport, (len(vertices), 3, len(directions))), irradiance)
    return radiance


def sun_slopes(
    asset: Asset, suns: Sequence[DirectionalLight], vertices: NDArray[np.int64], at: BinCoordinates
) -> Array:
    """∂/∂a_k [n,K,3] of `sun_radiance`, by the coefficients between the view bins: the harmonics of a light under which
    small errors of them are what they are under these suns.
    """
    from prt_bake.shading.maximum_entropy import PositiveTransport, positive_transport, slopes

    shape = (len(vertices), (asset.degree + 1) ** 2, 3)
    if not suns or not len(vertices):
        return np.zeros(shape)
    coefficients = _channels(asset, vertices, at)
    fitted = positive_transport(coefficients)
    fields = (fitted.energy, fitted.logarithm, fitted.multipliers)
    of_each = PositiveTransport(*(np.broadcast_to(part, (len(part), 3, *part.shape[2:])) for part in fields))
    return slopes(np.broadcast_to(coefficients, shape), of_each, *_points(suns))


def _points(suns: Sequence[DirectionalLight]) -> tuple[Array, Array]:
    directions, irradiance = (np.concatenate(part) for part in zip(*map(_points_of, suns), strict=True))
    return directions, irradiance


def _channels(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates) -> Array:
    """Coefficients [n,K,C]; one channel where it stands for all."""
    coefficients = gathered(asset, vertices, at)
    return coefficients[:, :, :1] if (coefficients == coefficients[:, :, :1]).all() else coefficients


def gathered(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates) -> Array:
    """Coefficients [n,K,3] of `vertices` [n] (ascending) between the view bins; `at` as in `reconstruct`."""
    from prt_bake.shading.reconstruction import reconstruct

    harmonics = (asset.degree + 1) ** 2
    answer = np.empty((len(vertices), harmonics, 3))
    for part, block, rows in _in_memory(asset.coefficients, vertices):
        places = BinCoordinates._make(field[part] for field in at)
        for k in range(harmonics):
            light = np.zeros((harmonics, 3))
            light[k] = 1.0
            answer[part, k] = reconstruct(block, rows, places, asset.sectors, light)
    return answer


def _in_memory(coefficients: Any, vertices: NDArray[np.int64]) -> Iterator[tuple[slice, Any, NDArray[np.int64]]]:
    """Runs of `vertices`, coefficients that hold them, and their rows in those; a file is read once."""
    if isinstance(coefficients, (np.ndarray, CompactCoefficients)):
        yield slice(0, len(vertices)), coefficients, vertices
        return
    step = max(1, _BYTES_AT_ONCE // (math.prod(coefficients.shape[1:]) * coefficients.dtype.itemsize))
    for first in range(0, coefficients.shape[0], step):
        part = slice(*np.searchsorted(vertices, [first, first + step]).tolist())
        if part.stop > part.start:
            yield part, coefficients[first : first + step], vertices[part] - first


def _points_of(sun: DirectionalLight) -> tuple[Array, Array]:
    """Directions [D,3] and irradiance [D,3] that stand for a sun: its middle, or points even over a wide disc."""
    if sun.angular_diameter <= _POINT:
        return sun.direction[None], sun.irradiance[None]
    nodes, turns = np.array([-1.0, 1.0]) / math.sqrt(3.0), 2.0 * math.pi * np.arange(6) / 6.0
    fall = np.repeat(solid_angle(sun) / (2.0 * math.pi) * (0.5 + 0.5 * nodes), len(turns))
    phi = np.concatenate([turns, turns + math.pi / 6.0])
    sine = np.sqrt(fall * (2.0 - fall))
    local = np.stack([sine * np.cos(phi), sine * np.sin(phi), 1.0 - fall], axis=1)
    axis = np.repeat(sun.direction[None], len(local), axis=0)
    return to_world(local, axis, tangent_frame(axis)), np.repeat(sun.irradiance[None] / len(local), len(local), axis=0)
