"""The self-test of an asset: radiance at six vertices, which the coefficients must reproduce. Never loads torch."""

from pathlib import Path

import numpy as np

from formats.asset import Asset
from formats.errors import warn
from prt_bake.mathematics import sphere
from prt_bake.shading.reconstruction import reconstruct

_TOLERANCE = 1e-3
"""Relative to the largest radiance of the self-test: directions are float32 and coefficients usually float16."""


def warn_of_failed_selftest(asset: Asset, path: str | Path) -> None:
    """Warn if the self-test of the asset in the file `path` fails; assets without one pass."""
    if (fault := selftest_fault(asset)) is not None:
        warn(f"{path}: {fault}")


def selftest_fault(asset: Asset) -> str | None:
    """Return a sentence if the coefficients do not reproduce the self-test, else None."""
    if not len(asset.selftest.get("vertex", ())) or not asset.valid.any():
        return None
    if (deviation := selftest_error(asset)) <= _TOLERANCE:
        return None
    return (
        f"/selftest: its radiance differs from that of the coefficients by {deviation:.3g} of the largest; the "
        "coefficients, the mesh or the self-test were changed; bake the asset again, or delete /selftest if the change "
        "is meant"
    )


def selftest_error(asset: Asset) -> float:
    """Return the largest difference between the self-test's radiance and the asset's, relative to the largest value."""
    order = np.argsort(asset.selftest["vertex"], kind="stable")  # an open dataset is read in ascending order
    vertices = np.asarray(asset.selftest["vertex"], np.int64)[order]
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    local = sphere.to_local(asset.selftest["outgoing"][order], asset.mesh.normals[vertices], tangents)
    bins = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    light = np.asarray(asset.selftest["light"], np.float64) if asset.quantity == "transfer" else np.ones((1, 3))
    computed = reconstruct(asset.coefficients, vertices, bins, asset.sectors, light)
    stored = np.asarray(asset.selftest["radiance"], np.float64)[order]
    largest = max(float(np.abs(computed).max()), float(np.abs(stored).max()))
    return float(np.abs(computed - stored).max()) / largest if largest > 0.0 else 0.0
