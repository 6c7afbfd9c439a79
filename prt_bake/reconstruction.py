"""The inner loop of shading, compiled: view-bin interpolation of transfer vectors and their dot product with a light.

Coefficients stay as they lie in the asset: float32, or the bits of float16 as uint16, widened by a table (numba has no half floats
on a CPU). Sums are float64.
"""

from functools import cache
from typing import Any

import numpy as np
from numba import njit, prange, types
from numba.extending import overload
from numpy.typing import NDArray

from prt_bake.sphere import BinCoordinates


@cache
def half_table() -> NDArray[np.float32]:
    """float32 [65536]: the value of each float16 bit pattern."""
    return np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32)


def _widened(stored, table):
    """The number that `stored` stands for: itself, or the table's entry for the bits of a half float.

    Without annotations: numba compares the signatures of an overload to the letter.
    """
    raise RuntimeError("for compiled code only")


@overload(_widened)
def _widened_compiled(stored, table):
    if isinstance(stored, types.Integer):
        return lambda stored, table: table[stored]
    return lambda stored, table: stored


@njit(cache=True)
def _add_bin(coefficients: Any, table: Any, vertex: Any, b: Any, light: Any, weight: Any, radiance: Any) -> None:
    channels = coefficients.shape[3]
    for k in range(coefficients.shape[2]):
        for c in range(3):
            radiance[c] += weight * light[k, c] * _widened(coefficients[vertex, b, k, min(c, channels - 1)], table)


@njit(cache=True)
def _add_ring(
    coefficients: Any, table: Any, vertex: Any, first: Any, low: Any, high: Any, share: Any, light: Any, weight: Any, radiance: Any
) -> None:
    if weight != 0.0:
        _add_bin(coefficients, table, vertex, first + low, light, weight * (1.0 - share), radiance)
        _add_bin(coefficients, table, vertex, first + high, light, weight * share, radiance)


@njit(cache=True, parallel=True)
def _reconstruct(coefficients: Any, table: Any, rows: Any, at: Any, sectors: Any, light: Any, radiance: Any) -> None:
    ring_low, ring_high, ring_weight, sector_low, sector_high, sector_weight, pole_weight = at
    for n in prange(rows.shape[0]):
        vertex = rows[n]
        if coefficients.shape[1] == 1:
            _add_bin(coefficients, table, vertex, 0, light, 1.0, radiance[n])
            continue
        for j in range(sectors):
            if pole_weight[n] > 0.0:
                _add_bin(coefficients, table, vertex, j, light, pole_weight[n] / sectors, radiance[n])
        off_pole = 1.0 - pole_weight[n]
        low, high, share = sector_low[n], sector_high[n], sector_weight[n]
        first, second = sectors * ring_low[n], sectors * ring_high[n]
        weight = ring_weight[n]
        _add_ring(
            coefficients, table, vertex, first, low, high, share, light, off_pole * (1.0 - weight), radiance[n]
        )
        _add_ring(coefficients, table, vertex, second, low, high, share, light, off_pole * weight, radiance[n])


def reconstruct(
    coefficients: NDArray[Any], rows: NDArray[np.int64], at: BinCoordinates, sectors: int, light: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Radiance [n,3], negative values kept, of the vertices `rows` [n] of coefficients [V,B|1,K,3|1] under light [K,3].

    `at` holds where each vertex's direction to the eye lies between the view bins (`sphere.bin_coordinates`).
    """
    stored = coefficients.view(np.uint16) if coefficients.dtype == np.float16 else coefficients
    radiance = np.zeros((len(rows), 3))
    _reconstruct(
        stored,
        half_table(),
        np.ascontiguousarray(rows, np.int64),
        tuple(np.ascontiguousarray(part) for part in at),
        sectors,
        np.ascontiguousarray(light, np.float64),
        radiance,
    )
    return radiance
