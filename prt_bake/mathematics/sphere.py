"""Tangent frames, view bins of the hemisphere about a vertex normal and interpolation between them, sets of directions.

The local frame of a vertex is (t, b, n): n the unit normal, t the tangent stored in the asset, b = n × t. A direction
is (sinθ cosφ, sinθ sinφ, cosθ) in it, φ from t toward b. Ring i of `rings` covers cosθ from 1 − i/rings down to 1 −
(i+1)/rings; sector j of `sectors` covers φ from 2πj/sectors to 2π(j+1)/sectors. Bin `sectors·i + j` has the direction
of its centre in (cosθ, φ). All bins have the same solid angle, 2π/(rings·sectors).

    >>> import prt_bake as prt
    >>> prt.sphere.view_bins(rings=1, sectors=4).round(3)[0].tolist()
    [0.612, 0.612, 0.5]
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import numbers, whole_number
from formats.errors import QueryError
from prt_bake.mathematics.directions import fibonacci, random_rotations, sobol, uniform

__all__ = [
    "BinCoordinates",
    "bin_coordinates",
    "bin_matrix",
    "bin_weights",
    "fibonacci",
    "random_rotations",
    "sobol",
    "tangent_frame",
    "to_local",
    "to_world",
    "uniform",
    "view_bins",
]


class BinCoordinates(NamedTuple):
    """Interpolation coordinates of directions [..., 3] between view bins; each field is an array [...].

    With c(i, j) the value of bin sectors·i + j and s(i) = (1 − sector_weight) c(i, sector_low) + sector_weight c(i,
    sector_high), the interpolated value is (1 − pole_weight) [(1 − ring_weight) s(ring_low) + ring_weight
    s(ring_high)] + pole_weight · mean_j c(0, j).
    """

    ring_low: NDArray[np.int64]
    ring_high: NDArray[np.int64]
    ring_weight: NDArray[np.float64]
    sector_low: NDArray[np.int64]
    sector_high: NDArray[np.int64]
    sector_weight: NDArray[np.float64]
    pole_weight: NDArray[np.float64]


def view_bins(rings: int, sectors: int) -> NDArray[np.float64]:
    """Unit directions [B, 3] of the centres of the B = rings·sectors view bins, in the local frame (t, b, n).

    Raises QueryError unless there is at least one ring and one sector.

    >>> from prt_bake import sphere
    >>> sphere.view_bins(rings=4, sectors=16).shape
    (64, 3)
    """
    _require_bins(rings, sectors)
    cos_theta = np.repeat(1 - (np.arange(rings) + 0.5) / rings, sectors)
    phi = np.tile(2 * math.pi * (np.arange(sectors) + 0.5) / sectors, rings)
    sin_theta = np.sqrt((1 - cos_theta) * (1 + cos_theta))
    return np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), cos_theta], axis=-1)


def bin_coordinates(local: ArrayLike, rings: int, sectors: int) -> BinCoordinates:
    """Neighbouring rings and sectors of unit directions `local` [..., 3], and the weights between them.

    Bilinear in (cosθ, φ), periodic in φ. Between the normal and the centre of ring 0 the value is interpolated linearly
    in 1 − cosθ from the mean of ring 0 to ring 0 (`pole_weight`). Beyond the centre of the last ring, and below the
    horizon, it is clamped. Raises QueryError as `view_bins`, or if the last axis is not 3.

    `prt_bake.shading.frames.batches` computes them for real-time frames. Where they are applied: `bin_weights`,
    `prt_bake.preview.radiance`, and in `prt_bake.shading` `reconstruction`, `compact_reconstruction`, `frames.kernels`
    and `frames.holding`.
    """
    _require_bins(rings, sectors)
    directions = _vectors(local, "local directions")
    depth = (1 - np.clip(directions[..., 2], -1, 1)) * rings - 0.5
    ring = np.clip(depth, 0, rings - 1)
    ring_low = np.floor(ring).astype(np.int64)
    turn = np.arctan2(directions[..., 1], directions[..., 0]) * (sectors / (2 * math.pi)) - 0.5
    sector_low = np.floor(turn).astype(np.int64)
    return BinCoordinates(
        ring_low=ring_low,
        ring_high=np.minimum(ring_low + 1, rings - 1),
        ring_weight=ring - ring_low,
        sector_low=sector_low % sectors,
        sector_high=(sector_low + 1) % sectors,
        sector_weight=turn - sector_low,
        pole_weight=np.clip(-2 * depth, 0, 1),
    )


def bin_weights(local: ArrayLike, rings: int, sectors: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The interpolation as sparse rows: bins [N, M] and their weights [N, M] for unit directions `local` [N, 3].

    The value in direction n is Σ_m weights[n, m] · value[bins[n, m]]. Weights are not negative and sum to 1 in each
    row. A row may contain a bin more than once. M is 4 if no direction is above the centre of ring 0, otherwise 4 +
    sectors; the additional columns are the mean of ring 0. Raises QueryError as `bin_coordinates`.
    """
    at = bin_coordinates(local, rings, sectors)
    bins = np.stack(
        [ring * sectors + sector for ring in (at.ring_low, at.ring_high) for sector in (at.sector_low, at.sector_high)],
        axis=-1,
    )
    weights = np.stack(
        [
            (1 - at.pole_weight) * ring * sector
            for ring in (1 - at.ring_weight, at.ring_weight)
            for sector in (1 - at.sector_weight, at.sector_weight)
        ],
        axis=-1,
    )
    if not at.pole_weight.any():
        return bins, weights
    ring_0 = np.broadcast_to(np.arange(sectors), (*at.pole_weight.shape, sectors))
    shares = np.broadcast_to(at.pole_weight[..., None] / sectors, ring_0.shape)
    return np.concatenate([bins, ring_0], axis=-1), np.concatenate([weights, shares], axis=-1)


def bin_matrix(local: ArrayLike, rings: int, sectors: int) -> NDArray[np.float64]:
    """The interpolation as a dense matrix [N, B]: values in directions `local` [N, 3] = matrix @ values [B, …].

    >>> import numpy as np
    >>> from prt_bake import sphere
    >>> bins = sphere.view_bins(2, 4)
    >>> np.allclose(sphere.bin_matrix(bins, 2, 4), np.eye(8))
    True
    """
    bins, weights = bin_weights(local, rings, sectors)
    matrix = np.zeros((len(bins), rings * sectors))
    np.add.at(matrix, (np.arange(len(bins))[:, None], bins), weights)
    return matrix


def tangent_frame(normals: ArrayLike) -> NDArray[np.float64]:
    """Unit tangents t [..., 3] of normals [..., 3], which are normalised first; (t, n × t, n) is right-handed.

    The tangent is +x after the shortest rotation from +z to n. It is continuous except at n = −z, where t = +x, and the
    frame is orthonormal to rounding everywhere. Source: Duff et al., "Building an orthonormal basis, revisited", JCGT 6
    (2017), with 1/(1 + n_z) written as (1 − n_z)/(n_x² + n_y²) on the lower hemisphere to avoid cancellation. Raises
    QueryError for normals that are zero or not finite, with their count and the first index.

    >>> import numpy as np
    >>> from prt_bake import sphere
    >>> np.allclose(sphere.tangent_frame([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    True
    """
    vectors = _vectors(normals, "normals")
    length = np.linalg.norm(vectors, axis=-1)
    bad = ~((length > 0) & np.isfinite(length))
    if bad.any():
        first = [int(axis[0]) for axis in np.nonzero(np.atleast_1d(bad))]
        raise QueryError(
            f"normals: expected vectors with a direction, found {int(bad.sum())} of {bad.size} zero or not finite, the "
            f"first at index {first}"
        )
    x, y, z = np.moveaxis(vectors / length[..., None], -1, 0)
    upper = z >= 0
    sin_theta = np.hypot(x, y)
    at_pole = sin_theta == 0
    divisor = np.where(at_pole, 1, sin_theta)
    cos_phi, sin_phi = np.where(at_pole, 0, x / divisor), np.where(at_pole, 1, y / divisor)
    # 1 − t_x and −t_y: x²/(1+z) and xy/(1+z).
    above = 1 / np.where(upper, 1 + z, 1)
    along_x = np.where(upper, x * x * above, cos_phi * cos_phi * (1 - z))
    along_y = np.where(upper, x * y * above, cos_phi * sin_phi * (1 - z))
    return np.stack([1 - along_x, -along_y, -x], axis=-1)


def to_local(directions: ArrayLike, normals: ArrayLike, tangents: ArrayLike) -> NDArray[np.float64]:
    """Coordinates (d·t, d·b, d·n), b = n × t, of `directions` [..., 3] in the frames of `normals` and `tangents`.

    The arrays broadcast: use normals[:, None] and tangents[:, None] for directions [V, B, 3]. Frames must be
    orthonormal.

    >>> from prt_bake import sphere
    >>> sphere.to_local([0.0, 1.0, 0.0], normals=[0.0, 0.0, 1.0], tangents=[1.0, 0.0, 0.0]).tolist()
    [0.0, 1.0, 0.0]
    """
    world, normal, tangent, bitangent = _frame(directions, normals, tangents)
    along = np.broadcast_arrays(*((world * axis).sum(axis=-1) for axis in (tangent, bitangent, normal)))
    return np.stack(along, axis=-1)


def to_world(local: ArrayLike, normals: ArrayLike, tangents: ArrayLike) -> NDArray[np.float64]:
    """Directions l_x t + l_y b + l_z n, b = n × t, of `local` [..., 3]: the inverse of `to_local`."""
    coordinates, normal, tangent, bitangent = _frame(local, normals, tangents)
    return np.asarray(
        coordinates[..., :1] * tangent + coordinates[..., 1:2] * bitangent + coordinates[..., 2:] * normal
    )


def _frame(
    directions: ArrayLike, normals: ArrayLike, tangents: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    world, normal, tangent = (
        _vectors(directions, "directions"),
        _vectors(normals, "normals"),
        _vectors(tangents, "tangents"),
    )
    try:
        np.broadcast_shapes(world.shape, normal.shape, tangent.shape)
    except ValueError as cause:
        shapes = ", ".join(str(list(each.shape)) for each in (world, normal, tangent))
        raise QueryError(f"directions, normals and tangents: expected shapes that broadcast, found {shapes}") from cause
    return world, normal, tangent, np.cross(normal, tangent)


def _vectors(vectors: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(numbers(name, vectors), dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise QueryError(f"{name}: expected an array [..., 3], found shape {list(array.shape)}")
    return array


def _require_bins(rings: int, sectors: int) -> None:
    if whole_number("rings", rings) < 1 or whole_number("sectors", sectors) < 1:
        raise QueryError(f"view bins: expected at least 1 ring and 1 sector, found {rings} and {sectors}")
