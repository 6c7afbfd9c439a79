"""Stand-ins for statues: a knotted serpent, a robed figure, and a head with ears."""

import numpy as np
from numpy.typing import NDArray
from scenes.solids import Solid, plain, revolution, tube

Array = NDArray[np.float64]


def serpent() -> Solid:
    """A ridged tube of varying width along a trefoil knot, which shadows itself like a coiled dragon."""

    def knot(t: Array) -> Array:
        reach = 0.62 + 0.27 * np.cos(3 * t)
        return np.stack([reach * np.cos(2 * t), 0.36 * np.sin(3 * t), reach * np.sin(2 * t)], axis=1)

    def radius(t: Array, about: Array) -> Array:
        return (0.165 + 0.035 * np.sin(5 * t)) * (1 + 0.12 * np.cos(5 * about + 6 * t))

    return tube(knot, radius, 128, 20)


def figure() -> Solid:
    """A statuette two units high: a twisted pleated robe, shoulders and a head."""
    heights = [0.0, 0.0, 0.04, 0.12, 0.16, 0.45, 0.75, 1.0, 1.2, 1.36, 1.48, 1.56, 1.62, 1.68]
    radii = [0.0, 0.42, 0.46, 0.46, 0.38, 0.33, 0.26, 0.23, 0.27, 0.31, 0.26, 0.15, 0.11, 0.13]
    turn = np.linspace(-0.5, np.pi / 2, 8)
    heights += list(1.83 + 0.17 * np.sin(turn))
    radii += list(0.17 * np.cos(turn))
    radii[-1] = 0.0
    profile = _refined(np.stack([radii, heights], axis=1), 3)

    def pleats(phi: Array, height: Array) -> Array:
        depth = 0.13 * np.clip((1.45 - height) / 0.4, 0.0, 1.0) * np.clip((height - 0.15) / 0.3, 0.0, 1.0)
        shoulders = 0.35 * np.exp(-(((height - 1.34) / 0.12) ** 2))
        return 1 + depth * np.cos(7 * phi + 2.2 * height) + shoulders * (np.sin(phi) ** 2 - 0.5)

    return plain(revolution(profile, 48, pleats))


def head(step: float = 0.058) -> Solid:
    """A head with neck and thin protruding ears, two units high, facing −z.

    Marching cubes (scikit-image) of a distance field, then Taubin smoothing.
    """
    from skimage.measure import marching_cubes

    axes = [np.arange(low, high, step) for low, high in ((-0.95, 0.95), (-1.15, 1.15), (-0.95, 0.95))]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    vertices, faces, _, _ = marching_cubes(_head_distance(x, y, z), 0.0)
    positions = np.array([axis[0] for axis in axes]) + step * vertices.astype(np.float64)
    solid = Solid(_smoothed(positions, faces.astype(np.int64), 12), faces.astype(np.int64))
    a, b, c = (solid.positions[solid.faces[:, k]] for k in range(3))
    inside_out = np.einsum("fi,fi->", a, np.cross(b, c)) < 0
    return Solid(solid.positions, solid.faces[:, ::-1]) if inside_out else solid


def _head_distance(x: Array, y: Array, z: Array) -> Array:
    """Approximate signed distance to the head's surface, negative inside."""
    skull = _ellipsoid(x, y - 0.35, z - 0.06, 0.56, 0.66, 0.66)
    jaw = _ellipsoid(x, y + 0.12, z + 0.2, 0.4, 0.5, 0.42)
    neck = np.maximum(np.hypot(x, z - 0.12 - 0.1 * y) - 0.3, np.abs(y + 0.7) - 0.36)
    face = _blend(_blend(skull, jaw, 0.18), neck, 0.12)
    for side in (-1.0, 1.0):
        socket = _ellipsoid(x - side * 0.22, y - 0.26, z + 0.63, 0.14, 0.09, 0.12)
        face = -_blend(-face, socket, 0.07)
        eye = _ellipsoid(x - side * 0.22, y - 0.26, z + 0.48, 0.1, 0.1, 0.1)
        face = _blend(face, eye, 0.02)
    nose = _ellipsoid(x, y - 0.1 - 0.35 * (z + 0.66), z + 0.62, 0.09, 0.18, 0.16)
    lips = _ellipsoid(x, y + 0.2, z + 0.55, 0.16, 0.055, 0.1)
    chin = _ellipsoid(x, y + 0.45, z + 0.45, 0.16, 0.12, 0.14)
    for part in (nose, lips, chin):
        face = _blend(face, part, 0.07)
    for side in (-1.0, 1.0):
        face = _blend(face, _ear(side * x, y, z), 0.05)
    return np.maximum(face, -1.0 - y)


def _ear(x: Array, y: Array, z: Array) -> Array:
    """A thin curved disc with a round rim, pointing towards +x and back."""
    turn = np.radians(38.0)
    outwards, backwards = x - 0.5, z - 0.12
    across = np.cos(turn) * outwards - np.sin(turn) * backwards  # through the thickness
    along = np.sin(turn) * outwards + np.cos(turn) * backwards
    dish = across - 0.35 * (along - 0.16) ** 2
    beyond = np.maximum(_ellipsoid(0.0 * x, y - 0.24 - 0.25 * along, along - 0.16, 1.0, 0.22, 0.16), 0.0)
    distance: Array = np.hypot(beyond, dish) - 0.05
    return distance


def _ellipsoid(x: Array, y: Array, z: Array, a: float, b: float, c: float) -> Array:
    scaled = np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
    slope = np.sqrt((x / a**2) ** 2 + (y / b**2) ** 2 + (z / c**2) ** 2)
    distance: Array = scaled * (scaled - 1.0) / np.maximum(slope, 1e-9)
    return distance


def _blend(a: Array, b: Array, width: float) -> Array:
    """Smooth union (Quílez's polynomial smooth minimum)."""
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    union: Array = np.minimum(a, b) - h * h * width / 4.0
    return union


def _smoothed(positions: Array, faces: NDArray[np.int64], rounds: int) -> Array:
    """Smooth without shrinking (Taubin, "A Signal Processing Approach to Fair Surface Design", 1995)."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = np.bincount(edges[:, 0], minlength=len(positions))[:, None]
    for k in range(2 * rounds):
        means = np.stack(
            [np.bincount(edges[:, 0], positions[edges[:, 1], c], len(positions)) for c in range(3)], axis=1
        )
        positions = positions + (0.5 if k % 2 == 0 else -0.53) * (means / count - positions)
    return positions


def _refined(profile: Array, times: int) -> Array:
    """Subdivide each segment of a profile along the Catmull–Rom curve through its points."""
    padded = np.vstack([profile[:1], profile, profile[-1:]])
    t = np.arange(times)[:, None] / times
    pieces = []
    for k in range(len(profile) - 1):
        a, b, c, d = padded[k : k + 4]
        pieces.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    curve = np.vstack([*pieces, profile[-1:]])
    curve[1:-1, 0] = np.maximum(curve[1:-1, 0], 0.01)
    return curve
