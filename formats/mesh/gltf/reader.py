"""Reads the triangles of a glTF file: every visible mesh of the default scene, in the default pose."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from formats.errors import MeshError
from formats.mesh.gltf.accessors import Accessors
from formats.mesh.gltf.container import GltfFile, open_gltf
from formats.mesh.gltf.nodes import Forest, instance_matrices, read_forest, visible_nodes
from formats.mesh.gltf.nothing import why_nothing_is_shown
from formats.mesh.gltf.part import Part, join, place
from formats.mesh.gltf.primitives import read_primitive
from formats.mesh.gltf.schema import Node, Primitive
from formats.mesh.gltf.skins import joint_matrices, vertex_matrices
from formats.triangle_soup import TriangleSoup

# Copies take few bytes in the file. A file with more vertices and triangles than these and its bytes is damaged.
_MOST_ELEMENTS = 10_000_000


def read_scene(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read the triangles of a glTF file.

    Morph targets have their default weights and skins the pose of the nodes; animations are not played. Nodes outside
    of the default scene and hidden nodes are left out. Positions are transformed in float64. Of vertices that several
    primitives share, each has those that it uses.

    Returns:
        The triangles. Normals and texture coordinates are None unless every part has them.

    Raises:
        MeshError: the file is damaged, has no triangles, or requires what is not supported; the message names the place
            in the JSON.
    """
    file = open_gltf(path)
    forest = read_forest(file)
    visible = visible_nodes(file, forest)
    parts = [one.part for one in placed_primitives(file, forest, visible)]
    file.warn_of_remarks()
    if not parts:
        raise MeshError(f"{path}: {why_nothing_is_shown(file, forest, visible)}")
    return join(parts, os.fspath(path))


@dataclass(frozen=True)
class Placed:
    """A primitive where a node shows it.

    Attributes:
        node: number of the node.
        number: number of the primitive in the node's mesh.
        primitive: its record.
        part: its triangles, in the coordinates of the scene.
    """

    node: int
    number: int
    primitive: Primitive
    part: Part


def placed_primitives(file: GltfFile, forest: Forest, nodes: list[int]) -> list[Placed]:
    """Return the primitives of nodes that have triangles, as `read_scene` reads them; raises as it does."""
    with np.errstate(all="ignore"):  # `read_mesh` reports positions that are not finite
        return _Reader(file, forest).primitives(nodes)


class _Reader:
    """Places the meshes of all visible nodes. A mesh that several nodes use is decoded once."""

    def __init__(self, file: GltfFile, forest: Forest) -> None:
        self._file = file
        self._accessors = Accessors(file)
        self._forest = forest
        self._meshes: dict[tuple[int, tuple[float, ...]], list[tuple[int, Primitive, Part]]] = {}
        primitives = [primitive for mesh in file.records.meshes for primitive in mesh.primitives]
        self._uses = Counter(primitive.attributes.get("POSITION") for primitive in primitives)
        self._read, self._made = 0, 0  # numbers of vertices and faces

    def primitives(self, nodes: list[int]) -> list[Placed]:
        """Return the primitives of nodes in the coordinates of the scene, without those that have no triangle."""
        placed = []
        for index in nodes:
            node = self._file.records.nodes[index]
            if node.mesh is not None:
                placed += self._placed(index, node, node.mesh)
        return [one for one in placed if len(one.part.faces)]

    def _placed(self, index: int, node: Node, mesh: int) -> list[Placed]:
        """Return the parts of a node's mesh, moved by the node and its instances, or by its skin."""
        where = f"nodes[{index}]"
        primitives = self._primitives(mesh, node.weights, f"{where}.mesh")
        instances = instance_matrices(self._accessors, self._file, index)
        self._made += len(instances) * sum(_size(part) for _, _, part in primitives)
        copies = f"{len(instances)} copies" if len(instances) > 1 else "a copy"
        remedy = "export fewer copies, or each as a mesh of its own"
        self._refuse_too_many(self._made, where, f"{copies} of mesh {mesh}", remedy)
        if node.skin is None:
            matrices = self._forest.matrices[index] @ instances
            words = self._file.node(index)
            return [
                Placed(index, number, one, place(part, matrices[:, None], words)) for number, one, part in primitives
            ]
        if node.extensions.EXT_mesh_gpu_instancing is not None:
            remedy = "apply the skin and export it again"
            raise self._file.fault(where, "has a skin and EXT_mesh_gpu_instancing, which are not read together", remedy)
        joints = joint_matrices(self._file, self._accessors, self._forest, node.skin, f"{where}.skin")
        placed = []
        for number, primitive, part in primitives:
            matrices = vertex_matrices(self._file, self._accessors, primitive, part.place, joints, part.rows)
            placed.append(Placed(index, number, primitive, place(part, matrices[None], self._file.node(index))))
        return placed

    def _primitives(
        self, index: int, node_weights: Sequence[float] | None, where: str
    ) -> list[tuple[int, Primitive, Part]]:
        """Return the primitives of a mesh that have triangles: their numbers, records and triangles."""
        mesh = self._file.entry("mesh", self._file.records.meshes, index, where)
        weights = mesh.weights or [] if node_weights is None else node_weights
        key = (index, tuple(weights))
        if key not in self._meshes:
            self._meshes[key] = []
            for number, primitive in enumerate(mesh.primitives):
                place_of = f"meshes[{index}].primitives[{number}]"
                shared = self._uses[primitive.attributes.get("POSITION")] > 1
                part = read_primitive(self._file, self._accessors, primitive, place_of, weights, shared)
                if part is not None:
                    self._read += _size(part)
                    remedy = "export primitives with indices of their own"
                    self._refuse_too_many(self._read, place_of, "primitives that share their accessors", remedy)
                    self._meshes[key].append((number, primitive, part))
        return self._meshes[key]

    def _refuse_too_many(self, elements: int, where: str, cause: str, remedy: str) -> None:
        """Raise MeshError if copies become so many vertices and faces that the file must be damaged."""
        most = _MOST_ELEMENTS + self._accessors.bytes_read
        if elements > most:
            found = f"with {cause} the scene has {elements} vertices and faces"
            raise self._file.fault(where, f"{found}, expected at most {most} in so small a file", remedy)


def _size(part: Part) -> int:
    return len(part.positions) + len(part.faces)
