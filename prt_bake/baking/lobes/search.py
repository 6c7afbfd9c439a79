"""Fits lobes at vertices: a network's own ones, and further ones fitted to the rest (`prt_bake.lobes.fit`)."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_on_sets
from bakers.horizon import clamp_to_horizon
from formats.asset import AssetHead
from formats.asset.lobes import LEAST_SHARPNESS, MOST_SHARPNESS
from prt_bake.baking.job.views import horizons
from prt_bake.lobes.fit import Field, LobeFit
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import fibonacci, random_rotations

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FINEST_NODES = 8, 16
_FEWEST_VIEWS = 4
_SETS, _DIRECTIONS, _DIRECTIONS_A_TERM = 16, 96, 4
_SHARPNESS_A_DIRECTION = 0.5
"""Narrower lobes fall between the directions."""
_SEED = 3


def node_grid(rings: int, sectors: int, bins: int) -> tuple[int, int]:
    """Rings and sectors of the nodes for an asset with these view bins, of which it stores `bins`: a few for each node,
    and one node if the asset has one bin for all views.
    """
    if bins == 1:
        return 1, 1
    return max(1, min(rings // 2, _FINEST_NODES[0])), max(1, min(sectors // 4, _FINEST_NODES[1]))


class LobeSearch:
    """Fits lobes at rings × sectors nodes to a transport.

    Views are twice as fine as the nodes. One half of them, like the black fields of a chessboard, is fitted; the other
    half is for checks.

    Attributes:
        own: number of lobes that the transport has itself.
        vertices: number of vertices of the mesh.
    """

    def __init__(self, smooth: Any, whole: Any, head: AssetHead, degree: int, grid: tuple[int, int]) -> None:
        """smooth: the transport without its own lobes, prepared for `degree`; whole: the same as it is."""
        self._smooth, self._whole, self.grid = smooth, whole, grid
        self._mesh, self._tangents = head.mesh, np.asarray(head.tangents, np.float64)
        found = self._own_lobes(self._mesh.positions[:1], self._mesh.normals[:1])
        self.own = 0 if found is None else int(found[1].shape[1])
        self.vertices = len(head.mesh.positions)
        self._around = horizons(head.mesh)
        directions = max(_DIRECTIONS, _DIRECTIONS_A_TERM * sh.count(degree))
        self._pool = np.stack([fibonacci(directions) @ turn.T for turn in random_rotations(_SETS, _SEED)])
        rings, sectors = max(_FEWEST_VIEWS, 2 * grid[0]), max(_FEWEST_VIEWS, grid[1])
        ring, sector = np.divmod(np.arange(rings * sectors), sectors)
        views, sets, even = sphere.view_bins(rings, sectors), ring % 4 * 4 + sector % 4, (ring + sector) % 2 == 0
        most = min(_SHARPNESS_A_DIRECTION * directions, MOST_SHARPNESS)
        between = views @ _turned(math.pi / sectors).T
        self._halves = [(views[even], sets[even]), (between[~even], sets[~even])]
        self.fit, self.check = (LobeFit(*grid, *half, self._pool, degree, most) for half in self._halves)

    def fields(self, vertices: Index, own: bool, fitted: int) -> list[Field]:
        """The transport's own lobes if `own`, and `fitted` ones more, at the nodes of `vertices`."""
        found = self.own_fields(vertices) if own else []
        if fitted:
            values, scale = self.values(vertices, 0)
            rest = self.fit.beyond_harmonics(values)
            for _ in range(fitted):
                axes, sharpness, powers = self.fit.add(rest)
                found.append(Field(axes, sharpness, powers * scale[:, None, None]))
        return found

    def own_fields(self, vertices: Index) -> list[Field]:
        """The transport's own lobes at the nodes of `vertices`."""
        outgoing = self.outgoing(vertices, sphere.view_bins(*self.grid))
        at = np.repeat(self._mesh.positions[vertices], outgoing.shape[1], axis=0)
        found = self._own_lobes(at, outgoing.reshape(-1, 3))
        if found is None:
            return []
        axes, sharpness, powers = (part.reshape(*outgoing.shape[:2], *part.shape[1:]) for part in found)
        sharpness = np.clip(sharpness, LEAST_SHARPNESS, MOST_SHARPNESS)
        return [Field(axes[:, :, k].copy(), sharpness[:, :, k].copy(), powers[:, :, k].copy()) for k in range(self.own)]

    def values(self, vertices: Index, half: int) -> tuple[NDArray[np.float32], Array]:
        """Ŝ without own lobes [n,B,D,3] in one half of the views, relative to the largest value of each vertex [n].

        Both are 0 at vertices where a value is not finite.
        """
        local, sets = self._halves[half]
        outgoing = self.outgoing(vertices, local)
        positions, rotation = self._mesh.positions[vertices], np.repeat(sets[None], len(vertices), axis=0)
        values = values_on_sets(self._smooth, self._pool, rotation, positions, outgoing)
        largest = np.abs(values).max(axis=(1, 2, 3)).astype(np.float64)
        usable = np.isfinite(largest) & (largest > 0.0)
        scaled = np.zeros(values.shape, np.float32)
        scaled[usable] = values[usable] / largest[usable, None, None, None]
        return scaled, np.where(usable, largest, 0.0)

    def _own_lobes(self, positions: Array, outgoing: Array) -> tuple[Array, Array, Array] | None:
        lobes_of = getattr(self._whole, "own_lobes", None)
        return None if lobes_of is None else lobes_of(positions, outgoing)

    def outgoing(self, vertices: Index, local: Array) -> Array:
        """Directions to the eye [n,B,3], clamped to the horizon."""
        world = sphere.to_world(local, self._mesh.normals[vertices][:, None], self._tangents[vertices][:, None])
        return clamp_to_horizon(world, self._around, vertices)[0]


def _turned(angle: float) -> Array:
    """A rotation [3,3] about the normal of a local frame."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
