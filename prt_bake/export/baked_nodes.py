"""Finds a baked mesh in a glTF file of the same surface: which nodes show it, and which baked vertex each vertex is.

Object space is the scene of the file at rest, as `read_mesh` reads it. The file may split vertices that the bake has
merged, at seams and hard edges, and may order them otherwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from formats.errors import MeshError, warn
from formats.mesh import Mesh
from formats.mesh.geometry import vertex_normals
from formats.mesh.gltf.container import COMPRESSIONS, GltfFile
from formats.mesh.gltf.nodes import read_forest, visible_nodes
from formats.mesh.gltf.reader import Placed, placed_primitives

Array = NDArray[np.float64]

_FARTHEST = 1e-4
"""The largest distance of vertices that are one, relative to the diagonal of the baked mesh."""
_NEIGHBOURS = 8
_REMEDY = "export onto the file that was baked"


@dataclass(frozen=True)
class BakedNode:
    """A node whose mesh was baked.

    Attributes:
        node: its number.
        shown: the numbers of its mesh's primitives that have triangles.
        vertices: for each accessor of positions the baked vertex of each of its elements [n]; any where no face uses
            the element.
        to_object: float64 [3,3], from directions of the node to those of the scene; a rotation if the scale is uniform.
    """

    node: int
    shown: list[int]
    vertices: dict[int, NDArray[np.int64]]
    to_object: Array


def baked_nodes(file: GltfFile, mesh: Mesh) -> list[BakedNode]:
    """Return the nodes whose meshes are on the baked one; raises MeshError if none is, or one in part."""
    forest = read_forest(file)
    shown: dict[int, list[Placed]] = {}
    for one in placed_primitives(file, forest, visible_nodes(file, forest)):
        shown.setdefault(one.node, []).append(one)
    baked = _BakedVertices(mesh)
    nodes, others, vertices, least, largest = [], [], 0, np.inf, 0.0
    for index, primitives in sorted(shown.items()):
        used = [np.unique(one.part.faces) for one in primitives]
        positions, normals = _points(primitives, used)
        found, distances = baked.nearest(positions, normals)
        away = distances > baked.farthest
        vertices, least = vertices + len(away), min(least, distances.min())
        largest = max(largest, float(np.linalg.norm(np.ptp(positions, axis=0))))
        if away.all():
            others.append(index)
            continue
        if away.any():
            raise MeshError(
                f"{file.path}: {away.sum():,} of {len(away):,} vertices of {file.node(index)} are not on the baked "
                f"mesh; the largest distance is {distances.max():.3g}, and the mesh's diagonal {mesh.diagonal:.3g}; "
                f"{_REMEDY}"
            )
        _refuse_what_moves(file, index, primitives)
        numbers = [one.number for one in primitives]
        linear = forest.matrices[index][:3, :3]
        to_object = linear * np.sqrt(3) / np.linalg.norm(linear)
        nodes.append(BakedNode(index, numbers, _by_accessor(file, primitives, used, found), to_object))
    if not nodes:
        raise MeshError(
            f"{file.path}: none of its {vertices:,} vertices is on the baked mesh; the smallest distance is "
            f"{least:.3g}, its largest object has a diagonal of {largest:.3g}, the mesh of {mesh.diagonal:.3g}; "
            f"{_REMEDY}"
        )
    if others:
        words = ", ".join(file.node(index) for index in others[:3]) + (", …" if len(others) > 3 else "")
        warn(f"{file.path}: {len(others)} objects are not part of the baked mesh and stay as they are: {words}")
    return nodes


class _BakedVertices:
    """The vertices of a baked mesh, to be found by position and side."""

    def __init__(self, mesh: Mesh) -> None:
        self.farthest = _FARTHEST * mesh.diagonal
        self._normals = mesh.normals
        self._tree = cKDTree(mesh.positions)

    def nearest(
        self, positions: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return for vertices [n,3] the nearest baked vertex [n] and its distance [n].

        Of several within `farthest`, as on the two sides of a thin sheet, it is the nearest one whose normal is within
        90 degrees of the vertex's.
        """
        count = min(_NEIGHBOURS, self._tree.n)
        distances, found = self._tree.query(positions, k=np.arange(1, count + 1))  # [n,count]
        facing = np.einsum("ni,nki->nk", normals, self._normals[found]) > 0
        eligible = facing & (distances <= self.farthest)
        chosen = np.where(eligible.any(axis=1), eligible.argmax(axis=1), 0)
        rows = np.arange(len(positions))
        return found[rows, chosen].astype(np.int64), distances[rows, chosen]


def _points(primitives: Sequence[Placed], used: Sequence[NDArray[np.int64]]) -> tuple[Array, Array]:
    """Return the positions and normals [n,3] of the vertices of primitives that faces use."""
    parts = [one.part for one in primitives]
    normals = [
        vertex_normals(part.positions, part.faces)[0] if part.normals is None else part.normals for part in parts
    ]
    return (
        np.concatenate([part.positions[rows] for part, rows in zip(parts, used, strict=True)]),
        np.concatenate([each[rows] for each, rows in zip(normals, used, strict=True)]),
    )


def _refuse_what_moves(file: GltfFile, index: int, primitives: Sequence[Placed]) -> None:
    """Raise MeshError if a node's mesh is not one rigid object, or is compressed beside its plain form."""
    node, where = file.records.nodes[index], file.node(index)
    remedy = "apply it, and bake and export onto that file"
    for name, present in (
        ("a skin", node.skin is not None),
        ("morph targets", any(one.primitive.targets for one in primitives)),
        ("instances", node.extensions.EXT_mesh_gpu_instancing is not None),
    ):
        if present:
            raise file.fault(where, f"has {name}, but the transport is of one rigid object", remedy)
    for one in primitives:
        compression = next((name for name in COMPRESSIONS if name in one.primitive.extensions), None)
        if compression:
            raise file.compressed(where, compression)


def _by_accessor(
    file: GltfFile, primitives: Sequence[Placed], used: Sequence[NDArray[np.int64]], found: NDArray[np.int64]
) -> dict[int, NDArray[np.int64]]:
    """Return the baked vertices `found` of the vertices that are `used`, by the accessor of their positions."""
    vertices: dict[int, NDArray[np.int64]] = {}
    apart = np.split(found, np.cumsum([len(rows) for rows in used])[:-1])
    for one, rows, each in zip(primitives, used, apart, strict=True):
        accessor = one.primitive.attributes["POSITION"]
        whole = vertices.setdefault(accessor, np.full(file.records.accessors[accessor].count, each[0]))
        whole[rows if one.part.rows is None else one.part.rows[rows]] = each
    return vertices
