"""The job of an adaptive bake: what is baked, in which blocks, and the values of its transport at view bins."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_at
from formats.mesh import Mesh
from prt_bake.baking.job.views import Views

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BINS_AT_ONCE, FEWEST_AT_ONCE, MOST_AT_ONCE = 1 << 15, 1 << 12, 1024
"""Most and fewest bins of a block, the latter with many workers; and most vertices of a block."""
BLOCKS_PER_WORKER = 4
"""Least number of blocks per worker, so that workers finish at about the same time."""
MANY = 1 << 18
"""Bins of an object for which a pilot is a small part of the cost."""


@dataclass(frozen=True)
class AdaptiveJob:
    """Transport, vertices, view bins and degree of an adaptive bake."""

    transport: Any
    mesh: Mesh
    vertices: Index
    """Indices of the vertices that are baked."""
    views: Views
    local: Array
    """View bins [B,3] in the local frame."""
    degree: int
    seed: int
    grid: tuple[int, int] | None = None
    """Rings and sectors, if `local` holds all of their bins."""
    at_once: int | None = None
    """Vertices of a block; None: as `vertices_at_once` chooses."""

    @property
    def bins(self) -> int:
        """View bins of a vertex."""
        return len(self.local)

    @property
    def many(self) -> int:
        """View bins of all vertices."""
        return self.bins * len(self.vertices)

    @property
    def block_vertices(self) -> int:
        """Vertices of a block."""
        return self.at_once or vertices_at_once(len(self.vertices), self.bins, 1)

    @property
    def blocks(self) -> range:
        """Index into `vertices` of the first vertex of each block."""
        return range(0, len(self.vertices), self.block_vertices)

    def block(self, first: int) -> Index:
        """The vertices of a block."""
        return self.vertices[first : first + self.block_vertices]

    def vertices_and_views(self, bins: Index) -> tuple[Index, Array]:
        """The vertices of bins [M], counted over all baked vertices, and their directions to the eye [M,3]."""
        rows, local = np.divmod(bins, self.bins)
        vertices = self.vertices[rows]
        distinct, inverse = np.unique(vertices, return_inverse=True)
        return vertices, self.views(distinct)[0][inverse, local]

    def values_at_bins(self, directions: Array, rotations: Array, bins: Index) -> NDArray[np.floating]:
        """Ŝ [M,D,3] at bins [M], counted over all baked vertices, in directions [D,3] rotated by rotations [M,3,3]."""
        vertices, outgoing = self.vertices_and_views(bins)
        incident = directions @ rotations.transpose(0, 2, 1)
        return values_at(self.transport, incident, np.arange(len(bins)), self.mesh.positions[vertices], outgoing)


def vertices_at_once(vertices: int, bins: int, workers: int) -> int:
    """Vertices of a block: large blocks, but enough of them for all workers."""
    largest = int(np.clip(BINS_AT_ONCE // bins, 1, MOST_AT_ONCE))
    fair = -(-vertices // (BLOCKS_PER_WORKER * workers)) if workers > 1 else largest
    return min(largest, max(fair, FEWEST_AT_ONCE // bins, 1))
