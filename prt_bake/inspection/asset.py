"""Description and faults of an asset. Faults include those of a readable file: a wrong basis or a failed self-test."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from formats.asset import Asset, check_asset, read_asset
from formats.asset.compact_record import CompactCoefficients
from formats.errors import QueryError
from prt_bake.shading.selftest import selftest_fault
from prt_bake.shading.vertices import refuse_other_basis


def describe(path: Path) -> dict[str, Any]:
    """Return the error, sizes, pruning, compression and provenance of an asset."""
    asset = read_asset(path)
    return {
        "error of the coefficients": str(asset.error),
        "errors": asset.error.as_json(),
        "quantity": asset.quantity,
        "bounds": asset.mesh.bounds.tolist(),
        "vertices": len(asset.mesh.positions),
        "vertices baked": int(np.count_nonzero(asset.valid)),
        "faces": len(asset.mesh.faces),
        "rings": asset.rings,
        "sectors": asset.sectors,
        "degree": asset.degree,
        "coefficients": f"{asset.coefficients.dtype} {list(asset.coefficients.shape)}",
        "lobes": "none" if (lobes := asset.lobes) is None else f"{lobes.count} at {lobes.rings}×{lobes.sectors} views",
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
        yield "no vertex is baked, so there is nothing to show; bake it again (resume finishes a partial bake)"
    elif (fault := selftest_fault(asset)) is not None:
        yield fault


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
