"""The record of a triangle mesh, and questions about its topology."""

import dataclasses
import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from formats.arguments import described, numbers
from formats.errors import MeshError, QueryError, warn
from formats.mesh import creases, geometry
from formats.mesh.edges import edges_of, inside_out, two_sided_faces
from formats.mesh.normals import refuse_wrong_side
from formats.summary import summary

if TYPE_CHECKING:
    import pyvista
    import trimesh

SPLIT_ANGLE = 30.0
"""In degrees. Normals of a file that differ by more at one vertex make a hard edge."""
_FEW_CANCELLED = 0.01
"""Share of vertices without a normal up to which doubled faces are a few flaps, not a second side."""
_MOST_CANCELLED = 0.5
"""Share from which a mesh has two sides even if no face is doubled. Where solids touch, normals may cancel, too."""
_MOST_CREASED = 0.3
"""Share of the area of faces with a corner at a sharp edge, up to which vertex normals are good."""
_MOST_SPLIT = 0.01
"""Share of the vertices at hard edges of the file up to which vertex normals are good."""
_UNIT = 1e-3
"""Largest deviation from 1 of the length of a normal of another library."""
_ONE_SIDE = "export it with one side, or remove the doubled faces in a mesh editor"


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in object space, right-handed; faces are counter-clockwise seen from outside.

    Attributes:
        positions: float64 [V,3], in scene units.
        faces: int32 [F,3], indices into positions.
        normals: float64 [V,3], unit.
        uv: float64 [V,2], or None; at a seam the pair of the first face.
        corner_uv: float64 [F,3,2], the texture coordinates of the corners of each face, v upwards, or None. Derived
            from `uv` if only that is given.
        source_vertex: int64 [n], the vertex that each vertex of the file became (-1: used by no face), or None if the
            file's vertices are unchanged.
        dropped_faces: number of faces without area that `read_mesh` dropped.
        cancelled_normals: number of vertices at which the normals of the faces cancel out and the file has no others;
            such a vertex has the normal of any of its faces.
        split_normals: number of vertices at which the file's normals differ by more than `SPLIT_ANGLE`, as at hard
            edges; such a vertex has their mean.
        flat_shaded: whether the normals of the file are constant on each face, although the surface bends.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> mesh = prt.Mesh(
    ...     positions=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]),
    ...     faces=np.array([[0, 1, 2]]),
    ...     normals=np.array([[0.0, 0.0, 1.0]] * 3),
    ... )
    >>> mesh.face_areas.tolist(), mesh.bounds.tolist()
    ([1.0], [[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    """

    positions: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64]
    uv: NDArray[np.float64] | None = None
    corner_uv: NDArray[np.float64] | None = None
    source_vertex: NDArray[np.int64] | None = None
    dropped_faces: int = 0
    cancelled_normals: int = 0
    split_normals: int = 0
    flat_shaded: bool = False

    def __post_init__(self) -> None:
        given = (numbers(f"mesh: {name}", getattr(self, name)) for name in ("positions", "faces"))
        count, triangles = (len(array) if array.ndim else 0 for array in given)
        expected = {
            **{"positions": (count, 3), "faces": (triangles, 3), "normals": (count, 3)},
            **{"uv": (count, 2), "corner_uv": (triangles, 3, 2)},
        }
        for name, shape in expected.items():
            if getattr(self, name) is None and name in ("uv", "corner_uv"):
                continue
            array = numbers(f"mesh: {name}", getattr(self, name))
            if array.shape != shape:
                raise MeshError(f"mesh: {name}: expected shape {list(shape)}, found {list(array.shape)}")
            kind = np.int32 if name == "faces" else np.float64
            if name == "faces":
                _refuse_indices(array, count)
            object.__setattr__(self, name, np.ascontiguousarray(array, kind))
        if self.corner_uv is None and self.uv is not None:
            object.__setattr__(self, "corner_uv", self.uv[self.faces])

    @classmethod
    def from_trimesh(cls, mesh: "trimesh.Trimesh") -> "Mesh":
        """The vertices and faces of a trimesh mesh, and its normals; those of the faces where it has none of length 1.

        >>> import prt_bake as prt, trimesh
        >>> prt.Mesh.from_trimesh(trimesh.creation.icosphere(subdivisions=0)).faces.shape
        (20, 3)
        """
        if not all(hasattr(mesh, each) for each in ("vertices", "faces", "vertex_normals")):
            raise QueryError(f"mesh: expected a mesh of trimesh, found {described(mesh)}")
        if not len(mesh.faces):
            raise MeshError("mesh: expected faces, found none in the trimesh mesh")
        built = build_mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces))
        given = np.asarray(mesh.vertex_normals, np.float64)
        usable = np.abs(np.linalg.norm(given, axis=1) - 1.0) < _UNIT
        uv = getattr(mesh.visual, "uv", None)
        return dataclasses.replace(
            built,
            normals=np.where(usable[:, None], given, built.normals),
            uv=None if uv is None or len(uv) != len(built.positions) else np.asarray(uv, np.float64),
        )

    def to_trimesh(self) -> "trimesh.Trimesh":
        """A trimesh mesh with the same vertices, faces, normals and texture coordinates.

        >>> import prt_bake as prt
        >>> prt.read_mesh("spot.obj").to_trimesh().is_watertight
        True
        """
        import trimesh
        from trimesh.visual import TextureVisuals

        visual = None if self.uv is None else TextureVisuals(uv=self.uv)  # type: ignore[no-untyped-call]
        return trimesh.Trimesh(
            self.positions, self.faces, vertex_normals=self.normals, visual=visual, process=False, validate=False
        )

    @property
    def bounds(self) -> NDArray[np.float64]:
        """The lowest and highest corner of the bounding box [2,3]."""
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    @property
    def center(self) -> NDArray[np.float64]:
        """The middle of the bounding box [3]."""
        low, high = self.bounds
        middle: NDArray[np.float64] = low + 0.5 * (high - low)
        return middle

    @property
    def diagonal(self) -> float:
        """The length of the bounding box's diagonal."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))

    @cached_property
    def face_normals(self) -> NDArray[np.float64]:
        """The unit normal of each face [F,3]."""
        return geometry.face_normals(self.positions - self.center, self.faces)

    @cached_property
    def face_areas(self) -> NDArray[np.float64]:
        """The area of each face [F], in squared scene units."""
        return geometry.face_areas(self.positions - self.center, self.faces)

    @cached_property
    def corner_normals(self) -> NDArray[np.float64]:
        """The unit normals at the corners of each face [F,3,3], as `creases.corner_normals`: apart at sharp edges."""
        return creases.corner_normals(self.positions - self.center, self.faces, self.normals)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of positions (little-endian float64) and faces (little-endian uint32), 64 hexadecimal digits."""
        digest = hashlib.sha256(self.positions.astype("<f8").tobytes())
        digest.update(self.faces.astype("<u4").tobytes())
        return digest.hexdigest()

    @property
    def seamless(self) -> bool:
        """Whether each vertex has one pair of texture coordinates, so that `uv` determines `corner_uv`."""
        if self.uv is None or self.corner_uv is None:
            return self.corner_uv is None
        return np.array_equal(self.uv[self.faces], self.corner_uv)

    def to_pyvista(self) -> "pyvista.PolyData":
        """Return the mesh as `pyvista.PolyData`, with the vertex normals in the array "Normals".

        Raises PrtbakeError if PyVista is not installed.

        >>> import prt_bake as prt
        >>> prt.read_mesh("spot.obj").to_pyvista().plot(off_screen=True)
        """
        from formats.mesh.polydata import polydata

        return polydata(self.positions, self.faces, self.normals)

    __repr__ = summary


def _refuse_indices(faces: NDArray[np.integer], count: int) -> None:
    if faces.size and faces.dtype.kind not in "iu":
        raise MeshError(f"mesh: faces: expected whole numbers, indices of vertices, found {faces.dtype}")
    if faces.size and not 0 <= int(faces.min()) <= int(faces.max()) < count:
        raise MeshError(
            f"mesh: faces: expected indices from 0 to {count - 1}, found {faces.min()} to {faces.max()}; the first "
            f"vertex is number 0"
        )


def build_mesh(positions: NDArray[np.float64], faces: NDArray[np.integer]) -> Mesh:
    """Return a mesh of these vertices [V,3] and triangles [F,3], unchanged, with angle-weighted vertex normals."""
    positions = np.ascontiguousarray(positions, np.float64)
    normals, cancelled = _normals_of_faces(positions, faces)
    return Mesh(positions, np.ascontiguousarray(faces, np.int32), normals, cancelled_normals=int(cancelled.sum()))


def good_normals(mesh: Mesh) -> bool:
    """Return whether light may be refracted by the vertex normals everywhere: scenes with `normals = "vertex"`.

    False for flat shading, hard edges in the file, and sharp edges (above 60 degrees) around a third of the surface.

    >>> import trimesh
    >>> ball, box = trimesh.creation.icosphere(), trimesh.creation.box()
    >>> good_normals(build_mesh(ball.vertices, ball.faces)), good_normals(build_mesh(box.vertices, box.faces))
    (True, False)
    """
    if mesh.flat_shaded or mesh.split_normals > _MOST_SPLIT * len(mesh.positions):
        return False
    apart = np.linalg.norm(mesh.corner_normals - mesh.normals[mesh.faces], axis=2).max(axis=1) > 1e-3
    return float(mesh.face_areas[apart].sum()) <= _MOST_CREASED * float(mesh.face_areas.sum())


def _normals_of_faces(
    positions: NDArray[np.float64], faces: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    centred = positions - 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    return geometry.vertex_normals(centred, faces)


def open_edges(mesh: Mesh) -> int:
    """Return the number of edges with an odd number of faces; 0 on a closed surface."""
    return int(edges_of(mesh.faces).open.sum())


def inconsistent_edges(mesh: Mesh) -> int:
    """Return the number of edges between faces of opposite winding, where the inside meets the outside."""
    return int(edges_of(mesh.faces).inconsistent.sum())


def signed_volume(mesh: Mesh) -> float:
    """Return the enclosed volume, in cubed scene units; negative if the faces are wound inside out."""
    return geometry.signed_volume(mesh.positions - mesh.center, mesh.faces)


def refuse_inside_out(mesh: Mesh) -> None:
    """Raise MeshError if a closed mesh is wound inside out, or if its normals contradict its faces.

    Warns of edges between faces of opposite winding: some of the normals there point inwards.
    """
    used = np.unique(mesh.faces)  # a vertex of no face may face anywhere
    if not len(used):
        return
    if inconsistent := inconsistent_edges(mesh):
        warn(
            f"mesh: {inconsistent} edges lie between faces of opposite winding; normals of some faces point inwards: "
            f"make them consistent in a mesh editor (recalculate outside)"
        )
    elif inside_out(mesh.positions, mesh.faces):
        raise MeshError("mesh: the faces are wound inside out; flip the mesh's normals in an editor, and save it again")
    of_faces, cancelled = _normals_of_faces(mesh.positions, mesh.faces)
    refuse_wrong_side(mesh.normals[used], of_faces[used], cancelled[used])


def refuse_two_sides(mesh: Mesh) -> None:
    """Raise MeshError if vertices have no normal because the faces around them are doubled with opposite winding.

    A few of them are a warning.
    """
    if mesh.cancelled_normals == 0:
        return
    cancelled = _normals_of_faces(mesh.positions, mesh.faces)[1]
    doubled = two_sided_faces(mesh.faces)
    doubled = doubled[cancelled[mesh.faces[doubled]].any(axis=1)]
    count = len(np.unique(mesh.faces))
    found = f"the normals of {mesh.cancelled_normals} of {count} vertices cancel out"
    if len(doubled):
        found = (
            f"{len(doubled)} of {len(mesh.faces)} faces lie on another one of the opposite winding, the first at "
            f"({_point(mesh.positions[mesh.faces[doubled[0], 0]])}), and {found}"
        )
    if mesh.cancelled_normals > (_FEW_CANCELLED if len(doubled) else _MOST_CANCELLED) * count:
        raise MeshError(f"mesh: {found}: the mesh has two sides; {_ONE_SIDE}")
    if len(doubled):
        warn(f"mesh: {found}; the result is that of either side there; {_ONE_SIDE}")


def inward_sentence(mesh: Mesh, vertices: NDArray[np.integer], of_what: str) -> str:
    """Return the warning that the normals of some `vertices` point into the object `of_what`."""
    return (
        f"mesh: the normals of {len(vertices)} of {len(mesh.positions)} vertices point into the object {of_what}, the "
        f"first at ({_point(mesh.positions[vertices[0]])}): some faces are wound inside out, and the result is wrong "
        f"there; make the normals consistent in a mesh editor (recalculate outside)"
    )


def flipped(mesh: Mesh) -> Mesh:
    """Return the mesh with the winding of every face and every normal reversed."""
    corner_uv = None if mesh.corner_uv is None else mesh.corner_uv[:, ::-1]
    return dataclasses.replace(mesh, faces=mesh.faces[:, ::-1], normals=-mesh.normals, corner_uv=corner_uv)


def _point(position: NDArray[np.float64]) -> str:
    return ", ".join(f"{x:.6g}" for x in position)
