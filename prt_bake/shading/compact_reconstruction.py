"""The inner loop of shading compact coefficients, without unpacking them.

The radiance of a vertex is Σ_j s_j · step · Σ_k channels[j,k] light[k] with s_j = Σ_r φ_r(ωo) codes[r,j], where φ_r are
the view functions interpolated between bins. The light is multiplied with the basis once for all vertices, and a vertex
costs one product per code. View functions that most vertices use are stored densely, with zeros, which is ten times as
fast per code; of the others only the nonzero codes are stored.
"""

from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numba import prange
from numpy.typing import NDArray

from formats.asset.compact_record import CompactCoefficients
from prt_bake.jit.compilation import compiled
from prt_bake.mathematics.sphere import BinCoordinates

_DENSE_FROM = 0.08
"""Share of nonzero codes from which a view function is stored densely."""
_DENSE_BYTES = 1 << 29


class CodeLayout(NamedTuple):
    """Codes in the layout of the kernel.

    table: float32 [B,R], view functions at the bins, most used first. dense: [V,J,D], codes of the first D view
    functions, with 0 for large ones. values, which: all other codes [M] and their view functions. Those of vertex v and
    channel function j are the elements runs[v,j] to runs[v,j+1]; runs [V,J+1].
    """

    table: NDArray[np.float32]
    dense: NDArray[np.int8]
    runs: NDArray[np.int64]
    which: NDArray[np.uint32]
    values: NDArray[np.signedinteger]


_LAYOUTS: WeakKeyDictionary[CompactCoefficients, CodeLayout] = WeakKeyDictionary()


def reconstruct_compact(
    compact: CompactCoefficients,
    vertices: NDArray[np.int64],
    places: BinCoordinates,
    sectors: int,
    light: NDArray[np.float64],
    radiance: NDArray[np.float64],
) -> None:
    """Set radiance [n,3] of `vertices` [n] under light [K,3], as `reconstruction.reconstruct`."""
    channels = compact.channels.astype(np.float64)
    # The sum may be laid out by columns, for which the kernel would be compiled again.
    basis_light = compact.step * np.einsum(
        "jkc,kc->jc", np.broadcast_to(channels, (*channels.shape[:2], 3)), light, order="C"
    )
    if compact not in _LAYOUTS:
        _LAYOUTS[compact] = arrange(compact)
    _reconstruct(tuple(_LAYOUTS[compact]), basis_light, vertices, tuple(places), sectors, radiance)


def arrange(compact: CompactCoefficients) -> CodeLayout:
    """Bring codes into the layout of the kernel."""
    vertices, functions, width = len(compact), len(compact.view_matrix), len(compact.channels)
    views, channels = (part[compact.components] for part in (compact.view_component, compact.channel_component))
    used = np.bincount(views, minlength=functions)
    order = np.argsort(-used, kind="stable")
    limit = _DENSE_BYTES // max(1, vertices * width)
    size = min(int((used >= _DENSE_FROM * vertices * width).sum()), limit)
    place = np.empty(functions, np.uint32)
    place[order] = np.arange(functions, dtype=np.uint32)
    which = place[views]
    row = np.repeat(np.arange(vertices), np.diff(compact.starts)) * width + channels
    dense = np.zeros((vertices * width, size), np.int8)
    fits = (which < size) & (np.abs(compact.values) < 128)
    dense[row[fits], which[fits]] = compact.values[fits]
    others = ~fits
    ends = np.concatenate([[0], np.cumsum(np.bincount(row[others], minlength=vertices * width))])
    runs = ends[np.arange(vertices)[:, None] * width + np.arange(width + 1)]
    table = np.ascontiguousarray(compact.view_matrix[order].T, np.float32)
    return CodeLayout(table, dense.reshape(vertices, width, size), runs, which[others], compact.values[others])


@compiled(fastmath=True)
def _dense_dot(codes: Any, view: Any) -> Any:
    total = np.float32(0.0)
    for r in range(codes.shape[0]):
        total += np.float32(codes[r]) * view[r]
    return total


@compiled()
def _sparse_dot(values: Any, which: Any, view: Any) -> Any:
    total = 0.0
    for i in range(values.shape[0]):
        total += values[i] * view[which[i]]
    return total


@compiled()
def _interpolate(table: Any, n: Any, at: Any, sectors: Any, view: Any) -> None:
    """Set view [R] to the view functions in the eye's direction of vertex n."""
    ring_low, ring_high, ring_weight, sector_low, sector_high, sector_weight, pole_weight = at
    if table.shape[0] == 1:
        view[:] = table[0]
        return
    off_pole, high, share = 1.0 - pole_weight[n], ring_weight[n], sector_weight[n]
    low, up = sectors * ring_low[n], sectors * ring_high[n]
    a, b = table[low + sector_low[n]], table[low + sector_high[n]]
    c, d = table[up + sector_low[n]], table[up + sector_high[n]]
    of_a, of_b = np.float32(off_pole * (1.0 - high) * (1.0 - share)), np.float32(off_pole * (1.0 - high) * share)
    of_c, of_d = np.float32(off_pole * high * (1.0 - share)), np.float32(off_pole * high * share)
    for r in range(view.shape[0]):
        view[r] = of_a * a[r] + of_b * b[r] + of_c * c[r] + of_d * d[r]
    if pole_weight[n] > 0.0:
        of_each = np.float32(pole_weight[n] / sectors)
        for j in range(sectors):
            for r in range(view.shape[0]):
                view[r] += of_each * table[j, r]


@compiled(parallel=True)
def _reconstruct(codes: Any, basis_light: Any, vertices: Any, at: Any, sectors: Any, radiance: Any) -> None:
    table, dense, runs, which, values = codes
    for n in prange(vertices.shape[0]):
        view = np.empty(table.shape[1], np.float32)
        _interpolate(table, n, at, sectors, view)
        run, rows, to_eye = runs[vertices[n]], dense[vertices[n]], radiance[n]
        for j in range(basis_light.shape[0]):
            some = slice(run[j], run[j + 1])
            total = _dense_dot(rows[j], view) + _sparse_dot(values[some], which[some], view)
            for c in range(3):
                to_eye[c] += total * basis_light[j, c]
