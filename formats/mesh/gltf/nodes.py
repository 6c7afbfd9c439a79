"""The tree of nodes: which meshes the default scene shows, and where (glTF 2.0, sections 3.5 and 3.11).

Instances of EXT_mesh_gpu_instancing are read, and KHR_node_visibility is obeyed. Animations are not played.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.errors import warn
from formats.mesh.gltf.accessors import Accessors
from formats.mesh.gltf.container import GltfFile

Array = NDArray[np.float64]

# Quaternions of bytes, as EXT_mesh_gpu_instancing allows, are of length 1 to 0.01.
_UNIT = 0.02
_SHAPES = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}


@dataclass(frozen=True)
class Forest:
    """The nodes of a file as trees.

    Attributes:
        parents: the parent of each node, -1 at a root.
        matrices: float64 [N,4,4], from the coordinates of each node to those of the scene.
    """

    parents: list[int]
    matrices: Array


def read_forest(file: GltfFile) -> Forest:
    """Return the parents and transforms of all nodes.

    Raises:
        MeshError: a child does not exist or has two parents, nodes form a cycle, or a transform is invalid.
    """
    nodes = file.records.nodes
    parents = [-1] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.children:
            where = f"nodes[{index}].children"
            file.entry("node", nodes, child, where)
            if parents[child] >= 0:
                raise file.fault(where, f"node {child} is already a child of node {parents[child]}")
            parents[child] = index
    matrices = _local_matrices(file)
    pending = [index for index, parent in enumerate(parents) if parent < 0]
    reached = 0
    while pending:
        index = pending.pop()
        reached += 1
        if parents[index] >= 0:
            matrices[index] = matrices[parents[index]] @ matrices[index]
        pending += nodes[index].children
    if reached < len(nodes):
        raise file.fault("nodes", f"{len(nodes) - reached} nodes are their own ancestors or descend from such nodes")
    return Forest(parents, matrices)


def visible_nodes(file: GltfFile, forest: Forest) -> list[int]:
    """Return the visible nodes of the default scene, each before its children, the last of siblings first."""
    visible = []
    pending = _roots(file, forest)  # from the end: hashes of meshes that were read earlier depend on the order
    while pending:
        index = pending.pop()
        node = file.records.nodes[index]
        if node.extensions.KHR_node_visibility.visible:
            visible.append(index)
            pending += node.children
    return visible


def instance_matrices(accessors: Accessors, file: GltfFile, index: int) -> Array:
    """Return the transforms [I,4,4] of EXT_mesh_gpu_instancing, or the identity [1,4,4]; raises MeshError."""
    instancing = file.records.nodes[index].extensions.EXT_mesh_gpu_instancing
    if instancing is None:
        return np.eye(4)[None]
    where = f"nodes[{index}].extensions.EXT_mesh_gpu_instancing.attributes"
    attributes = instancing.attributes
    used = [name for name in _SHAPES if name in attributes]
    if not used:
        raise file.fault(where, f"expected {', '.join(_SHAPES)}, found none of them")
    count = accessors.record(attributes[used[0]], f"{where}.{used[0]}").count
    read = {name: accessors.floats(attributes[name], _SHAPES[name], f"{where}.{name}", count) for name in used}
    return _compose(
        file,
        read.get("TRANSLATION", np.zeros((count, 3))),
        read.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
        read.get("SCALE", np.ones((count, 3))),
        f"{where}.ROTATION: instance {{}}",
    )


def refuse_projection(file: GltfFile, matrices: Array, where: str) -> None:
    """Raise MeshError unless the last row of each matrix [...,4,4] is 0, 0, 0, 1, to the precision of float32."""
    if not (np.abs(matrices[..., 3, :] - (0.0, 0.0, 0.0, 1.0)) < 1e-5).all():
        raise file.fault(where, "expected 0, 0, 0, 1 in the last row of the matrix")


def _roots(file: GltfFile, forest: Forest) -> list[int]:
    """Return the roots of the default scene; of the first scene if none is the default, or all without scenes."""
    scenes, chosen = file.records.scenes, file.records.scene
    if not scenes and chosen is None:
        warn(f"{file.path}: has no scene; all nodes are read")
        return [index for index, parent in enumerate(forest.parents) if parent < 0]
    if chosen is None and len(scenes) > 1:
        warn(f"{file.path}: names none of its {len(scenes)} scenes as the default; the first is read")
    roots = file.entry("scene", scenes, chosen or 0, "scene").nodes
    where = f"scenes[{chosen or 0}].nodes"
    for index in roots:
        file.entry("node", file.records.nodes, index, where)
        if forest.parents[index] >= 0:
            raise file.fault(where, f"expected roots, but node {index} is a child of node {forest.parents[index]}")
    if len(set(roots)) < len(roots):
        raise file.fault(where, "names a node twice")
    return list(roots)


def _local_matrices(file: GltfFile) -> Array:
    """Return the transform of each node relative to its parent [N,4,4]."""
    nodes = file.records.nodes
    matrices = _compose(
        file,
        np.array([node.translation for node in nodes]).reshape(-1, 3),
        np.array([node.rotation for node in nodes]).reshape(-1, 4),
        np.array([node.scale for node in nodes]).reshape(-1, 3),
        "nodes[{}].rotation",
    )
    for index, node in enumerate(nodes):
        if node.matrix is not None:
            if len(node.matrix) != 16:
                raise file.fault(f"nodes[{index}].matrix", f"expected 16 numbers, found {len(node.matrix)}")
            matrix = np.array(node.matrix).reshape(4, 4).T  # stored by columns
            refuse_projection(file, matrix, f"nodes[{index}].matrix")
            if not (np.array_equal(matrix, np.eye(4)) or np.array_equal(matrices[index], np.eye(4))):
                where = f"nodes[{index}]"
                raise file.fault(where, "expected a matrix, or a translation, rotation and scale, found both")
            matrices[index] = matrix @ matrices[index]
    return matrices


def _compose(file: GltfFile, translations: Array, rotations: Array, scales: Array, where: str) -> Array:
    """Return translation · rotation · scale [I,4,4]; the rotations [I,4] are unit quaternions x, y, z, w.

    `where` is the place of a rotation for errors; its number replaces the braces.
    """
    lengths = np.linalg.norm(rotations, axis=1, keepdims=True)
    wrong = ~(np.abs(lengths[:, 0] - 1) < _UNIT)
    if wrong.any():
        first = int(wrong.argmax())
        found = f"expected a unit quaternion x, y, z, w, found one of length {lengths[first, 0]:.3g}"
        raise file.fault(where.format(first), found)
    x, y, z, w = (rotations / lengths).T
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrices = np.zeros((len(translations), 4, 4))
    matrices[:, :3, :3] = np.moveaxis(turn, 2, 0) * scales[:, None, :]
    matrices[:, :3, 3] = translations
    matrices[:, 3, 3] = 1
    return matrices
