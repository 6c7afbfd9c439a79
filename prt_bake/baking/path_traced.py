"""A scene as a transport: its coefficients are estimated by random walks, without a network."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.path_traced import WalkStatistics
from formats.errors import QueryError, warn
from formats.mesh import Mesh, inward_sentence
from formats.scene import Scene
from prt_bake.geometry.surface import clamp_to_horizon
from prt_bake.mathematics.random import hashed

if TYPE_CHECKING:
    from prt_bake.tracer.estimate import Estimate

Array = NDArray[np.float64]

_FEW_INWARD = 0.01
"""Share of vertices whose normals may point inwards without a word, as at sharp creases."""


@dataclass(frozen=True)
class BlockEstimate:
    """`mean` and one-sigma `standard_error` of coefficients [n,B,K,3], and statistics of the walks."""

    mean: Array
    standard_error: Array
    statistics: WalkStatistics


class PathTraced:
    """The path tracer as a transport (`bakers.transport`)."""

    def __init__(self, scene: Scene, device: Literal["cpu", "cuda"] = "cpu") -> None:
        """Walks run on `device`."""
        self.scene, self.device = scene, device
        self.metadata: dict[str, Any] = {
            "scene": scene.path.name,
            "scene_hash": scene.content_hash,
            "up": scene.up,
            "unit": scene.unit,
            "eta": scene.eta,
            "roughness": float(np.mean(scene.roughness)),
            "normals": scene.normals,
        }

    def estimate_coefficients(
        self, positions: ArrayLike, outgoing: ArrayLike, degree: int, paths: int, seed: int
    ) -> "Estimate":
        """a_lm [N,K,3] at positions [N,3] on the scene's surface, seen along outgoing [N,3].

        Raises QueryError for positions off the surface and directions below the horizon.
        """
        from prt_bake.tracer.estimate import estimate_coefficients

        return estimate_coefficients(self.scene, positions, outgoing, degree, paths, seed, device=self.device)

    def estimate_block(
        self, positions: ArrayLike, outgoing: ArrayLike, degree: int, paths: int, seeds: Sequence[int]
    ) -> BlockEstimate:
        """a_lm [n,B,K,3] at vertices [n,3] seen along outgoing [n,B,3]; each vertex has its own seed of `seeds` [n].

        Directions below the horizon of the scene's faces, which may differ from those of the baked mesh, are clamped to
        it and counted. Raises QueryError for positions off the surface.
        """
        from prt_bake.tracer.estimate import estimate_coefficients

        towards_eye = np.asarray(outgoing, np.float64)
        n, bins = towards_eye.shape[:2]
        at = np.repeat(np.asarray(positions, np.float64), bins, axis=0)
        above, clamped = self._clamped(at, towards_eye.reshape(-1, 3))
        keys = hashed(np.asarray(seeds, np.int64)[:, None], np.arange(bins)).reshape(-1)
        estimate = estimate_coefficients(self.scene, at, above, degree, paths, keys=keys, device=self.device)
        shape = (n, bins, (degree + 1) ** 2, 3)
        statistics = WalkStatistics(
            bins=n * bins,
            clamped=clamped,
            unreliable=int((~estimate.reliable).sum()),
            unscattered=float(estimate.unscattered.reshape(n * bins, -1).mean(axis=1).sum()),
            lost=float(estimate.lost.sum()),
        )
        return BlockEstimate(estimate.mean.reshape(shape), estimate.standard_error.reshape(shape), statistics)

    def refuse_foreign(self, mesh: Mesh) -> None:
        """Raises QueryError unless the vertices of `mesh` are on the scene's surface, most normals outward.

        Warns if more than a few normals point inwards.
        """
        from prt_bake.tracer.prepared import prepare

        surface, scene = prepare(self.scene).surface, self.scene
        faces, _, cosines = surface.find_faces(mesh.positions, mesh.normals)
        if (astray := np.flatnonzero(faces < 0)).size:
            first = int(astray[0])
            away = surface.distance(mesh.positions[first])
            raise QueryError(
                f"mesh: {len(astray)} of {len(faces)} vertices do not lie on the surface of {scene.path}; the first is "
                f"number {first}, {away:.3g} away, allowed are {surface.reach:.3g} (1e-4 of the object's diagonal); "
                f"bake the scene's own mesh, {scene.mesh_path}"
            )
        inward = np.flatnonzero(cosines <= 0.0)
        if 2 * inward.size > len(faces):
            raise QueryError(
                f"mesh: the normals of {inward.size} of {len(faces)} vertices point into the object of {scene.path}; "
                "its faces are wound inside out: flip the normals"
            )
        if inward.size > _FEW_INWARD * len(faces):
            warn(inward_sentence(mesh, inward, f"of {scene.path}"))

    def _clamped(self, positions: Array, outgoing: Array) -> tuple[Array, int]:
        """Directions [N,3], those below the scene's horizon clamped to it, and how many were."""
        from prt_bake.tracer.prepared import prepare

        surface = prepare(self.scene).surface
        faces, _, cosines = surface.find_faces(positions, outgoing)
        below = (faces >= 0) & (cosines <= 0.0)
        above = outgoing.copy()
        above[below] = clamp_to_horizon(outgoing[below], np.asarray(surface.mesh.face_normals)[faces[below]])
        return above, int(below.sum())
