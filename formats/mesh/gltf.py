"""glTF 2.0, `.glb` and `.gltf`: every triangle of the scene, placed as its nodes say. Read with trimesh."""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.soup import TriangleSoup


def read_gltf(path: str | os.PathLike[str]) -> TriangleSoup:
    """Read a glTF file; positions are float32 in the file, placed in float64.

    Normals are left to be computed: a scene of several parts need not have them in all.

    Raises:
        MeshError: the file is no glTF, is truncated, or holds no triangles.
    """
    import trimesh

    try:
        scene = trimesh.load_scene(os.fspath(path), process=False)
        solids = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    except Exception as cause:  # trimesh lets whatever its parser stumbles over through, of any class
        raise MeshError(f"{path}: cannot be read as glTF, it is damaged or of another kind: {cause}") from cause
    if not solids:
        raise MeshError(f"{path}: has no faces; expected triangles")
    textured = [uv for part in solids if (uv := _corner_uv(part)) is not None]
    starts = np.cumsum([0, *(len(part.vertices) for part in solids)])
    return TriangleSoup(
        np.vstack([np.asarray(part.vertices, np.float64) for part in solids]),
        np.vstack([np.asarray(part.faces, np.int64) + start for part, start in zip(solids, starts, strict=False)]),
        corner_uv=np.concatenate(textured) if len(textured) == len(solids) else None,
    )


def _corner_uv(part: Any) -> NDArray[np.float64] | None:
    """The texture coordinates of a part's corners [F,3,2], v upwards (trimesh has turned glTF's), or None."""
    uv = getattr(part.visual, "uv", None)
    if uv is None or np.shape(uv) != (len(part.vertices), 2):
        return None
    corner_uv: NDArray[np.float64] = np.asarray(uv, np.float64)[part.faces]
    return corner_uv
