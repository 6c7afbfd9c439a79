"""Layers of a picture beside its colour: geometry of the object, and parts of its radiance."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.shading.visible_points import PixelMeans, VisiblePoints

Array = NDArray[np.float64]

LAYERS = {
    "position": "object space, scene units",
    "normal": "interpolated vertex normals, unit",
    "vertex": "number of the vertex nearest to the middle of the pixel, -1 off the object",
    "radiance": "of the object, without the sky",
    "subsurface": "the part of the radiance from under the surface",
    "reflection": "the part of the radiance reflected at the surface",
}
"""The layers of `render_picture`. Position and normal are means over the object's part of a pixel, and 0 off the
object; radiance is weighted by coverage."""


def make_layers(
    names: tuple[str, ...],
    mesh: Mesh,
    points: VisiblePoints,
    pixels: PixelMeans,
    parts: Mapping[str, Array],
    radiance: Array,
) -> dict[str, NDArray[np.float32]]:
    """The requested layers by name, [H,W,3] or, for "vertex", [H,W].

    parts: subsurface and reflection [n,3] at the visible points. radiance [H,W,3] of the object. Raises QueryError for
    unknown names.
    """
    unknown = [name for name in names if name not in LAYERS]
    if unknown:
        raise QueryError(f"layers: expected some of {', '.join(LAYERS)}, found {unknown[0]!r}")

    def interpolated(values: Array) -> Array:
        u, v = points.barycentric[:, :1], points.barycentric[:, 1:]
        a, b, c = (values[mesh.faces[points.faces, k]] for k in range(3))
        return np.asarray((1.0 - u - v) * a + u * b + v * c)

    def mean_over_object(values: Array) -> Array:
        covered = pixels.means(None)[..., None]
        return np.divide(pixels.means(values), covered, out=np.zeros((*covered.shape[:2], 3)), where=covered > 0.0)

    makers: dict[str, Callable[[], Array]] = {
        "position": lambda: mean_over_object(interpolated(mesh.positions)),
        "normal": lambda: _unit(mean_over_object(interpolated(mesh.normals))),
        "vertex": lambda: _nearest_vertices(mesh, points, pixels),
        "radiance": lambda: radiance,
        "subsurface": lambda: pixels.means(parts["subsurface"]),
        "reflection": lambda: pixels.means(parts["reflection"]),
    }
    return {name: makers[name]().astype(np.float32) for name in names}


def _nearest_vertices(mesh: Mesh, points: VisiblePoints, pixels: PixelMeans) -> Array:
    numbers = np.full(pixels.means(None).shape, -1.0)
    weights = np.concatenate([1.0 - points.barycentric.sum(axis=1, keepdims=True), points.barycentric], axis=1)
    nearest = mesh.faces[points.faces, weights.argmax(axis=1)]
    # Points are in the order of pixels: take the middle one of each pixel.
    firsts = np.flatnonzero(np.diff(points.pixels, prepend=-1))
    middles = (firsts + np.append(firsts[1:], len(points.pixels)) - 1) // 2
    numbers.ravel()[points.pixels[middles]] = nearest[middles]
    return numbers


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))
