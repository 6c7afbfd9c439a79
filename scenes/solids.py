"""Closed surfaces by formula: bodies of revolution with texture coordinates, rounded boxes, and tubes along knots."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A mesh: positions [V,3], faces [F,3] counter-clockwise from outside, corner_uv [F,3,2] or None."""

    positions: Array
    faces: NDArray[np.int64]
    corner_uv: Array | None = None

    def moved(self, scale: float | list[float] = 1.0, turn: Array | None = None, offset: object = 0.0) -> "Solid":
        """Scale about the origin, rotate by a matrix [3,3], then translate."""
        scaled = self.positions * np.asarray(scale)
        return replace(self, positions=(scaled if turn is None else scaled @ turn.T) + np.asarray(offset))


def write(solid: Solid, path: Path, digits: int = 4) -> None:
    """Write an OBJ file with `digits` decimals."""
    rows = [f"v {x:.{digits}f} {y:.{digits}f} {z:.{digits}f}" for x, y, z in solid.positions]
    pairs, places = np.zeros((0, 2)), solid.faces
    if solid.corner_uv is not None:
        pairs, inverse = np.unique(solid.corner_uv.reshape(-1, 2).round(digits), axis=0, return_inverse=True)
        places = inverse.reshape(-1, 3)
    rows += [f"vt {u:.{digits}f} {v:.{digits}f}" for u, v in pairs]
    corner = "{}" if solid.corner_uv is None else "{}/{}"
    rows += [
        "f " + " ".join(corner.format(vertex + 1, pair + 1) for vertex, pair in zip(face, textured, strict=True))
        for face, textured in zip(solid.faces.tolist(), places.tolist(), strict=True)
    ]
    with replacing(path) as part:
        part.write_text("\n".join([*rows, ""]))


def revolution(profile: Array, segments: int, ripple: Callable[[Array, Array], Array] | None = None) -> Solid:
    """Return a body of revolution about the y axis with one vertex at each pole.

    Args:
        profile: radius and height [n,2], from the lower pole to the upper one; the first and last radius are 0.
        segments: number of sides.
        ripple: factor on the radius, of the angle about the axis and the height.

    Returns:
        The body, with u around the axis and v along the profile.
    """
    rings = len(profile) - 2
    angle = np.arange(segments) * 2 * np.pi / segments
    phi, radius = np.tile(angle, rings), np.repeat(profile[1:-1, 0], segments)
    height = np.repeat(profile[1:-1, 1], segments)
    radius = radius if ripple is None else radius * ripple(phi, height)
    around = np.stack([radius * np.sin(phi), height, radius * np.cos(phi)], axis=1)
    positions = np.vstack([[0.0, profile[0, 1], 0.0], around, [0.0, profile[-1, 1], 0.0]])
    here = np.arange(segments)
    ahead = (here + 1) % segments
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    v = length / length[-1]
    u0, u1 = here / segments, (here + 1) / segments
    faces = [np.stack([np.zeros(segments, np.int64), 1 + ahead, 1 + here], axis=1)]
    uv = [_corners((u0 + u1) / 2, v[0], u1, v[1], u0, v[1])]
    for ring in range(rings - 1):
        a, b = 1 + ring * segments, 1 + (ring + 1) * segments
        low, high = v[ring + 1], v[ring + 2]
        faces += [np.stack([a + here, a + ahead, b + ahead], axis=1), np.stack([a + here, b + ahead, b + here], axis=1)]
        uv += [_corners(u0, low, u1, low, u1, high), _corners(u0, low, u1, high, u0, high)]
    top = 1 + (rings - 1) * segments
    faces.append(np.stack([top + here, top + ahead, np.full(segments, len(positions) - 1)], axis=1))
    uv.append(_corners(u0, v[-2], u1, v[-2], (u0 + u1) / 2, v[-1]))
    return Solid(positions, np.vstack(faces), np.concatenate(uv))


def ellipsoid(radii: tuple[float, float, float], rings: int, segments: int) -> Solid:
    """An ellipsoid about the y axis, textured as `revolution`."""
    theta = np.linspace(0.0, np.pi, rings + 2)
    profile = np.stack([np.sin(theta), -np.cos(theta)], axis=1)
    profile[[0, -1], 0] = 0.0
    return revolution(profile, segments).moved(list(radii))


def beaker(lower: float, upper: float, bottom: float, top: float, edge: float) -> Array:
    """The profile of a conical cup, solid, with edges rounded by a radius `edge`: rows of radius and height."""
    turn = np.linspace(0.0, np.pi / 2, 5)
    low = np.stack([lower - edge + edge * np.sin(turn), bottom + edge - edge * np.cos(turn)], axis=1)
    high = np.stack([upper - edge + edge * np.cos(turn), top - edge + edge * np.sin(turn)], axis=1)
    share = np.linspace(0.0, 1.0, 10)[1:-1, None]
    wall = low[-1] + share * (high[0] - low[-1])
    floor, lid = low[0] * [0.5, 1.0], high[-1] * [0.5, 1.0]
    return np.vstack([[0.0, bottom], floor, low, wall, high, lid, [0.0, top]])


def rounded_box(half: float, edge: float, bevel: int = 4, flat: int = 2) -> Solid:
    """A cube of half side `half` about the origin, edges rounded by a radius `edge` in `bevel` steps."""
    inner = half - edge
    steps = edge * np.tan(np.linspace(np.pi / 4, 0.0, bevel + 1))
    line = np.concatenate([-inner - steps[:-1], np.linspace(-inner, inner, flat + 1), inner + steps[-2::-1]])
    s, t = np.meshgrid(line, line, indexing="ij")
    count = len(line)
    index = np.arange(count * count).reshape(count, count)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    triangles = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    points: list[Array] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            sheet = np.empty((count * count, 3))
            sheet[:, axis], sheet[:, (axis + 1) % 3], sheet[:, (axis + 2) % 3] = sign * half, s.ravel(), t.ravel()
            faces.append((triangles if sign > 0 else triangles[:, ::-1]) + len(points) * count * count)
            points.append(sheet)
    cube = np.vstack(points)
    core = np.clip(cube, -inner, inner)
    outwards = cube - core
    rounded = core + edge * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    _, first, place = np.unique(rounded.round(9) + 0.0, axis=0, return_index=True, return_inverse=True)
    return Solid(rounded[first], place.ravel()[np.vstack(faces)])


def tube(curve: Callable[[Array], Array], radius: Callable[[Array, Array], Array], rings: int, segments: int) -> Solid:
    """Return a closed tube along `curve`, which maps t in [0, 2π) to [n,3]; `radius` depends on t and the angle."""
    t = np.arange(rings) * 2 * np.pi / rings
    center, step = curve(t), 1e-4
    along = curve(t + step) - curve(t - step)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # A parallel-transport frame, whose total twist is distributed evenly so that the tube closes.
    side = np.empty_like(center)
    side[0] = np.cross(along[0], [0.0, 1.0, 0.0])
    side[0] /= np.linalg.norm(side[0])
    for k in range(1, rings):
        side[k] = side[k - 1] - along[k] * (side[k - 1] @ along[k])
        side[k] /= np.linalg.norm(side[k])
    last = side[-1] - along[0] * (side[-1] @ along[0])
    twist = np.arctan2(np.cross(last, side[0]) @ along[0], last @ side[0])
    up = np.cross(along, side)
    about = np.tile(np.arange(segments) * 2 * np.pi / segments, (rings, 1))
    angle = about + (twist * t / (2 * np.pi))[:, None]
    distance = radius(t[:, None], about)[..., None]
    spokes = np.cos(angle)[..., None] * side[:, None] + np.sin(angle)[..., None] * up[:, None]
    positions = (center[:, None] + distance * spokes).reshape(-1, 3)
    index = np.arange(rings * segments).reshape(rings, segments)
    a, b = index, np.roll(index, -1, axis=1)
    c, d = np.roll(b, -1, axis=0), np.roll(a, -1, axis=0)
    faces = np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])
    return Solid(positions, faces)


def plain(solid: Solid) -> Solid:
    """Return the solid without texture coordinates."""
    return replace(solid, corner_uv=None)


def turn_matrix(axis: list[float], degrees: float) -> Array:
    """Return the right-handed rotation matrix [3,3] about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross, angle = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), np.radians(degrees)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def _corners(*given: Array | float) -> Array:
    columns = np.broadcast_arrays(*given)
    return np.stack(columns, axis=1).reshape(-1, 3, 2)
