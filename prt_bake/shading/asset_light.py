"""A lighting prepared for one asset: what its harmonics and what its lobes are multiplied with."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError
from formats.scene.lights import DirectionalLight
from formats.summary import summary
from prt_bake.lights.lighting import Lighting, warn_of_other_up
from prt_bake.shading.sun_shading import SunTreatment, suns_apart

if TYPE_CHECKING:
    from prt_bake.lobes.light import LobeLight

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AssetLight:
    """A lighting prepared for one asset.

    Attributes:
        harmonics: [K,3], the light to shade by harmonics; None for an asset made for one light.
        suns: to shade separately (`prt_bake.shading.sun_shading`, with lobes `prt_bake.shading.lobed_suns`).
        whole: [K,3], harmonics of all the light, undamped.
        found: the number of suns.
        lobes: the light that lobes see; None for an asset without lobes.
        treatment: of the suns; None for coefficients that were not prepared.
    """

    harmonics: Any
    suns: tuple[DirectionalLight, ...] = ()
    whole: Any = None
    found: int = 0
    lobes: "LobeLight | None" = None
    treatment: SunTreatment | None = None

    __repr__ = summary


def light_for(asset: Asset, lighting: Lighting, suns: SunTreatment = "split") -> AssetLight:
    """Prepare a lighting for an asset; the light is for that asset, and for compact forms of it, alone.

    Args:
        asset: the baked asset.
        lighting: the light, in object space.
        suns: how suns are shaded (`prt_bake.shading.sun_shading`); "split" uses the lobes of an asset that has some,
            the others leave them out.

    A sky that was read for another axis than the asset's, such as `read_lighting(path)` with y up for an asset with z
    up, is reported by an InputWarning.

    Raises QueryError for an unknown treatment.

    >>> import prt_bake as prt
    >>> asset = prt.read_asset("spot.h5")
    >>> light = prt.light_for(asset, prt.read_lighting("sky.hdr"))
    >>> radiance = prt.shade(asset, light, [0.0, 1.0, 4.0])
    """
    if asset.quantity != "radiance":
        warn_of_other_up(lighting, asset.up)
    return prepare_light(asset, lighting, suns)


def prepare_light(asset: Asset, lighting: Lighting, suns: SunTreatment = "split") -> AssetLight:
    """`light_for` of a lighting whose axis was chosen."""
    if asset.quantity == "radiance":
        return AssetLight(None)
    divided = suns_apart(lighting, asset.degree, suns)
    used = _sharpness(asset)
    if not len(used) or suns != "split":
        return AssetLight(divided.harmonics, divided.suns, divided.whole, divided.found, treatment=suns)
    from prt_bake.lobes.light import lobe_light

    lobes = lobe_light(lighting, asset.degree, float(used.min()), float(used.max()))
    return AssetLight(divided.harmonics, divided.suns, divided.whole, divided.found, lobes, suns)


def refuse_light_of_other_lobes(light: AssetLight, asset: Asset) -> None:
    """Raise QueryError for a light that was prepared for an asset whose lobes are not like those of this one."""
    used = _sharpness(asset)
    if light.lobes is None and not (light.treatment == "split" and len(used)):
        return
    fits = light.lobes is not None and len(used) and light.lobes.holds(float(used.min()), float(used.max()))
    if not fits:
        others = "without lobes" if light.lobes is None else "with other lobes" if len(used) else "with lobes"
        raise QueryError(
            f"light: was prepared for an asset {others}; prt.light_for(asset, lighting) prepares it for this one"
        )


def _sharpness(asset: Asset) -> NDArray[np.float32]:
    """The sharpness of the asset's lobes, of those that have power."""
    return np.zeros(0, np.float32) if asset.lobes is None else asset.lobes.sharpness[asset.lobes.powers.any(axis=-1)]


def as_asset_light(light: "AssetLight | ArrayLike | None", suns: Sequence[DirectionalLight]) -> AssetLight:
    """A prepared light, or coefficients with suns beside them.

    Raises QueryError for suns beside a prepared light, which has its own.
    """
    if not isinstance(light, AssetLight):
        return AssetLight(light, tuple(suns))
    if suns:
        raise QueryError("suns: expected none beside a prepared light, which has its own; leave them out")
    return light
