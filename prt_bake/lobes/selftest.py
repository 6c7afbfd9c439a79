"""Lobes of an asset and their rows in its self-test: what they add under a sun, in the closed form of `gaussians`."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.asset.lobes import Lobes, as_stored
from formats.scene.lights import DirectionalLight
from prt_bake.lights.lighting import Lighting
from prt_bake.lobes.interpolation import lobes_at
from prt_bake.lobes.light import lobe_light, lobe_radiance
from prt_bake.mathematics import sphere

SUN = np.array([2.0, 3.0, 6.0]) / 7.0


def with_lobes(asset: Asset, lobes: Lobes | None) -> Asset:
    """The asset with these lobes, as a file stores them, and rows for them in its self-test, if it has one."""
    selftest = {name: values for name, values in asset.selftest.items() if name not in ("sun", "lobes")}
    if lobes is None:
        return replace(asset, lobes=None, selftest=selftest)
    lobes = as_stored(lobes)
    if selftest:
        selftest |= {"sun": SUN, "lobes": lobes_under_sun(asset, lobes, SUN)}
    return replace(asset, lobes=lobes, selftest=selftest)


def lobes_under_sun(asset: Asset, lobes: Lobes, sun: NDArray[np.float64]) -> NDArray[np.float64]:
    """What lobes add [S,3] to the rows of the asset's self-test under a sun from `sun` [3] of irradiance 1."""
    vertices = np.asarray(asset.selftest["vertex"], np.int64)
    # Frames as a reader finds them in the file.
    normals, tangents = (each[vertices].astype(np.float32) for each in (asset.mesh.normals, asset.tangents))
    at = lobes_at(lobes, vertices, sphere.to_local(asset.selftest["outgoing"], normals, tangents))
    sunlight = Lighting((), (DirectionalLight(sun, np.ones(3), 0.0),))
    return lobe_radiance(lobe_light(sunlight, asset.degree, 1.0, 1.0), *at)
