"""Small bright sources of a function on a lat-long grid: regions flooded from its peaks, brightest cells first."""

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BrightSource:
    """Cells [N] (row · columns + column, ascending) above `level`; excess: Σ (value − level) · solid angle."""

    cells: NDArray[np.int64]
    level: float
    excess: float


def find_bright_sources(
    values: Array, solid_angle: Array, direction: Array, max_spread: float, min_excess: float
) -> list[BrightSource]:
    """The largest regions of values [R,C] with at most `max_spread` and at least an excess `min_excess` > 0.

    They are in order of falling peaks. A region is a connected set of cells above a level. Its spread is 1 − |mean
    direction|, weighted by solid angle [R,C], from the mean directions of the cells [R,C,3]. Its level is the lowest at
    which the spread is small enough. Cells that share an edge or a corner are neighbours, columns wrap around, and all
    cells at a pole are neighbours.
    """
    grid = _Grid(values, solid_angle, direction)
    # The largest region with this spread is a cap of solid angle 4π · max_spread.
    candidates = np.flatnonzero(grid.values * (4.0 * math.pi * max_spread) >= min_excess)
    sources: list[BrightSource] = []
    taken: set[int] = set()
    for peak in candidates[np.argsort(-grid.values[candidates], kind="stable")].tolist():
        if peak in taken or not grid.is_peak(peak):
            continue
        cells, level = _flood(grid, peak, max_spread, taken)
        excess = float(((grid.values[cells] - level) * grid.solid_angle[cells]).sum())
        if excess >= min_excess:
            sources.append(BrightSource(np.sort(cells), level, excess))
            taken.update(cells.tolist())
    return sources


class _Grid:
    def __init__(self, values: Array, solid_angle: Array, direction: Array) -> None:
        self.rows, self.columns = values.shape
        self.values, self.solid_angle = values.ravel(), solid_angle.ravel()
        self.moments = direction.reshape(-1, 3) * self.solid_angle[:, None]

    def is_peak(self, cell: int) -> bool:
        """Whether no neighbour is brighter; of equally bright neighbours the first is the peak."""
        value = self.values[cell]
        return not any((self.values[other], -other) > (value, -cell) for other in self.neighbours(cell))

    def neighbours(self, cell: int) -> list[int]:
        row, column = divmod(cell, self.columns)
        cells = [
            r * self.columns + c % self.columns
            for r in (row - 1, row, row + 1)
            if 0 <= r < self.rows
            for c in (column - 1, column, column + 1)
        ]
        if row in (0, self.rows - 1):
            cells += range(row * self.columns, (row + 1) * self.columns)
        return cells


def _flood(grid: _Grid, peak: int, max_spread: float, taken: set[int]) -> tuple[NDArray[np.int64], float]:
    """The cells around a peak above the level at which they spread too far, and that level.

    Cells that are `taken` by another source are left out. If they never spread too far, the level is the least value of
    the grid.
    """
    level = float(grid.values[peak])
    cells: list[int] = []
    above = 0  # number of cells above the level
    visited, rim = {peak, *taken}, [(-level, peak)]
    moment, area = np.zeros(3), 0.0
    while rim:
        negative, cell = heapq.heappop(rim)
        if -negative < level:
            level, above = -negative, len(cells)
        cells.append(cell)
        moment, area = moment + grid.moments[cell], area + float(grid.solid_angle[cell])
        if 1.0 - math.sqrt(float(moment @ moment)) / area > max_spread:
            return np.array(cells[:above], np.int64), level
        for other in grid.neighbours(cell):
            if other not in visited:
                visited.add(other)
                heapq.heappush(rim, (-float(grid.values[other]), other))
    return np.array(cells, np.int64), level
