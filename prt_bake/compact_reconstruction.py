"""The inner loop of shading compact coefficients: they are never unpacked.

With s_j = Σ_r φ_r(ωo) codes[r,j] of a vertex, φ_r its functions of the view interpolated between bins, the radiance is
Σ_j s_j · step · Σ_k channels[j,k] light[k]: the light meets the basis once for all vertices, and a vertex costs one
multiplication for each of its codes that is not zero.
"""

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from formats.compact_record import CompactCoefficients
from prt_bake.compilation import compiled
from prt_bake.sphere import BinCoordinates


def reconstruct_compact(
    compact: CompactCoefficients,
    vertices: NDArray[np.int64],
    places: BinCoordinates,
    sectors: int,
    light: NDArray[np.float64],
    radiance: NDArray[np.float64],
) -> None:
    """Set radiance [n,3] of `vertices` [n] under light [K,3], as `reconstruction.reconstruct` has it."""
    channels = compact.channels.astype(np.float64)
    lit = compact.step * np.einsum("jkc,kc->jc", np.broadcast_to(channels, (*channels.shape[:2], 3)), light)
    codes = compact.runs, compact.view_of_codes, compact.values
    _add_up(compact.view_table, codes, lit, vertices, tuple(places), sectors, radiance)


@compiled(fastmath={"reassoc", "contract"})
def _dot(values: Any, which: Any, view: Any, first: Any, end: Any) -> Any:
    total = 0.0
    for i in range(first, end):
        total += values[i] * view[which[i]]
    return total


@compiled()
def _interpolate(table: Any, n: Any, at: Any, sectors: Any, view: Any) -> None:
    """Set each function's value [R] in the direction of vertex n."""
    ring_low, ring_high, ring_weight, sector_low, sector_high, sector_weight, pole_weight = at
    if table.shape[0] == 1:
        view[:] = table[0]
        return
    off_pole, high, share = 1.0 - pole_weight[n], ring_weight[n], sector_weight[n]
    low, up = sectors * ring_low[n], sectors * ring_high[n]
    a, b = table[low + sector_low[n]], table[low + sector_high[n]]
    c, d = table[up + sector_low[n]], table[up + sector_high[n]]
    of_a, of_b = off_pole * (1.0 - high) * (1.0 - share), off_pole * (1.0 - high) * share
    of_c, of_d = off_pole * high * (1.0 - share), off_pole * high * share
    for r in range(view.shape[0]):
        view[r] = of_a * a[r] + of_b * b[r] + of_c * c[r] + of_d * d[r]
    if pole_weight[n] > 0.0:
        for j in range(sectors):
            for r in range(view.shape[0]):
                view[r] += pole_weight[n] / sectors * table[j, r]


@compiled(parallel=True)
def _add_up(table: Any, codes: Any, lit: Any, vertices: Any, at: Any, sectors: Any, radiance: Any) -> None:
    runs, which, values = codes
    for n in prange(vertices.shape[0]):
        view = np.empty(table.shape[1])
        _interpolate(table, n, at, sectors, view)
        run, to_eye = runs[vertices[n]], radiance[n]
        for j in range(lit.shape[0]):
            total = _dot(values, which, view, run[j], run[j + 1])
            for c in range(3):
                to_eye[c] += total * lit[j, c]
