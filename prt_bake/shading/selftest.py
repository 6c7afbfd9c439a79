"""The self-test of an asset: radiance of vertices that coefficients and lobes must reproduce. Never loads torch."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.errors import warn
from prt_bake.lobes.selftest import lobes_under_sun
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.vertices import bin_coordinates_at_vertices

_TOLERANCE = 1e-3
"""Relative to the largest radiance of the self-test: directions are float32 and coefficients usually float16."""


def warn_of_failed_selftest(asset: Asset, path: str | Path) -> None:
    """Warn if the self-test of the asset in the file `path` fails; assets without one pass."""
    if (fault := selftest_fault(asset)) is not None:
        warn(f"{path}: {fault}")


def selftest_fault(asset: Asset) -> str | None:
    """Return a sentence if the coefficients or the lobes do not reproduce the self-test, else None."""
    if not len(asset.selftest.get("vertex", ())) or not asset.valid.any():
        return None
    remedy = "bake the asset again, or delete /selftest if the change is meant"
    if (deviation := selftest_error(asset)) > _TOLERANCE:
        return (
            f"/selftest: its radiance differs from that of the coefficients by {deviation:.3g} of the largest; the "
            f"coefficients, the mesh or the self-test were changed; {remedy}"
        )
    if (deviation := lobes_error(asset)) > _TOLERANCE:
        return (
            f"/selftest: lobes there differ from /lobes by {deviation:.3g} of the largest; the lobes or "
            f"the self-test were changed; {remedy}"
        )
    return None


def selftest_error(asset: Asset) -> float:
    """Return the largest difference between the self-test's radiance and the asset's, relative to the largest value."""
    return _relative(selftest_radiance(asset), asset.selftest["radiance"])


def selftest_radiance(asset: Asset) -> NDArray[np.float64]:
    """Return the radiance [S,3] of the self-test's rows by the asset's coefficients."""
    order = np.argsort(asset.selftest["vertex"], kind="stable")  # an open dataset is read in ascending order
    vertices = np.asarray(asset.selftest["vertex"], np.int64)[order]
    at = bin_coordinates_at_vertices(asset, asset.selftest["outgoing"][order], vertices)
    light = np.asarray(asset.selftest["light"], np.float64) if asset.quantity == "transfer" else np.ones((1, 3))
    radiance = np.empty((len(order), 3))
    radiance[order] = reconstruct(asset.coefficients, vertices, at, asset.sectors, light)
    return radiance


def lobes_error(asset: Asset) -> float:
    """Return the same of what lobes add under the self-test's sun; 0 without lobes, or without rows of them."""
    if asset.lobes is None or "lobes" not in asset.selftest or "sun" not in asset.selftest:
        return 0.0
    computed = lobes_under_sun(asset, asset.lobes, np.asarray(asset.selftest["sun"], np.float64))
    return _relative(computed, asset.selftest["lobes"])


def _relative(computed: NDArray[np.float64], rows: NDArray[np.floating]) -> float:
    stored = np.asarray(rows, np.float64)
    largest = max(float(np.abs(computed).max()), float(np.abs(stored).max()))
    return float(np.abs(computed - stored).max()) / largest if largest > 0.0 else 0.0
