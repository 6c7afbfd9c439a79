"""Blocks of a grid with their least and largest extinction, so that tracking steps as far as each place allows.

A majorant for the whole grid would let its densest cell decide the cost everywhere; blocks as small as cells would cost
more steps than they save. The number of blocks is chosen by the steps that a long ray is expected to take. Blocks that
are deeper than their cells are many are followed cell by cell (`prt_bake.tracer.volume.cells`).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEP_COST = 0.4
"""Leaving a block, in tentative events."""
_CELL_COST = 1.2
"""Following a cell exactly, in tentative events."""
_MOST = 64


def steep(cells: tuple[int, ...], side: Array) -> float:
    """The extinction above which following the cells of a grid [Z,Y,X] costs less than tentative events."""
    return _CELL_COST * float((np.array(cells[:3]) / side[::-1]).max())


def blocks_of(grid: Array, side: Array) -> tuple[Array, tuple[int, int, int]]:
    """Least and largest extinction [.,2] of the blocks of a grid [Z,Y,X] or [Z,Y,X,3] over a box of `side` (x, y, z).

    Returns them, x fastest, with the number of blocks along x, y and z. They share the box between the centres of the
    outermost voxels evenly, and beyond that box those at its sides go on. Values between the centres are trilinear, so
    that what is largest and least in a block lies among the voxels that it reaches to.
    """
    low = grid.min(axis=3) if grid.ndim == 4 else grid
    high = grid.max(axis=3) if grid.ndim == 4 else grid
    best, cost = None, np.inf
    count = 1
    while count <= _MOST:
        shape = _shape(low.shape, side, count)
        bounds = np.stack([_reduced(low, shape, np.minimum), _reduced(high, shape, np.maximum)], axis=-1)
        spent = _steps(bounds, shape, low.shape, side)
        if spent < cost:
            best, cost = (bounds, shape), spent
        if all(n >= voxels - 1 for n, voxels in zip(shape, low.shape, strict=True)):
            break
        count *= 2
    assert best is not None
    bounds, (nz, ny, nx) = best
    return np.ascontiguousarray(bounds.reshape(-1, 2)), (nx, ny, nz)


def _shape(cells: tuple[int, ...], side: Array, count: int) -> tuple[int, int, int]:
    """Blocks along z, y, x: `count` along the longest side, no more than there are cells between centres."""
    wanted = np.ceil(count * side[::-1] / side.max()).astype(int)
    nz, ny, nx = (int(max(1, min(n - 1, w))) for n, w in zip(cells, wanted, strict=True))
    return nz, ny, nx


def _reduced(grid: Array, shape: tuple[int, int, int], take: np.ufunc) -> Array:
    for axis, blocks in enumerate(shape):
        cells = grid.shape[axis]
        edges = np.arange(blocks + 1) / blocks * (cells - 1)
        first = np.clip(np.floor(edges[:-1] - 1e-6), 0, cells - 1).astype(int)
        last = np.clip(np.ceil(edges[1:] + 1e-6), 0, cells - 1).astype(int)
        rows = np.moveaxis(grid, axis, 0)
        grid = np.moveaxis(
            np.stack([take.reduce(rows[a : b + 1], axis=0) for a, b in zip(first, last, strict=True)]), 0, axis
        )
    return grid


def _steps(bounds: Array, shape: tuple[int, int, int], cells: tuple[int, ...], side: Array) -> float:
    """Tentative events and steps between blocks that a ray along the longest side is expected to take."""
    crossed = np.mean(np.array(shape[::-1]) / side) * side.max() if np.prod(shape) > 1 else 0.0
    return float(np.minimum(bounds[..., 1], steep(cells, side)).mean() * side.max() + _STEP_COST * crossed)
