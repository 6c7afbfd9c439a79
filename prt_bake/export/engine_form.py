"""The engine form of an asset: harmonics of the view beside those of the light, both in object space.

    L(v, ωo) = max(0, Σ_r Y_r(ωo) Σ_k A[v,r,k] b_k)

A reader needs no view bins, frames, pole or seam. The harmonics of the view are fitted to the bins by least squares.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import whole_number
from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.vertices import light_coefficients

Array = NDArray[np.float64]

HIGHEST_DEGREE = 8
DEFAULT_DEGREE = 3
_BELOW, _RIDGE = 0.02, 1e-4
"""Weight of a direction below the horizon beside one above it, and of the coefficients themselves.

Below the horizon the value is that of the last ring, so that triangles at the silhouette, some of whose vertices face
away, are not wrong. The ridge keeps the normal equations well conditioned on a hemisphere."""
_RINGS, _SECTORS = 16, 64
"""Fewest directions that a form is fitted to: between coarse view bins it follows their interpolation."""
_BYTES_AT_ONCE = 64 << 20
_ROTATION = 8 * sh.count(HIGHEST_DEGREE) ** 2
"""Bytes of the rotation of a vertex of the highest degree, which often is larger than its coefficients."""


@dataclass(frozen=True, eq=False)
class EngineForm:
    """An asset in harmonics of the view.

    Attributes:
        coefficients: A, float32 [V,R,K,3], R = (view_degree + 1)²; 0 at vertices that were not baked.
        view_degree: degree of the harmonics of the view.
        light_degree: degree of the harmonics of the light; 0 for one light.
        quantity: "transfer", or "radiance" for one light: K = 1 and b = 1.
    """

    coefficients: NDArray[np.float32]
    view_degree: int
    light_degree: int
    quantity: str

    def radiance(self, vertices: NDArray[np.integer], outgoing: Array, light: Array) -> Array:
        """Radiance [n,3], not clamped, of `vertices` [n] along unit `outgoing` [n,3] under `light` [K,3].

        A form of one light ignores `light`.
        """
        weights = np.ones((1, 3)) if self.quantity == "radiance" else light
        basis = sh.evaluate(outgoing, self.view_degree)
        return np.asarray(np.einsum("nr,nrkc,kc->nc", basis, self.coefficients[vertices].astype(np.float64), weights))


def engine_form(asset: Asset, degree: int = DEFAULT_DEGREE, light: ArrayLike | None = None) -> EngineForm:
    """Fit harmonics of the view to the view bins of every vertex.

    Args:
        asset: the baked asset; an asset without view dependence (B = 1) gets degree 0.
        degree: of the harmonics of the view, 0 to 8.
        light: [K,3], a light to fold in; None keeps every light.

    Raises QueryError for another degree, a light of another shape, a light for an asset that has one already, and an
    asset without baked vertices.

    >>> import prt_bake as prt
    >>> asset = prt.read_asset("spot.h5")
    >>> engine_form(asset, degree=3).coefficients.shape == (len(asset.valid), 16, 9, 3)
    True
    """
    if not 0 <= whole_number("degree", degree) <= HIGHEST_DEGREE:
        raise QueryError(f"degree: expected 0 to {HIGHEST_DEGREE}, found {degree}")
    if not asset.valid.any():
        raise QueryError("asset: no vertex was baked, there is nothing to export; bake it again")
    weights = None if light is None else light_coefficients(asset, light)
    if asset.coefficients.shape[1] == 1:
        degree = 0
    fit = view_fit(asset, degree)
    folded = weights is not None or asset.quantity == "radiance"
    bands = 1 if folded else asset.coefficients.shape[2]
    coefficients = np.zeros((len(asset.valid), sh.count(degree), bands, 3), np.float32)
    for part, block in blocks(asset, weights):
        local = np.matmul(fit, block.reshape(*block.shape[:2], -1))
        turned = np.matmul(frame_rotations(asset, part, degree).transpose(0, 2, 1), local)
        coefficients[part] = turned.reshape(*turned.shape[:2], *block.shape[2:])
    return EngineForm(coefficients, degree, 0 if folded else asset.degree, "radiance" if folded else "transfer")


def view_fit(asset: Asset, degree: int) -> Array:
    """Matrix [R,B] from the values of the view bins to harmonics of the view in the local frame of a vertex."""
    if asset.coefficients.shape[1] == 1:
        return np.full((1, 1), math.sqrt(4.0 * math.pi))
    above = sphere.view_bins(max(asset.rings, _RINGS), max(asset.sectors, _SECTORS))
    directions = np.concatenate([above, above * [1.0, 1.0, -1.0]])
    weights = 2.0 * math.pi / len(above) * np.repeat([1.0, _BELOW], len(above))
    basis = sh.evaluate(directions, degree)
    normal = (basis.T * weights) @ basis + _RIDGE * np.eye(sh.count(degree))
    values = sphere.bin_matrix(directions, asset.rings, asset.sectors)
    return np.asarray(np.linalg.solve(normal, (basis.T * weights) @ values))


def view_basis(asset: Asset, degree: int) -> Array:
    """The harmonics of the view at the view bins [B,R], in the local frame of a vertex."""
    if asset.coefficients.shape[1] == 1:
        return np.full((1, 1), math.sqrt(0.25 / math.pi))
    return sh.evaluate(sphere.view_bins(asset.rings, asset.sectors), degree)


def frame_rotations(asset: Asset, part: slice, degree: int) -> Array:
    """Matrices M [n,R,R] of the frames F of vertices, object to local: Y(F ω) = M Y(ω)."""
    normals, tangents = asset.mesh.normals[part], np.asarray(asset.tangents, np.float64)[part]
    frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=1)
    return sh.rotations(frames, degree)


def blocks(asset: Asset, light: Array | None = None) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield runs of vertices and their coefficients, float32 [n,B,K,3], a few chunks of the file at a time.

    Vertices that were not baked have 0. With a light [K,3] they are the radiance of the bins, float32 [n,B,1,3].

    Raises QueryError for coefficients that are not finite.
    """
    stored = asset.coefficients
    chunk = stored.chunks[0] if getattr(stored, "chunks", None) else 1
    row = max(12 * math.prod(stored.shape[1:3]), _ROTATION)
    step = chunk * max(1, _BYTES_AT_ONCE // (row * chunk))
    for first in range(0, len(asset.valid), step):
        part = slice(first, min(first + step, len(asset.valid)))
        block = np.array(stored[part], np.float32)
        block[~asset.valid[part]] = 0.0
        if not np.isfinite(block).all():
            vertex = first + int(np.flatnonzero(~np.isfinite(block).all(axis=(1, 2, 3)))[0])
            raise QueryError(f"asset: coefficients of vertex {vertex} are not finite; bake it again")
        if light is not None:
            block = np.einsum("nbkc,kc->nbc", block, light)[:, :, None].astype(np.float32)
        yield part, np.broadcast_to(block, (*block.shape[:3], 3))
