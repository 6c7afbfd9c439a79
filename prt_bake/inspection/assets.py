"""What is wrong with an asset whose file is as it should be: it means other things than it says, or shows nothing."""

from collections.abc import Iterator

import numpy as np

from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.mathematics import sphere
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.vertices import refuse_other_basis

_REPRODUCED = 1e-3
"""Of the largest radiance of the self-test: files keep float32 directions and, mostly, float16 coefficients."""


def soundness_faults(asset: Asset) -> Iterator[str]:
    """Yield a sentence for each fault: harmonics of another basis, no vertex baked, a self-test that is not met."""
    try:
        refuse_other_basis(asset)
    except QueryError as fault:
        yield str(fault).removeprefix("asset: ")
    if not asset.valid.any():
        yield "no vertex was baked, there is nothing to show; bake it again (--resume finishes a partial bake)"
    elif asset.selftest and not (off := selftest_error(asset)) <= _REPRODUCED:
        yield (
            f"/selftest: its radiance is off what the coefficients give by {off:.3g} of the largest; the coefficients, "
            "the mesh or the self-test were changed, bake it again"
        )


def selftest_error(asset: Asset) -> float:
    """The largest difference between the self-test's radiance and the asset's own, over the largest of both."""
    vertices = np.asarray(asset.selftest["vertex"], np.int64)
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    local = sphere.to_local(asset.selftest["outgoing"], asset.mesh.normals[vertices], tangents)
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    light = np.asarray(asset.selftest["light"], np.float64) if asset.quantity == "transfer" else np.ones((1, 3))
    found = reconstruct(asset.coefficients, vertices, at, asset.sectors, light)
    told = np.asarray(asset.selftest["radiance"], np.float64)
    largest = max(float(np.abs(found).max()), float(np.abs(told).max()))
    return float(np.abs(found - told).max()) / largest if largest > 0.0 else 0.0
