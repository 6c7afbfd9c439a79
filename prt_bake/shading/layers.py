"""What a picture can hold beside its colour: where the object is seen, what of the light comes from where."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.shading.visible_points import PixelMeans, Seen

Array = NDArray[np.float64]

LAYERS = {
    "position": "object space, scene units",
    "normal": "interpolated vertex normals, unit",
    "vertex": "number of the vertex that is nearest to the middle of the pixel, -1 off the object",
    "radiance": "of the object alone, the sky left out",
    "subsurface": "of it what comes from under the surface",
    "reflection": "of it what the surface reflects",
}
"""Those that `render_picture` takes, and what they hold. Position and normal are means over the object's part of a
pixel, and 0 off it; radiance is weighted by coverage."""


def layers_of(
    names: tuple[str, ...],
    mesh: Mesh,
    seen: Seen,
    pixels: PixelMeans,
    of_object: Mapping[str, Array],
    radiance: Array,
) -> dict[str, NDArray[np.float32]]:
    """The layers [H,W,3], or [H,W] of `vertex`, by name; nothing is computed that is not asked for.

    of_object: subsurface and reflection at the points [n,3]; radiance [H,W,3]. Raises QueryError for unknown names.
    """
    unknown = [name for name in names if name not in LAYERS]
    if unknown:
        raise QueryError(f"layers: {unknown[0]!r} where some of {', '.join(LAYERS)} are expected")

    def blended(corners: Array) -> Array:
        u, v = seen.barycentric[:, :1], seen.barycentric[:, 1:]
        a, b, c = (corners[mesh.faces[seen.faces, k]] for k in range(3))
        return np.asarray((1.0 - u - v) * a + u * b + v * c)

    def on_object(values: Array) -> Array:
        covered = pixels.means(None)[..., None]
        return np.divide(pixels.means(values), covered, out=np.zeros((*covered.shape[:2], 3)), where=covered > 0.0)

    made: dict[str, Callable[[], Array]] = {
        "position": lambda: on_object(blended(mesh.positions)),
        "normal": lambda: _unit(on_object(blended(mesh.normals))),
        "vertex": lambda: _vertices(mesh, seen, pixels),
        "radiance": lambda: radiance,
        "subsurface": lambda: pixels.means(of_object["subsurface"]),
        "reflection": lambda: pixels.means(of_object["reflection"]),
    }
    return {name: made[name]().astype(np.float32) for name in names}


def _vertices(mesh: Mesh, seen: Seen, pixels: PixelMeans) -> Array:
    shape = pixels.means(None).shape
    numbers = np.full(shape, -1.0)
    shares = np.concatenate([1.0 - seen.barycentric.sum(axis=1, keepdims=True), seen.barycentric], axis=1)
    nearest = mesh.faces[seen.faces, shares.argmax(axis=1)]
    # The middle one of each pixel's samples on the object, in the order of their rows.
    firsts = np.flatnonzero(np.diff(seen.pixels, prepend=-1))
    middles = (firsts + np.append(firsts[1:], len(seen.pixels)) - 1) // 2
    numbers.ravel()[seen.pixels[middles]] = nearest[middles]
    return numbers


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))
