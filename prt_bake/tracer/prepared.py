"""A scene in the kernels' form: centred, scaled to its longest side, with an Embree tree."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.scene import Part, Scene
from prt_bake.geometry.embree import TriangleScene, intersect_address
from prt_bake.geometry.nesting import reaches_surface, refuse_outside
from prt_bake.geometry.shells import refuse_ambiguous
from prt_bake.geometry.surface import Location, Surface
from prt_bake.tracer.next_event import NextEventSampling, next_event_sampling
from prt_bake.tracer.surface.boundary import (
    ALPHA,
    COMPENSATED,
    CORNER_NORMALS,
    CORNER_UV,
    CORNERS,
    FACE_SIZE,
    FIRST_FACE,
    FIRST_TEXEL,
    HEIGHT,
    INDEX,
    INTERPOLATED,
    IS_DIFFUSE,
    OPEN,
    PART,
    PART_SIZE,
    REFLECTANCE,
    SAME_INDEX,
    SMOOTHEST,
    TREE,
    WIDTH,
    Boundary,
)
from prt_bake.tracer.surface.clearance import clearance_grid, near_faces, open_faces
from prt_bake.tracer.surface.interface import MATCHED, ROUGH, SMOOTH
from prt_bake.tracer.surface.losses import loss_tables, no_losses
from prt_bake.tracer.volume.media import MAJORANT
from prt_bake.tracer.volume.prepared_media import prepare_media

MOST_EVENTS = 10_000_000
"""Events after which a walk is truncated; its remaining throughput is reported as lost."""

Array = NDArray[np.float64]


class KernelQueries(NamedTuple):
    """N queries in the kernels' coordinates: keys uint64 [N] of their random numbers, positions [N,3], outgoing [N,3],
    faces int64 [N], barycentric (u, v) [N,2].
    """

    keys: NDArray[np.uint64]
    positions: Array
    outgoing: Array
    faces: NDArray[np.int64]
    barycentric: Array

    def rows(self, chosen: slice) -> "KernelQueries":
        """A slice of the queries."""
        return KernelQueries._make(field[chosen] for field in self)


class PreparedScene:
    """`boundary` and `medium` for kernels, `surface` to locate queries, and the transform to the kernels'
    coordinates.
    """

    def __init__(self, scene: Scene) -> None:
        """Build the tables and the Embree tree of a scene."""
        low, high = scene.mesh.bounds
        self.center: Array = low + 0.5 * (high - low)
        self.scale = float((high - low).max())
        self.surface = Surface(scene.mesh)
        self.kind = interface_kind(scene)
        self.medium = prepare_media(scene.parts, self.center, self.scale)
        self.boundary = self._boundary(scene)
        self.next_event: NextEventSampling = next_event_sampling(self.boundary.alpha, self.boundary.eta)

    def _boundary(self, scene: Scene) -> Boundary:
        parts = scene.parts
        first = np.cumsum([0] + [len(part.mesh.positions) for part in parts])
        positions32 = np.concatenate(
            [((part.mesh.positions - self.center) / self.scale).astype(np.float32) for part in parts]
        )
        faces = np.concatenate([part.mesh.faces.astype(np.int64) + first[i] for i, part in enumerate(parts)])
        self._tree = TriangleScene(np.ascontiguousarray(positions32), np.ascontiguousarray(faces, np.uint32))
        self._trees = [self._tree]
        if len(parts) > 1:
            ends = zip(first[:-1], first[1:], parts, strict=True)
            self._trees = [TriangleScene(positions32[a:b], part.mesh.faces.astype(np.uint32)) for a, b, part in ends]
        self.positions = positions32.astype(np.float64)
        self.faces = np.ascontiguousarray(faces)
        own = self.positions[: first[1]]
        thickness = float(self.medium.regions[:, MAJORANT].max())
        return Boundary(
            intersect=intersect_address(),
            scene=self._tree.handle,
            **_tables(parts, [tree.handle for tree in self._trees], self.positions, self.faces),
            losses=_losses(parts),
            region_of_mask=_regions(parts),
            clearance=clearance_grid(self.positions, self.faces, thickness),
            near=near_faces(self.positions, self.faces, thickness),
            nested=len(parts) > 1,
            kind=self.kind,
            alpha=_mean_alpha(parts[0]),
            eta=float(scene.eta),
            radius=1.001 * float(np.linalg.norm(own, axis=1).max()),
            most_events=MOST_EVENTS,
        )

    def place(self, positions: Array, outgoing: Array, keys: NDArray[np.uint64]) -> KernelQueries:
        """Queries at positions in object space. Raises QueryError as `Surface.locate`."""
        return self.queries(self.surface.locate(positions, outgoing), outgoing, keys)

    def queries(self, location: Location, outgoing: Array, keys: NDArray[np.uint64]) -> KernelQueries:
        """Queries at known locations."""
        u, v = location.barycentric[:, :1], location.barycentric[:, 1:]
        corners = self.positions[self.faces[location.faces]]
        placed = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        return KernelQueries(keys, placed, np.ascontiguousarray(outgoing), location.faces, location.barycentric)


def interface_kind(scene: Scene) -> int:
    """Kind of the outer boundary: MATCHED if eta is 1, at any roughness; SMOOTH without roughness; else ROUGH."""
    return _kind(scene.parts[0], 1.0)


def _kind(part: Part, outside: float) -> int:
    if abs(part.eta / outside - 1.0) < SAME_INDEX:
        return MATCHED
    return ROUGH if _mean_alpha(part) >= SMOOTHEST else SMOOTH


@lru_cache(maxsize=8)
def smooth_part(scene: Scene) -> Part | None:
    """The part whose smooth interface makes connections to the light impossible, or None.

    Through a rough outer boundary all events can connect, unless an inner part of index 1 reaches it: light passes
    straight there. Through an index-matched one they can if no smooth interface is inside.
    """
    outermost = scene.parts[0]
    if interface_kind(scene) == ROUGH:
        return next(filter(lambda part: _opens(part, outermost), scene.parts[1:]), None)
    if interface_kind(scene) == SMOOTH:
        return outermost
    for part in scene.parts[1:]:
        if part.diffuse is None and _kind(part, scene.parts[part.parent].eta) == SMOOTH:
            return part
    return None


def no_values_reason(scene: Scene) -> str:
    """Why Ŝ has no values in given directions, as a clause for messages; empty if it has."""
    part = smooth_part(scene)
    if part is None:
        return ""
    if interface_kind(scene) == ROUGH:
        return f"'{part.name}' has index 1 and reaches the surface, so light passes straight through it"
    return f"the interface of '{part.name}' is smooth"


def _opens(part: Part, outermost: Part) -> bool:
    """Whether an inner part of index 1 reaches the object's surface, where nothing refracts light then."""
    return part.diffuse is None and _kind(part, 1.0) == MATCHED and reaches_surface(part.mesh, outermost.mesh)


def is_unrefracted(scene: Scene) -> bool:
    """Whether connections are straight: the outer boundary is index-matched and no smooth interface is inside.

    Unscattered light then comes along the view itself.
    """
    return interface_kind(scene) == MATCHED and smooth_part(scene) is None


def has_unscattered(scene: Scene) -> bool:
    """Whether light may cross the object without a scattering event, that is without a rough interface on its path."""
    return is_unrefracted(scene) or smooth_part(scene) is not None


def has_dielectric_inside(scene: Scene) -> bool:
    """Whether an inner part refracts light: a dielectric with another index than its parent."""
    return any(
        part.diffuse is None and _kind(part, scene.parts[part.parent].eta) != MATCHED for part in scene.parts[1:]
    )


def rough_parts(scene: Scene) -> list[Part]:
    """The parts with a rough interface, through which connections are lobes."""
    outside = [1.0, *(scene.parts[part.parent].eta for part in scene.parts[1:])]
    return [
        part
        for part, eta in zip(scene.parts, outside, strict=True)
        if part.diffuse is None and _kind(part, eta) == ROUGH
    ]


def _mean_alpha(part: Part) -> float:
    return float(np.mean(part.roughness))


def _mean_reflectance(part: Part) -> Array:
    if part.diffuse is None:
        return np.zeros(3)
    return np.asarray(part.diffuse.reshape(-1, 3).mean(axis=0), np.float64)


def _first_faces(parts: tuple[Part, ...]) -> NDArray[np.int64]:
    return np.cumsum([0] + [len(part.mesh.faces) for part in parts[:-1]]).astype(np.int64)


def _tables(parts: tuple[Part, ...], trees: list[int], positions: Array, faces: NDArray[np.int64]) -> dict[str, Any]:
    """`faces`, `planes`, `parts` and `texels` of the boundary."""
    rows, table, texels = np.zeros((len(faces), FACE_SIZE)), np.zeros((len(parts), PART_SIZE)), list[Any]()
    given = np.concatenate([part.mesh.face_normals for part in parts])
    rows[:, :CORNERS] = _face_normals(positions, faces, given)
    rows[:, CORNERS:CORNER_NORMALS] = positions[faces].reshape(-1, 9)
    for i, (part, first) in enumerate(zip(parts, _first_faces(parts), strict=True)):
        own = rows[first : first + len(part.mesh.faces)]
        own[:, CORNER_NORMALS:CORNER_UV] = part.mesh.normals[part.mesh.faces].reshape(-1, 9)
        own[:, PART] = i
        if i == 0:
            own[:, OPEN] = open_faces(own, positions[: len(part.mesh.positions)])
        row = table[i]
        row[ALPHA], row[REFLECTANCE : REFLECTANCE + 3] = _mean_alpha(part), _mean_reflectance(part)
        row[IS_DIFFUSE], row[INTERPOLATED] = part.diffuse is not None, part.normals == "vertex"
        row[COMPENSATED], row[INDEX] = part.energy_compensation, part.eta
        row[TREE], row[FIRST_FACE] = trees[i], first
        image = _texture(part)
        if image is not None:
            row[FIRST_TEXEL], row[HEIGHT], row[WIDTH] = sum(map(len, texels)), *image.shape[:2]
            texels.append(image.ravel())
            if part.mesh.corner_uv is not None:
                own[:, CORNER_UV:PART] = part.mesh.corner_uv.reshape(-1, 6)
    return {
        "faces": rows,
        "planes": np.column_stack([rows[:, :3], np.einsum("fi,fi->f", rows[:, :3], rows[:, CORNERS : CORNERS + 3])]),
        "parts": table,
        "texels": np.concatenate(texels) if texels else np.zeros(0, np.float32),
    }


def _texture(part: Part) -> NDArray[np.float32] | None:
    """The part's texture [H,W,3] of reflectance or roughness, or None."""
    image = np.asarray(part.roughness if part.diffuse is None else part.diffuse, np.float32)
    if image.ndim < 2:
        return None
    return np.ascontiguousarray(np.broadcast_to(image if image.ndim == 3 else image[..., None], (*image.shape[:2], 3)))


def _losses(parts: tuple[Part, ...]) -> Array:
    """Loss tables for every pair of refractive indices that may meet at a compensated interface, from both sides."""
    rough = [part for part in parts if part.energy_compensation and part.diffuse is None]
    rough = [part for part in rough if _mean_alpha(part) >= SMOOTHEST]
    indices = sorted({1.0} | {float(part.eta) for part in parts})
    pairs = [(a, b) for a in indices for b in indices if a < b and b / a - 1.0 >= SAME_INDEX]
    if not rough or not pairs:
        return no_losses()
    least = min(float(np.min(part.roughness)) for part in rough)
    largest = max(float(np.max(part.roughness)) for part in rough)
    return loss_tables([eta for a, b in pairs for eta in (b / a, a / b)], (least, largest))


def _regions(parts: tuple[Part, ...]) -> NDArray[np.int64]:
    """The region of every mask: 0 outside, else part + 1 of the innermost part, the later one of siblings.

    A part counts only if the mask contains all its ancestors.
    """
    chain = []
    for i, part in enumerate(parts):
        bits, above = 1 << i, part.parent
        while above >= 0:
            bits |= 1 << above
            above = parts[above].parent
        chain.append(bits)
    regions = np.zeros(1 << len(parts), np.int64)
    for mask in range(len(regions)):
        counting = [(chain[i].bit_count(), i) for i in range(len(parts)) if mask & chain[i] == chain[i]]
        regions[mask] = max(counting)[1] + 1 if counting else 0
    return regions


def _face_normals(positions: Array, faces: NDArray[np.int64], fallback: Array) -> Array:
    """Unit normals of the faces after rounding to float32; `fallback` for faces that this makes degenerate."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), fallback))


@lru_cache(maxsize=4)
def prepare(scene: Scene) -> PreparedScene:
    """The prepared scene; the four last used ones are cached.

    Raises MeshError for overlapping shells and coincident faces, SceneError for parts outside of their parents.
    """
    size = float(np.ptp(scene.mesh.bounds, axis=0).max())
    for part in scene.parts:
        refuse_ambiguous(part.mesh, part.mesh_path, size)
    refuse_outside(scene.parts)
    return PreparedScene(scene)
