"""glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html), `.glb` and `.gltf`, read with trimesh.

All triangles of the scene are read, transformed by its nodes.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.soup import TriangleSoup


def read_gltf(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read a glTF file; its float32 positions are transformed in float64. Normals are not read: parts may lack them.

    Raises:
        MeshError: the file is not glTF, is truncated, or has no triangles.
    """
    import trimesh

    try:
        scene = trimesh.load_scene(os.fspath(path), process=False)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    except Exception as cause:  # trimesh raises errors of any class on damaged files
        raise MeshError(f"{path}: cannot be read as glTF, it is damaged or of another kind: {cause}") from cause
    if not parts:
        raise MeshError(f"{path}: has no faces; expected triangles, export the object as a triangle mesh")
    textured = [uv for part in parts if (uv := _corner_uv(part)) is not None]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return TriangleSoup(
        np.vstack([np.asarray(part.vertices, np.float64) for part in parts]),
        np.vstack([np.asarray(part.faces, np.int64) + start for part, start in zip(parts, starts, strict=False)]),
        corner_uv=np.concatenate(textured) if len(textured) == len(parts) else None,
    )


def _corner_uv(part: Any) -> NDArray[np.float64] | None:
    """The texture coordinates of a part's corners [F,3,2], or None. v points up: trimesh has flipped glTF's."""
    uv = getattr(part.visual, "uv", None)
    if uv is None or np.shape(uv) != (len(part.vertices), 2):
        return None
    corner_uv: NDArray[np.float64] = np.asarray(uv, np.float64)[part.faces]
    return corner_uv
