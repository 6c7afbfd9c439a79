"""Texture coordinates that no texture can be looked up by, and those outside the image."""

import numpy as np
from numpy.typing import NDArray

from formats.mesh.record import Mesh

_LARGEST = 1e6
"""Beyond it float32 resolves less than a sixteenth of the image."""
_BORDER = 1e-3  # images repeat; coordinates that leave them by less are meant to be on the border


def texture_fault(mesh: Mesh) -> str | None:
    """Return a clause that counts unusable texture coordinates and gives the first; None if all can be used.

    A mesh without texture coordinates has no fault.
    """
    if mesh.corner_uv is None:
        return None
    unusable = ~(np.abs(mesh.corner_uv) <= _LARGEST).all(axis=2)
    if not unusable.any():
        return None
    face, corner = np.argwhere(unusable)[0]
    vertex = int(mesh.faces[face, corner])
    in_file = vertex if mesh.source_vertex is None else int(np.argmax(mesh.source_vertex == vertex))
    return (
        f"{unusable.sum()} of {unusable.size} corners of faces have texture coordinates that are not finite or beyond "
        f"±{_LARGEST:g}, the first at vertex {in_file} ({_numbers(mesh.positions[vertex])}): "
        f"({_numbers(mesh.corner_uv[face, corner])}); unwrap the mesh again"
    )


def texture_remark(mesh: Mesh) -> str | None:
    """Return a clause on texture coordinates outside [0,1], where images repeat; None if there are none."""
    if mesh.corner_uv is None or texture_fault(mesh):
        return None
    low, high = mesh.corner_uv.min(axis=(0, 1)), mesh.corner_uv.max(axis=(0, 1))
    if low.min() >= -_BORDER and high.max() <= 1 + _BORDER:
        return None
    return f"the texture coordinates go from ({_numbers(low)}) to ({_numbers(high)}); outside 0 to 1 images repeat"


def _numbers(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
