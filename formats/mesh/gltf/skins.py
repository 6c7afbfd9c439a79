"""Skins: vertices that joints move, in the default pose (glTF 2.0, section 3.7.3)."""

import numpy as np
from numpy.typing import NDArray

from formats.mesh.gltf.accessors import Accessors, Rows
from formats.mesh.gltf.container import GltfFile
from formats.mesh.gltf.nodes import Forest, refuse_projection
from formats.mesh.gltf.schema import Primitive

Array = NDArray[np.float64]


def joint_matrices(file: GltfFile, accessors: Accessors, forest: Forest, skin_index: int, where: str) -> Array:
    """Return for each joint of a skin the matrix from the mesh as it is stored to the scene [J,4,4].

    Raises:
        MeshError: the skin or a joint does not exist, or there are fewer inverse bind matrices than joints.
    """
    skin = file.entry("skin", file.records.skins, skin_index, where)
    place = f"skins[{skin_index}]"
    for joint in skin.joints:
        file.entry("node", file.records.nodes, joint, f"{place}.joints")
    matrices: Array = forest.matrices[list(skin.joints)]
    if skin.inverseBindMatrices is None:
        return matrices
    place = f"{place}.inverseBindMatrices"
    stored = accessors.floats(skin.inverseBindMatrices, "MAT4", place)
    if len(stored) < len(skin.joints):
        raise file.fault(place, f"expected a matrix for each of {len(skin.joints)} joints, found {len(stored)}")
    inverse = stored[: len(skin.joints)].reshape(-1, 4, 4).swapaxes(1, 2)  # stored by columns
    refuse_projection(file, inverse, place)
    moved: Array = matrices @ inverse
    return moved


def vertex_matrices(
    file: GltfFile, accessors: Accessors, primitive: Primitive, where: str, joints: Array, rows: Rows
) -> Array:
    """Return the matrix of each vertex [n,4,4], the mean of its joints' matrices [J,4,4] by weight.

    Weights are divided by their sum, as viewers do. `rows` are the vertices of the primitive, if not all.

    Raises:
        MeshError: weights or joint numbers are missing, negative, zero or out of range.
    """
    attributes, where = primitive.attributes, f"{where}.attributes"
    numbers = (name.removeprefix("JOINTS_") for name in attributes if name.startswith("JOINTS_"))
    sets = [number for number in numbers if number.isdigit()]
    if not sets or any(f"WEIGHTS_{number}" not in attributes for number in sets):
        raise file.fault(where, "expected JOINTS_0 and WEIGHTS_0, since the node has a skin")
    count = accessors.record(attributes["POSITION"], f"{where}.POSITION").count
    vertices = count if rows is None else len(rows)
    total, matrices = np.zeros(vertices), np.zeros((vertices, 4, 4))
    for number in sets:
        place = f"{where}.JOINTS_{number}"
        chosen = accessors.integers(attributes[f"JOINTS_{number}"], "VEC4", place, count, rows)
        weights = accessors.floats(attributes[f"WEIGHTS_{number}"], "VEC4", f"{where}.WEIGHTS_{number}", count, rows)
        if (weights < 0).any():
            raise file.fault(f"{where}.WEIGHTS_{number}", "has negative weights")
        chosen = np.where(weights > 0, chosen, 0)
        if chosen.max(initial=0) >= len(joints):
            raise file.fault(place, f"names joint {chosen.max()}, but the skin has {len(joints)} joints")
        for joint, weight in zip(chosen.T, weights.T, strict=True):
            matrices += weight[:, None, None] * joints[joint]
            total += weight
    if not (total > 0).all():
        raise file.fault(where, f"{(~(total > 0)).sum()} of {vertices} vertices have no weight of any joint")
    matrices /= total[:, None, None]
    return matrices
