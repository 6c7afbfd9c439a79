"""Local majorants: blocks of a grid with their least and largest extinction.

With one majorant for the whole grid the densest cell would determine the cost everywhere. Blocks as small as cells
would cost more steps than they save. The number of blocks minimises the expected steps of a long ray. Blocks whose
optical depth exceeds the cost of following their cells are tracked cell by cell (`prt_bake.tracer.volume.cells`).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEP_COST = 0.4
"""Cost of a step to the next block, in tentative collisions."""
_CELL_COST = 1.2
"""Cost of tracking one cell exactly, in tentative collisions."""
_MOST = 64
"""Largest number of blocks along the longest side."""


def steep_extinction(cells: tuple[int, ...], side: Array) -> float:
    """Extinction above which exact tracking through the cells of a grid [Z,Y,X] is cheaper than delta tracking."""
    return _CELL_COST * float((np.array(cells[:3]) / side[::-1]).max())


def extinction_blocks(grid: Array, side: Array) -> tuple[Array, tuple[int, int, int]]:
    """Least and largest extinction [.,2] of the blocks of a grid [Z,Y,X] or [Z,Y,X,3] over a box of `side` (x, y, z),
    x fastest, and the number of blocks along x, y and z.

    Blocks divide the box between the centres of the outermost voxels evenly; the outermost blocks extend to infinity.
    Values between centres are trilinear, so the voxels at the corners of its cells bound a block.
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
    """Blocks along z, y, x: `count` along the longest side, at most one per cell between voxel centres."""
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
    """Expected tentative collisions and weighted block steps of a ray as long as the longest side."""
    crossed = np.mean(np.array(shape[::-1]) / side) * side.max() if np.prod(shape) > 1 else 0.0
    return float(np.minimum(bounds[..., 1], steep_extinction(cells, side)).mean() * side.max() + _STEP_COST * crossed)
