"""Assets with given coefficients, for tests and benchmarks."""

import numpy as np

from formats.asset import Asset
from formats.mesh import Mesh
from prt_bake.mathematics import sh, sphere


def asset_of(mesh: Mesh, coefficients: np.ndarray, rings: int, sectors: int, degree: int, **others) -> Asset:
    """All vertices are valid, with a standard error of 0.1 by default."""
    check_directions = np.eye(3)[:2]
    stated = {
        "standard_error": np.full(coefficients.shape[:2], 0.1, np.float32),
        "valid": np.ones(len(coefficients), np.bool_),
        "storage": str(coefficients.dtype),
    }
    return Asset(
        mesh=mesh,
        tangents=sphere.tangent_frame(mesh.normals),
        rings=rings,
        sectors=sectors,
        directions=sphere.view_bins(rings, sectors),
        degree=degree,
        check_directions=check_directions,
        check_values=sh.evaluate(check_directions, degree),
        coefficients=coefficients,
        **(stated | others),
    )
