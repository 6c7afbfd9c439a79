"""Description and faults of an asset. Faults include those of a readable file: a wrong basis or a failed self-test."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from formats.asset import Asset, check_asset, read_asset
from formats.asset.compact_record import CompactCoefficients
from formats.errors import QueryError
from prt_bake.mathematics import sphere
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.vertices import refuse_other_basis

_TOLERANCE = 1e-3
"""Relative to the largest radiance of the self-test: directions are float32 and coefficients usually float16."""


def describe(path: Path) -> dict[str, Any]:
    """Return sizes, pruning, compression and provenance of an asset."""
    asset = read_asset(path)
    return {
        "vertices": len(asset.mesh.positions),
        "vertices baked": int(np.count_nonzero(asset.valid)),
        "faces": len(asset.mesh.faces),
        "rings": asset.rings,
        "sectors": asset.sectors,
        "degree": asset.degree,
        "coefficients": f"{asset.coefficients.dtype} {list(asset.coefficients.shape)}",
        "complete": bool(asset.complete),
        "up": asset.up,
        "unit": asset.unit,
        "pruned": asset.left_out,
        **_describe_compression(asset.coefficients),
        **{f"provenance: {name}": value for name, value in asset.provenance.items()},
    }


def find_faults(path: Path) -> list[str]:
    """Return the faults of the file; if there are none, those of the asset."""
    return check_asset(path) or [f"{path}: {fault}" for fault in soundness_faults(read_asset(path))]


def soundness_faults(asset: Asset) -> Iterator[str]:
    """Yield a sentence per fault: harmonics of another basis, no baked vertex, a self-test that fails."""
    try:
        refuse_other_basis(asset)
    except QueryError as error:
        yield str(error).removeprefix("asset: ")
    if not asset.valid.any():
        yield "no vertex is baked, so there is nothing to show; bake it again (--resume finishes a partial bake)"
    elif asset.selftest and not (deviation := selftest_error(asset)) <= _TOLERANCE:
        yield (
            f"/selftest: its radiance differs from that of the coefficients by {deviation:.3g} of the largest; the "
            "coefficients, the mesh or the self-test were changed; bake the asset again"
        )


def selftest_error(asset: Asset) -> float:
    """Return the largest difference between the self-test's radiance and the asset's, relative to the largest value."""
    vertices = np.asarray(asset.selftest["vertex"], np.int64)
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    local = sphere.to_local(asset.selftest["outgoing"], asset.mesh.normals[vertices], tangents)
    bins = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    light = np.asarray(asset.selftest["light"], np.float64) if asset.quantity == "transfer" else np.ones((1, 3))
    computed = reconstruct(asset.coefficients, vertices, bins, asset.sectors, light)
    stored = np.asarray(asset.selftest["radiance"], np.float64)
    largest = max(float(np.abs(computed).max()), float(np.abs(stored).max()))
    return float(np.abs(computed - stored).max()) / largest if largest > 0.0 else 0.0


def _describe_compression(coefficients: Any) -> dict[str, Any]:
    if not isinstance(coefficients, CompactCoefficients):
        return {}
    added = coefficients.added
    return {
        "compact: components": len(coefficients.view_component),
        "compact: codes per vertex": len(coefficients.values) / len(coefficients),
        "compact: added relative RMSE": added.total,
        "compact: requested": added.requested,
        "compact: 95th percentile over vertices": added.percentile_95,
        "compact: worst vertex": added.worst,
    }
