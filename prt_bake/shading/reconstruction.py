"""The inner loop of shading, compiled: interpolation between view bins and the dot product with a light.

Coefficients keep the asset's storage: float32, or the bits of float16 as uint16, converted by a table (numba has no
float16 on a CPU). Sums are float64.
"""

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from formats.asset.compact_record import CompactCoefficients
from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import using_threads
from prt_bake.mathematics.sphere import BinCoordinates
from prt_bake.shading.compact_reconstruction import reconstruct_compact

_BYTES_AT_ONCE = 64 << 20
_VERTICES_A_THREAD = 1 << 14
_COMPACT_VERTICES_A_THREAD = 1 << 13
"""Vertices that justify another thread; waiting for a thread on a busy machine costs milliseconds."""


def reconstruct(
    coefficients: Any, vertices: NDArray[np.int64], at: BinCoordinates, sectors: int, light: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Radiance [n,3], not clamped, of `vertices` [n] (ascending) towards the eye under light [K,3].

    coefficients: [V,B,K,C], float16 or float32, an array or an open HDF5 dataset, from which only the needed chunks are
    read; B and C may be 1 and are broadcast. Compact coefficients are not unpacked. at: coordinates of each vertex's
    direction to the eye between the view bins, fields [n] (`sphere.bin_coordinates`).
    """
    radiance = np.zeros((len(vertices), 3))
    places = BinCoordinates._make(np.ascontiguousarray(field) for field in at)
    light = np.ascontiguousarray(light, np.float64)
    if isinstance(coefficients, CompactCoefficients):
        with using_threads(1 + len(vertices) // _COMPACT_VERTICES_A_THREAD):
            reconstruct_compact(coefficients, vertices, places, sectors, light, radiance)
        return radiance
    with using_threads(1 + len(vertices) // _VERTICES_A_THREAD):
        for part, block, rows in coefficient_blocks(coefficients, vertices):
            half = block.dtype == np.float16
            bits, table = (block.view(np.uint16), _half_table()) if half else (block.view(), None)
            bits.flags.writeable = False  # a kernel for arrays that can be written would be compiled beside this one
            _reconstruct(bits, table, rows, tuple(field[part] for field in places), sectors, light, radiance[part])
    return radiance


def coefficient_blocks(
    coefficients: Any, vertices: NDArray[np.int64]
) -> Iterator[tuple[slice, Any, NDArray[np.int64]]]:
    """Yield runs of `vertices` (ascending), coefficients that contain them, and their rows in those coefficients.

    An array and compact coefficients are yielded unchanged. From a file only the chunks with requested vertices are
    read, a few at a time.
    """
    if isinstance(coefficients, (np.ndarray, CompactCoefficients)):
        yield slice(0, len(vertices)), coefficients, vertices
        return
    size = coefficients.chunks[0] if coefficients.chunks else 1
    chunks = np.unique(vertices // size)
    chunk_bytes = size * math.prod(coefficients.shape[1:]) * coefficients.dtype.itemsize
    step = max(1, _BYTES_AT_ONCE // chunk_bytes)
    for first in range(0, len(chunks), step):
        some = chunks[first : first + step]
        part = slice(*np.searchsorted(vertices, [some[0] * size, (some[-1] + 1) * size]).tolist())
        rows = size * np.searchsorted(some, vertices[part] // size) + vertices[part] % size
        yield part, np.concatenate([coefficients[c * size : (c + 1) * size] for c in some.tolist()]), rows


@cache
def _half_table() -> NDArray[np.float32]:
    """The value of each float16 bit pattern, float32 [65536]."""
    return np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32)


@compiled()
def _add_bin(transfer: Any, table: Any, light: Any, weight: Any, radiance: Any) -> None:
    """Add weight · Σ_k transfer[k] light[k] of one bin; numba removes the branch by the type of `table`."""
    last = transfer.shape[1] - 1
    for c in range(3):
        channel, total = min(c, last), 0.0
        for k in range(transfer.shape[0]):
            stored = transfer[k, channel]
            total += light[k, c] * (stored if table is None else table[stored])
        radiance[c] += weight * total


@compiled(parallel=True)
def _reconstruct(coefficients: Any, table: Any, rows: Any, at: Any, sectors: Any, light: Any, radiance: Any) -> None:
    ring_low, ring_high, ring_weight, sector_low, sector_high, sector_weight, pole_weight = at
    for n in prange(rows.shape[0]):
        bins, to_eye = coefficients[rows[n]], radiance[n]
        if bins.shape[0] == 1:
            _add_bin(bins[0], table, light, 1.0, to_eye)
            continue
        off_pole, high, share = 1.0 - pole_weight[n], ring_weight[n], sector_weight[n]
        for ring, ring_share in ((ring_low[n], off_pole * (1.0 - high)), (ring_high[n], off_pole * high)):
            if ring_share > 0.0:
                first = sectors * ring
                _add_bin(bins[first + sector_low[n]], table, light, ring_share * (1.0 - share), to_eye)
                _add_bin(bins[first + sector_high[n]], table, light, ring_share * share, to_eye)
        if pole_weight[n] > 0.0:
            for j in range(sectors):
                _add_bin(bins[j], table, light, pole_weight[n] / sectors, to_eye)
