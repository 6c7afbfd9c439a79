"""Texture coordinates for an object: its own if they suit, else those of xatlas.

Coordinates suit if nearly every texel belongs to one place. Those of files often do not: mirrored halves and repeated
parts lie upon each other. xatlas: https://github.com/jpcy/xatlas.
"""

from collections.abc import Callable

import numpy as np

from formats.errors import MeshError
from formats.extras import missing_sentence
from formats.mesh import Mesh
from prt_bake.baselines.texture_space import Array, Indices, cover, uv_areas

PADDING = 4
"""Least distance of the charts of an unwrapped mesh, in texels."""
_MOST_SHARED = 0.01
"""Share of the texels that belong to several places, as at narrow gaps of a chart, and of faces without area."""
_MARGIN = 0.97
"""Size of the packed charts in texels over that of the texture; xatlas meets the requested size roughly."""
_ATTEMPTS = 8
_LENGTH = 1000.0
"""Diagonal of the box of a mesh that is passed to xatlas."""


def texture_coordinates(mesh: Mesh, size: int, say: Callable[[str], None]) -> Array:
    """Coordinates [F,3,2] of the faces' corners, in the unit square, for a texture of size² texels.

    They are the mesh's own, or new ones of xatlas, which `say` is told with the reason. Raises MeshError if new ones
    are needed and xatlas is not installed.
    """
    faces = np.asarray(mesh.faces, np.int64)
    reason = "it has no texture coordinates"
    if mesh.corner_uv is not None:
        own = in_unit_square(mesh.corner_uv)
        reason = fault_of(own, faces, size)
        if not reason:
            return own
    if missing := missing_sentence("xatlas"):
        raise MeshError(f"mesh: {reason}, and its places need texels of their own, which xatlas gives it; {missing}")
    say(f"mesh: {reason}; it is unwrapped by xatlas, and the model keeps the new coordinates")
    return unwrap(mesh, size)


def unwrap(mesh: Mesh, size: int) -> Array:
    """Coordinates [F,3,2] of an atlas of xatlas, its charts `PADDING` texels apart in a texture of size² texels."""
    import xatlas

    # xatlas takes faces below an absolute area for degenerate, and then returns NaN.
    positions = (mesh.positions - mesh.center) * (_LENGTH / max(float(mesh.diagonal), 1e-300))
    target = size
    for _ in range(_ATTEMPTS):
        atlas = xatlas.Atlas()
        atlas.add_mesh(np.asarray(positions, np.float32), np.asarray(mesh.faces, np.uint32))
        packing = xatlas.PackOptions()
        packing.padding, packing.resolution, packing.bilinear = PADDING + 1, max(8, round(_MARGIN * target)), True
        atlas.generate(xatlas.ChartOptions(), packing)
        extent = max(atlas.width, atlas.height)
        if extent <= size:
            break
        target = int(target * size / extent)
    _vertices, indices, uv = atlas[0]
    scale = np.array([atlas.width, atlas.height]) / max(extent, size)
    return np.asarray(np.asarray(uv, np.float64)[np.asarray(indices, np.int64)] * scale)


def in_unit_square(corner_uv: Array) -> Array:
    """Coordinates moved and scaled, alike on both axes, into the unit square; unchanged if they lie in it."""
    low, high = corner_uv.min(axis=(0, 1)), corner_uv.max(axis=(0, 1))
    if low.min() >= 0.0 and high.max() <= 1.0:
        return np.asarray(corner_uv)
    return np.asarray((corner_uv - low) / max(float((high - low).max()), 1e-300))


def fault_of(corner_uv: Array, faces: Indices, size: int) -> str:
    """Why coordinates [F,3,2] of faces [F,3] do not suit a texture of size² texels, as a sentence; empty if they do."""
    if not np.isfinite(corner_uv).all():
        return "its texture coordinates are not finite"
    if (flat := int((uv_areas(corner_uv) == 0.0).sum())) > _MOST_SHARED * len(faces):
        return f"{flat} of its {len(faces)} faces have no area in texture coordinates"
    coverage = cover(corner_uv, faces, size)
    texels, rows = (len(np.unique(part)) for part in (coverage.texels, coverage.rows))
    if (shared := rows - texels) > _MOST_SHARED * texels:
        return f"its texture coordinates overlap or are mirrored: {shared} of {texels} texels would be shared"
    return ""
