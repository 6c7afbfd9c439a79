"""Ŝ over the cells of the sphere: evaluated by a network, or path traced."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_at
from bakers.transport import on_mesh, prepared, refuse_foreign, transport_kind
from formats.errors import QueryError
from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.bases.cells import cell_directions, cell_numbers
from prt_bake.bases.points import Points
from prt_bake.mathematics.directions import fibonacci

Array = NDArray[np.float64]

_AT_ONCE = 1 << 20
_FEW = fibonacci(64)
_WALKS, _FEW_WALKS = 4096, 64
_WALKS_AT_ONCE = 1 << 20
_STREAM = 62


class Source(Protocol):
    """What bases represent.

    Attributes:
        cells: cells along a side of the octahedron.
        lobes: lobes that the network has.
    """

    cells: int
    lobes: int

    def squares(self, points: Points) -> Array:
        """A rough estimate [N] of Σ Ŝ² over directions of incidence."""

    def values(self, points: Points, repeated: int) -> list[Array]:
        """Independent estimates [N,M,3] of Ŝ over the cells, `repeated` of them; the same one if it is exact."""

    def own_lobes(self, values: Array, points: Points) -> Array | None:
        """The detail beyond degree 2 [N,M,3] of the network's own lobes; None if it has none."""


class OfModel:
    """A network or any other transport that evaluates Ŝ, at the centres of 64 × 64 cells, 3.2° wide."""

    cells = 64

    def __init__(self, transport: Any, mesh: Mesh, up: str) -> None:
        """Bind a transport to the mesh.

        Raises QueryError for a transport without Ŝ or a mesh that is not its own.
        """
        refuse_foreign(transport, mesh)
        if transport_kind(transport) == "coefficients":
            raise QueryError("bases: expected a transport that evaluates Ŝ, found one that estimates coefficients only")
        self._transport = prepared(on_mesh(transport, mesh), "float32", "cpu")
        self._directions = cell_directions(self.cells, up)
        settings = getattr(transport, "settings", None)
        self.lobes = int(getattr(settings, "lobes", 0))
        self._without_lobes = prepared(on_mesh(transport.smooth(2), mesh), "float32", "cpu") if self.lobes else None

    def squares(self, points: Points) -> Array:
        """See `Source`."""
        return np.asarray((_evaluated(self._transport, points, _FEW) ** 2).sum(axis=(1, 2)))

    def values(self, points: Points, repeated: int) -> list[Array]:
        """See `Source`."""
        return [_evaluated(self._transport, points, self._directions)] * repeated

    def own_lobes(self, values: Array, points: Points) -> Array | None:
        """See `Source`. Up to degree 2, a network has only the bands of its lobes up to that degree."""
        if self._without_lobes is None:
            return None
        return values - _evaluated(self._without_lobes, points, self._directions)


class OfScene:
    """A scene, path traced: walks by the cells of 32 × 32, 6.4° wide, through which they leave the object."""

    cells, lobes = 32, 0

    def __init__(self, scene: Scene) -> None:
        """Wrap a scene."""
        self._scene = scene

    def squares(self, points: Points) -> Array:
        """See `Source`."""
        walked = self._walked(points, _FEW_WALKS, 1)
        return np.asarray((walked.sum(axis=1) ** 2).sum(axis=1))

    def values(self, points: Points, repeated: int) -> list[Array]:
        """See `Source`."""
        return [self._walked(points, _WALKS, 2 + part) for part in range(repeated)]

    def own_lobes(self, values: Array, points: Points) -> Array | None:
        """See `Source`."""
        return None

    def _walked(self, points: Points, walks: int, seed: int) -> Array:
        """Means of Ŝ [N,M,3] over the cells, from `walks` walks at each point; unscattered light is left out."""
        from prt_bake.tracer.light_samples import sample_exits

        count = self.cells**2
        found = np.zeros((len(points.faces), count, 3))
        step = max(1, _WALKS_AT_ONCE // walks)
        for first in range(0, len(found), step):
            some = np.arange(first, min(first + step, len(found)))
            part = points.subset(some)
            keys = some.astype(np.uint64)
            exits = sample_exits(self._scene, part.faces, part.barycentric, part.outgoing, keys, walks, _STREAM + seed)
            throughput = np.where(exits.unscattered[..., None], 0.0, exits.throughput).reshape(-1, 3)
            directions = exits.directions.reshape(-1, 3)
            left = throughput.any(axis=1)
            rows = np.repeat(np.arange(len(some)), walks)[left]
            numbers = rows * count + cell_numbers(directions[left], self.cells, self._scene.up)
            for c in range(3):
                sums = np.bincount(numbers, throughput[left, c], len(some) * count)
                found[some, :, c] = sums.reshape(len(some), count)
        return found * (count / (4.0 * np.pi * walks))


def _evaluated(transport: Any, points: Points, directions: Array) -> Array:
    found = np.empty((len(points.positions), len(directions), 3))
    step = max(1, _AT_ONCE // len(directions))
    for first in range(0, len(found), step):
        part = points.subset(slice(first, first + step))
        rows = np.zeros(len(part.positions), np.int64)
        found[first : first + step] = values_at(transport, directions[None], rows, part.positions, part.outgoing)
    return found
