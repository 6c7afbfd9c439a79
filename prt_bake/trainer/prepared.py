"""A scene made ready for the kernels: centred, scaled to its longest side, with its Embree tree built once."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.surface import Location, Surface
from prt_bake.trainer.aim import Aim, aim_for
from prt_bake.trainer.embree import TriangleScene, intersect_address
from prt_bake.trainer.interface import MATCHED, ROUGH, SMOOTH
from prt_bake.trainer.media import Medium
from prt_bake.trainer.walk import Boundary

MOST_EVENTS = 10_000_000
"""Events after which a walk is cut; what it still carried is reported as lost."""
_SMOOTHEST = 1e-4
"""A rough interface below this alpha is taken as smooth: its lobe is narrower than what float64 samples tell apart."""

Array = NDArray[np.float64]


class PreparedScene:
    """`boundary` and `medium` for kernels, `surface` to place queries, and the change to the kernels' coordinates."""

    def __init__(self, scene: Scene) -> None:
        """Build from a scene record; costs the building of an Embree tree."""
        mesh = scene.mesh
        low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
        self.center: Array = 0.5 * (low + high)
        self.scale = float((high - low).max())
        self.surface = Surface(mesh)
        self.kind = interface_kind(scene)
        faces = np.ascontiguousarray(mesh.faces, np.uint32)
        positions = np.ascontiguousarray((mesh.positions - self.center) / self.scale, np.float32)
        self._tree = TriangleScene(positions, faces)
        self.positions = positions.astype(np.float64)
        self.faces = faces.astype(np.int64)
        self.face_normals = np.ascontiguousarray(
            _face_normals(self.positions, self.faces, np.asarray(mesh.face_normals))
        )
        self.boundary = Boundary(
            intersect=intersect_address(),
            scene=self._tree.handle,
            positions=self.positions,
            faces=self.faces,
            face_normals=self.face_normals,
            vertex_normals=np.ascontiguousarray(mesh.normals, np.float64),
            interpolate_normals=scene.normals == "vertex",
            kind=self.kind,
            alpha=float(scene.roughness),
            eta=float(scene.eta),
            radius=1.001 * float(np.linalg.norm(self.positions, axis=1).max()),
            most_events=MOST_EVENTS,
        )
        self.aims: Aim = aim_for(self.boundary.alpha, self.boundary.eta)
        self.medium = self._medium(scene)

    def _medium(self, scene: Scene) -> Medium:
        extinction, albedo = np.asarray(scene.sigma_t, np.float64), np.asarray(scene.albedo, np.float64)
        extinction_varies, albedo_varies = extinction.ndim == 3, albedo.ndim >= 3
        low, high = np.full(3, -0.5), np.full(3, 0.5)
        if scene.bounds is not None:
            low, high = (np.asarray(scene.bounds, np.float64) - self.center) / self.scale
        if albedo_varies:
            albedo = np.broadcast_to(albedo[..., None] if albedo.ndim == 3 else albedo, (*albedo.shape[:3], 3))
        nothing = np.zeros((1, 1, 1))
        return Medium(
            sigma_t=float(extinction.max()) * self.scale,
            phase_g=float(scene.phase_g),
            albedo=np.ones(3) if albedo_varies else np.ascontiguousarray(np.broadcast_to(albedo, 3)),
            extinction_grid=np.ascontiguousarray(extinction * self.scale if extinction_varies else nothing, np.float32),
            albedo_grid=np.ascontiguousarray(albedo if albedo_varies else nothing[..., None], np.float32),
            has_extinction_grid=extinction_varies,
            has_albedo_grid=albedo_varies,
            low=low,
            per_length=1.0 / (high - low),
        )

    def place(self, positions: Array, outgoing: Array, keys: NDArray[np.uint64]) -> tuple[Any, ...]:
        """Queries as the kernels take them: (keys, positions, outgoing, faces, barycentric). Raises QueryError as
        `Surface.locate`.
        """
        return self.queries(self.surface.locate(positions, outgoing), outgoing, keys)

    def queries(self, location: Location, outgoing: Array, keys: NDArray[np.uint64]) -> tuple[Any, ...]:
        """The same from a location that is known already."""
        u, v = location.barycentric[:, :1], location.barycentric[:, 1:]
        corners = self.positions[self.faces[location.faces]]
        placed = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        return keys, placed, np.ascontiguousarray(outgoing), location.faces, location.barycentric


def interface_kind(scene: Scene) -> int:
    """MATCHED where eta is 1, whatever the roughness; SMOOTH where there is no roughness; else ROUGH."""
    if scene.eta == 1.0:
        return MATCHED
    return ROUGH if scene.roughness >= _SMOOTHEST else SMOOTH


def _face_normals(positions: Array, faces: NDArray[np.int64], fallback: Array) -> Array:
    """Unit normals of the faces as Embree holds them; the mesh's own where float32 has made a face flat."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), fallback))


@lru_cache(maxsize=4)
def prepare(scene: Scene) -> PreparedScene:
    """The prepared scene, kept for the scenes used last."""
    return PreparedScene(scene)
