"""One rule for vertex normals: they must agree with the faces around them.

Exporters write normals that point inwards, that are all (0, 0, 1), or that are zero. A bake would then cover the wrong
hemisphere at each vertex. Normals that are smoothed or weighted differ from those of the faces by far less.
"""

import os
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, warn

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FEW = 0.01
"""Share of contradicting normals up to which only these are replaced."""
_LEAST_COSINE = 0.5
"""Least median of the cosines between the normals of a file and those of the faces."""
_INSTEAD = "normals computed from the faces are used"
_REMEDY = "compute them from the faces, as formats.mesh.build_mesh does"


def agreeing_normals(
    path: str | os.PathLike[str], given: Array | None, of_faces: Array, cancelled: Mask, inside_out: Callable[[], bool]
) -> tuple[Array, Mask]:
    """The normals of a file if they agree with those of the faces; otherwise those of the faces, with a warning.

    Args:
        path: the file, for the warning.
        given: unit vertex normals of the file [V,3], NaN where they are missing; or None.
        of_faces: angle-weighted mean normals of the faces around each vertex [V,3].
        cancelled: where that mean vanishes [V]; there any normal of the file is right.
        inside_out: whether the surface is closed and its faces are wound inside out. Normals that are opposite to such
            faces point outwards; they are reversed as the faces are, without a word.

    Returns:
        The normals [V,3], and which are those of the faces [V].
    """
    if given is None:
        return of_faces, np.ones(len(of_faces), np.bool_)
    cosines = np.einsum("vi,vi->v", given, of_faces)
    if _agree(-cosines[~cancelled]):
        if not inside_out():
            warn(f"{path}: the vertex normals point inwards; they were reversed")
        given, cosines = -given, -cosines
    contradicting = ~(cosines > 0.0) & ~cancelled
    found = f"{path}: {contradicting.sum()} of {len(given)} vertex normals are missing or point away from the faces"
    if not cancelled.all() and not _agree(cosines[~cancelled]):
        warn(f"{found}, the median angle being {_median_angle(cosines[~cancelled]):.0f} degrees; {_INSTEAD}")
        return of_faces, np.ones(len(of_faces), np.bool_)
    if contradicting.any():
        warn(f"{found}; there, {_INSTEAD}")
    computed = contradicting | np.isnan(given).any(axis=1)
    return np.where(computed[:, None], of_faces, given), computed


def _agree(cosines: Array) -> bool:
    """Whether all normals but a few are within 90 degrees of the faces', and half of them within 60; not if none."""
    return cosines.size > 0 and bool((~(cosines > 0.0)).mean() <= _FEW and np.nanmedian(cosines) >= _LEAST_COSINE)


def refuse_wrong_side(normals: Array, of_faces: Array, cancelled: Mask) -> None:
    """Raise MeshError if vertex normals [V,3] are not of unit length or contradict those of the faces [V,3].

    Where those of the faces cancel out [V], any unit normal will do.
    """
    lengths = np.linalg.norm(normals, axis=1)
    wrong = ~(np.abs(lengths - 1.0) < 1e-3)
    if wrong.any():
        first = int(wrong.argmax())
        raise MeshError(
            f"mesh: {wrong.sum()} of {len(wrong)} normals are not unit vectors, the first of these has "
            f"length {lengths[first]:.3g}; {_REMEDY}"
        )
    cosines = np.einsum("vi,vi->v", normals, of_faces)[~cancelled]
    if cosines.size and not _agree(cosines):
        raise MeshError(
            f"mesh: {(cosines <= 0.0).sum()} of {len(cosines)} vertex normals point away from the faces, the median "
            f"angle being {_median_angle(cosines):.0f} degrees; {_REMEDY}"
        )


def _median_angle(cosines: Array) -> float:
    """In degrees; missing normals count as opposite ones."""
    return float(np.degrees(np.arccos(np.clip(np.median(np.nan_to_num(cosines, nan=-1.0)), -1.0, 1.0))))
