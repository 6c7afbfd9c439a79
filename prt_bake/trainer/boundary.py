"""The surfaces of a scene as the kernels take them, and which media meet at a face.

A walker remembers which parts it is inside of as the bits of a mask; `region_of_mask` tells the region that this makes
(0 outside, part p + 1 where part p is the deepest). A face belongs to one part: crossing it from the front sets the
part's bit, from behind clears it, and where that changes the region, an interface stands between the two indices.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.trainer.compiled import walk_function
from prt_bake.trainer.embree import nearest_hit
from prt_bake.trainer.interface import MATCHED, ROUGH, SMOOTH

PASS, DIFFUSE, OPAQUE = -1, 3, 4
"""What a crossing may be beside the kinds of dielectrics: nothing, a diffuse surface met, one met from within."""
SMOOTHEST = 1e-4
"""A rough interface below this alpha is taken as smooth: its lobe is narrower than what float64 samples tell apart."""
CLEARANCE = 1e-6
"""How far a ray that starts on a face must fly before it may meet another one of the same part: some ten roundings of a
position, so that at a vertex no walk is handed to and fro between faces that all lie at distance 0."""


class Boundary(NamedTuple):
    """All parts' surfaces; lengths in units of the object's longest side, about its centre."""

    intersect: int
    scene: int
    scenes: NDArray[np.int64]
    """The handle of each part alone."""
    first_face: NDArray[np.int64]
    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_normals: NDArray[np.float64]
    vertex_normals: NDArray[np.float64]
    part: NDArray[np.int64]
    """The part of each face; those of part 0, the object itself, come first."""
    corner_uv: NDArray[np.float64]
    """[F,3,2], or [0,3,2] where no part has a texture."""
    texels: NDArray[np.float32]
    """The textures of all parts, three channels, one after the other."""
    texture: NDArray[np.int64]
    """First texel, height and width for each part; height 0 where it has none."""
    alphas: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    diffuse: NDArray[np.bool_]
    interpolate: NDArray[np.bool_]
    compensation: NDArray[np.float64]
    """Tables of `prt_bake.trainer.compensation` for each part."""
    etas: NDArray[np.float64]
    """Absolute index of each region."""
    region_of_mask: NDArray[np.int64]
    nested: bool
    kind: int
    alpha: float
    eta: float
    """Kind, mean alpha and index of the object's own interface."""
    radius: float
    """A ball about the origin of this radius holds the object."""
    most_events: int
    """A walk ends after so many events; what it still carried is counted as lost and reported."""
    clearance: NDArray[np.float32]
    """[n,n,n], z first, over the box −½ … ½: from anywhere in the cell no face is nearer; 0 outside the object."""


@walk_function()
def normal_at(boundary: Any, face: Any, u: Any, v: Any, normal: Any) -> None:
    """Write the interface's normal at (u, v) of a face: the face's own, or the interpolated one where it is asked
    for.
    """
    for k in range(3):
        normal[k] = boundary.face_normals[face, k]
    if not boundary.interpolate[boundary.part[face]]:
        return
    a, b, c = boundary.faces[face, 0], boundary.faces[face, 1], boundary.faces[face, 2]
    n = boundary.vertex_normals
    x = (1.0 - u - v) * n[a, 0] + u * n[b, 0] + v * n[c, 0]
    y = (1.0 - u - v) * n[a, 1] + u * n[b, 1] + v * n[c, 1]
    z = (1.0 - u - v) * n[a, 2] + u * n[b, 2] + v * n[c, 2]
    length = math.sqrt(x * x + y * y + z * z)
    if length > 1e-6:
        normal[0], normal[1], normal[2] = x / length, y / length, z / length


@walk_function()
def _texel(boundary: Any, part: Any, s: Any, t: Any, channel: Any) -> Any:
    """A part's texture at (s, t), bilinear and repeating; t = 0 is the bottom row's lower edge."""
    first, height, width = boundary.texture[part, 0], boundary.texture[part, 1], boundary.texture[part, 2]
    x, y = s * width - 0.5, (1.0 - t) * height - 0.5
    column, row = math.floor(x), math.floor(y)
    fx, fy = x - column, y - row
    c0, c1 = int(column) % width, (int(column) + 1) % width
    r0, r1 = int(row) % height, (int(row) + 1) % height
    texels = boundary.texels
    upper = texels[first + 3 * (r0 * width + c0) + channel] * (1.0 - fx)
    upper += texels[first + 3 * (r0 * width + c1) + channel] * fx
    lower = texels[first + 3 * (r1 * width + c0) + channel] * (1.0 - fx)
    lower += texels[first + 3 * (r1 * width + c1) + channel] * fx
    return upper * (1.0 - fy) + lower * fy


@walk_function()
def _textured(boundary: Any, face: Any, u: Any, v: Any, channel: Any) -> Any:
    uv = boundary.corner_uv[face]
    s = (1.0 - u - v) * uv[0, 0] + u * uv[1, 0] + v * uv[2, 0]
    t = (1.0 - u - v) * uv[0, 1] + u * uv[1, 1] + v * uv[2, 1]
    return _texel(boundary, boundary.part[face], s, t, channel)


@walk_function(inline="always")
def alpha_at(boundary: Any, face: Any, u: Any, v: Any) -> Any:
    """GGX alpha of the interface at (u, v) of a face."""
    part = boundary.part[face]
    if boundary.texture[part, 1] == 0 or boundary.diffuse[part]:
        return boundary.alphas[part]
    return _textured(boundary, face, u, v, 0)


@walk_function()
def reflectance_at(boundary: Any, face: Any, part: Any, u: Any, v: Any, channel: Any) -> Any:
    """What the diffuse `part` reflects where it is met at a face (of another part where both surfaces coincide)."""
    if boundary.texture[part, 1] == 0 or boundary.part[face] != part:
        return boundary.reflectance[part, channel]
    return _textured(boundary, face, u, v, channel)


@walk_function(inline="always")
def met_from_behind(boundary: Any, face: Any, d: Any) -> Any:
    """Whether a ray along d meets the face from inside its part."""
    g = boundary.face_normals[face]
    return d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0


@walk_function(inline="always")
def mask_before(boundary: Any, face: Any, d: Any, mask: Any) -> Any:
    """The mask of a walker that meets the face along d: its side tells whether it is in the face's part."""
    bit = 1 << boundary.part[face]
    if met_from_behind(boundary, face, d):
        return mask | bit
    return mask & ~bit


@walk_function()
def crossing(boundary: Any, face: Any, before: Any) -> Any:
    """(mask behind the face, kind of interface, relative index) for a walker that meets it with mask `before`."""
    part = boundary.part[face]
    after = before ^ (1 << part)
    here, there = boundary.region_of_mask[before], boundary.region_of_mask[after]
    if here == there:
        return after, PASS, 1.0
    if here > 0 and boundary.diffuse[here - 1]:
        return after, OPAQUE, 1.0
    if there > 0 and boundary.diffuse[there - 1]:
        return after, DIFFUSE, 1.0
    eta = boundary.etas[there] / boundary.etas[here]
    if abs(eta - 1.0) < 1e-9:
        return after, MATCHED, 1.0
    return after, SMOOTH if boundary.alphas[part] < SMOOTHEST else ROUGH, eta


@walk_function()
def facing_normal(boundary: Any, face: Any, normal: Any, d: Any) -> Any:
    """The interface normal turned to the side that d comes from.

    An interpolated normal that d sees from the wrong side gives way to the face's own.
    """
    g = boundary.face_normals[face]
    geometric = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    sign = -1.0 if geometric > 0.0 else 1.0
    x, y, z = sign * normal[0], sign * normal[1], sign * normal[2]
    if -(d[0] * x + d[1] * y + d[2] * z) <= 1e-9:
        x, y, z = sign * g[0], sign * g[1], sign * g[2]
    return x, y, z


@walk_function()
def next_face(boundary: Any, ray: Any, p: Any, d: Any, at: Any, far: Any, face: Any, former: Any) -> Any:
    """The nearest face along p + t d between `at`, where `face` lies (−1: none), and `far`, and its distance t.

    Faces closer to `face` than CLEARANCE are left out where they belong to its part, or to `former`, the part that was
    crossed at this very place before, on the same flight. A face of a third part so near, before or behind, lies on the
    one that the ray starts on, and counts.
    """
    if face < 0:
        return nearest_hit(boundary.intersect, boundary.scene, ray, p, d, at, far, face)
    if boundary.nested:
        found = _lying_on(boundary, ray, p, d, at, boundary.part[face], former)
        if found >= 0:
            return found, at
    near = at + CLEARANCE
    return nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, max(far, near), face)


@walk_function()
def _lying_on(boundary: Any, ray: Any, p: Any, d: Any, at: Any, part: Any, former: Any) -> Any:
    """A face at p + at d of neither of two parts; −1: none. Each part is asked by itself, since faces that lie on one
    another hide each other.
    """
    back = at - CLEARANCE
    start = (p[0] + back * d[0], p[1] + back * d[1], p[2] + back * d[2])
    for other in range(len(boundary.scenes)):
        if other != part and other != former:
            found, _t = nearest_hit(boundary.intersect, boundary.scenes[other], ray, start, d, 0.0, 2.0 * CLEARANCE, -1)
            if found >= 0:
                return boundary.first_face[other] + found
    return -1


@walk_function()
def reach(boundary: Any, ray: Any, p: Any, d: Any, face: Any, mask: Any) -> Any:
    """The first face along p + t d that is more than an index-matched boundary, its distance, and the mask before it.

    Face −1: the ray reaches the sky. The ray starts on `face` (−1: on none) with the walker's `mask`.
    """
    at, former = 0.0, -1
    while True:
        found, t = next_face(boundary, ray, p, d, at, np.inf, face, former)
        if found < 0:
            return found, t, mask
        before = mask_before(boundary, found, d, mask)
        after, kind, _eta = crossing(boundary, found, before)
        if kind != PASS and kind != MATCHED:
            return found, t, before
        former = boundary.part[face] if face >= 0 and t < at + 2.0 * CLEARANCE else -1
        face, mask, at = found, after, t


@walk_function()
def contained(boundary: Any, p: Any, inward: Any, face: Any, ray: Any) -> Any:
    """Mask of the parts other than the face's own that hold the point just inside `face` along `inward`.

    Each part is asked by itself, so that surfaces that lie on one another do not hide each other.
    """
    mask = 0
    for part in range(len(boundary.alphas)):
        if not boundary.nested or part == boundary.part[face]:
            continue
        # What lies within the clearance lies on the face: the point just inside is beyond it.
        found, _t = nearest_hit(boundary.intersect, boundary.scenes[part], ray, p, inward, CLEARANCE, np.inf, -1)
        if found >= 0 and met_from_behind(boundary, boundary.first_face[part] + found, inward):
            mask |= 1 << part
    return mask


@walk_function(inline="always")
def room_about(boundary: Any, p: Any) -> Any:
    """A distance from p, inside the object, within which there is no face; 0 where nothing is known."""
    n = boundary.clearance.shape[0]
    if n == 0:
        return 0.0
    x, y, z = int((p[0] + 0.5) * n), int((p[1] + 0.5) * n), int((p[2] + 0.5) * n)
    if x < 0 or y < 0 or z < 0 or x >= n or y >= n or z >= n:
        return 0.0
    return np.float64(boundary.clearance[z, y, x])
