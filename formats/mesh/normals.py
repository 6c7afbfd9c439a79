"""One rule for vertex normals: they must agree with the faces around them.

Exporters write normals that point inwards, that are all (0, 0, 1), or that are zero. A bake would then cover the wrong
hemisphere at each vertex. Normals that are smoothed or weighted differ from those of the faces by far less.
"""

import os
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn

if TYPE_CHECKING:
    from formats.mesh.record import Mesh

Array = NDArray[np.float64]

_FEW = 0.01
"""Share of contradicting normals up to which only these are replaced."""
_LEAST_COSINE = 0.5
"""Least median of the cosines between the normals of a file and those of the faces."""


def agreeing_normals(path: str | os.PathLike[str], given: Array | None, of_faces: Array) -> Array:
    """The normals [V,3] of a file if they agree with those of the faces; otherwise those of the faces, with a warning.

    Args:
        path: the file, for the warning.
        given: unit vertex normals of the file [V,3], or None.
        of_faces: angle-weighted mean normals of the faces around each vertex [V,3].
    """
    if given is None:
        return of_faces
    cosines = np.einsum("vi,vi->v", given, of_faces)
    contradicting = ~(cosines > 0.0)
    if contradicting.mean() > _FEW or np.median(cosines) < _LEAST_COSINE:
        warn(
            f"{path}: the vertex normals contradict the faces: {contradicting.sum()} of {len(given)} point away from the "
            f"faces around them, and half of all differ from them by more than {_angle(np.median(cosines)):.0f} degrees; "
            f"normals computed from the faces are used instead"
        )
        return of_faces
    if contradicting.any():
        warn(
            f"{path}: {contradicting.sum()} of {len(given)} vertex normals point away from the faces around them; there, "
            f"normals computed from the faces are used"
        )
    return np.where(contradicting[:, None], of_faces, given)


def refuse_contradicting_normals(mesh: "Mesh", of_faces: Array) -> None:
    """Raise MeshError if normals of a mesh are not of unit length or contradict those of the faces [V,3]."""
    lengths = np.linalg.norm(mesh.normals, axis=1)
    wrong = ~(np.abs(lengths - 1.0) < 1e-3)
    if wrong.any():
        first = int(wrong.argmax())
        raise MeshError(
            f"mesh: {wrong.sum()} of {len(wrong)} normals are not unit vectors, the first is that of vertex {first} with "
            f"length {lengths[first]:.3g}; normalise them, or build the mesh with formats.mesh.build_mesh"
        )
    cosines = np.einsum("vi,vi->v", mesh.normals, of_faces)
    if (cosines <= 0.0).mean() > _FEW or np.median(cosines) < _LEAST_COSINE:
        raise MeshError(
            f"mesh: the vertex normals contradict the faces: {(cosines <= 0.0).sum()} of {len(cosines)} point away from "
            f"the faces around them; compute them from the faces, with formats.mesh.build_mesh"
        )


def _angle(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
