"""Suns on an asset with lobes: lobes where the object is bright, maximum entropy where it is dark.

Harmonics and lobes are off by a share of the mean radiance over all directions of the sun. In the dark, this is more
than the radiance itself, and shows as stains. Maximum entropy (`maximum_entropy`) is smooth there, and off by a share
of the radiance itself. Both are therefore weighted by the inverse squares of their errors.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from prt_bake.lights.harmonics import project_lighting
from prt_bake.lights.lighting import Lighting
from prt_bake.lobes.interpolation import LobesAtViews
from prt_bake.lobes.light import lobe_radiance
from prt_bake.mathematics.sphere import BinCoordinates
from prt_bake.shading.asset_light import AssetLight
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.sun_shading import radiance_of_each_sun

Array = NDArray[np.float64]

_DARK = 0.2
"""Radiance over its mean for all directions of the sun at which both errors are alike."""
_ERROR = 0.77
"""Error over the difference of both: 0.47 to 1.18 on three objects, with the sun in front, at the side and behind."""


class SunsAtVertices(NamedTuple):
    """Radiance [n,3] of suns, not clamped, and its estimated error [n,3], the transport's own left out."""

    radiance: Array
    error: Array


def lobed_sun_radiance(
    asset: Asset, light: AssetLight, vertices: NDArray[np.int64], at: BinCoordinates, lobes: LobesAtViews
) -> SunsAtVertices:
    """The radiance of `vertices` [n] (ascending) towards the eye under the suns of a light alone.

    at: as in `reconstruct`; lobes: of the vertices, towards the eye. Linear in the scale of the light, and additive in
    suns.
    """

    def under(harmonics: Array) -> Array:
        return reconstruct(asset.coefficients, vertices, at, asset.sectors, harmonics)

    assert light.lobes is not None
    everywhere = np.zeros_like(light.whole)
    everywhere[0] = 1.0 / math.sqrt(4.0 * math.pi)
    mean = under(everywhere)
    radiance, squares = np.zeros_like(mean), np.zeros_like(mean)
    for number, smooth in enumerate(radiance_of_each_sun(asset, light.suns, vertices, at)):
        sun = light.suns[number]
        sharp = under(project_lighting(Lighting((), (sun,)), asset.degree))
        sharp += lobe_radiance(light.lobes.sun_alone(number), *lobes)
        found, dark = np.maximum(np.maximum(sharp, smooth), 0.0) ** 2, (_DARK * mean * sun.irradiance) ** 2
        share = np.divide(found, found + dark, out=np.zeros_like(found), where=found + dark > 0.0)
        radiance += smooth + share * (sharp - smooth)
        squares += (np.maximum(sharp, 0.0) - np.maximum(smooth, 0.0)) ** 2
    return SunsAtVertices(radiance, _ERROR * np.sqrt(squares))
