"""The error of a picture by the interpolation between vertices, estimated from their radiance alone."""

import math
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array

from formats.asset import Asset
from prt_bake.mathematics.sphere import to_local

Array = NDArray[np.float64]

_MOST_VERTICES = 2000
"""Vertices at which the estimate is made."""
_FEWEST_NEIGHBOURS = 4


def vertex_error(asset: Asset, shares: Array, radiance: Array, sigma: Array) -> float | None:
    """Relative RMSE of a picture by the linear interpolation between vertices; None if unknown.

    shares: of the vertices in the picture [V]; radiance and its standard error sigma [V,3], of vertices with shares.
    A vertex deviates from the plane through its neighbours by r₁, and from that through its neighbours' neighbours,
    about twice as far away, by r₂. A face is half as large as the first of these planes: if the deviation goes on to
    fall as it does from r₂ to r₁, that within faces is r₁² / r₂ (Richardson's extrapolation; r₁ / 4 if smooth).
    Squares are summed over the picture, without the bake's own errors. The error is unknown if most visible vertices
    have too few visible neighbours.
    """
    shown = asset.valid & (shares > 0.0)
    vertices = np.flatnonzero(shown)
    vertices = vertices[:: max(1, len(vertices) // _MOST_VERTICES)]
    near, far = _rings(asset.mesh.faces, vertices, shown)
    known, squares = np.ones(len(vertices), np.bool_), []
    for neighbours in (near, far):
        weights = _plane_weights(asset, vertices, neighbours)
        known &= np.diff(weights.indptr) >= _FEWEST_NEIGHBOURS
        noise = sigma[vertices] ** 2 + weights.power(2) @ sigma**2
        squares.append((radiance[vertices] - weights @ radiance) ** 2 - noise)
    share = shares[vertices, None]
    signal, kept = ((share[rows] * radiance[vertices[rows]] ** 2).sum() for rows in (slice(None), known))
    if kept <= 0.5 * signal:
        return None
    first, second = (max(0.0, float((share * each)[known].sum() / kept)) for each in squares)
    return math.sqrt(first * min(1.0, first / second)) if second > 0.0 else math.sqrt(first)


def _rings(faces: NDArray[np.integer], vertices: NDArray[np.int64], shown: NDArray[np.bool_]) -> list[csr_array]:
    """The shown neighbours of `vertices` [n], and the neighbours of those that are not among them: two [n,V] arrays."""
    count, reached = len(shown), np.zeros(len(shown), np.bool_)
    reached[vertices] = True
    for _ in range(2):
        around = faces[reached[faces].any(axis=1)]
        reached[around] = True
    begin, end = np.concatenate([around[:, list(pair)] for pair in permutations(range(3), 2)]).T
    edges = coo_array((np.ones(len(begin)), (begin, end)), shape=(count, count)).tocsr()
    near = edges[vertices] > 0.0
    far = (near @ edges > 0.0) > (near + eye_array(count, format="csr")[vertices] > 0.0)
    return [ring.multiply(shown).tocsr() for ring in (near, far)]


def _plane_weights(asset: Asset, vertices: NDArray[np.int64], neighbours: csr_array) -> csr_array:
    """Weights [n,V] of the neighbours: the value at each vertex of the plane fitted to theirs, in its tangent plane."""
    neighbours.eliminate_zeros()
    rows, others = neighbours.nonzero()
    at = vertices[rows]
    offset = asset.mesh.positions[others] - asset.mesh.positions[at]
    local = to_local(offset, asset.mesh.normals[at], np.asarray(asset.tangents, np.float64)[at])
    terms = np.column_stack([np.ones(len(rows)), local[:, :2] / np.linalg.norm(offset, axis=1).max(initial=0.0)])
    moments = np.zeros((len(vertices), 3, 3))
    np.add.at(moments, rows, terms[:, :, None] * terms[:, None, :])
    weights = np.einsum("ei,ei->e", terms, np.linalg.pinv(moments, rcond=1e-9, hermitian=True)[rows, 0])
    return csr_array((weights, others, neighbours.indptr), neighbours.shape)
