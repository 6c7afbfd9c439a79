"""The surfaces of a scene as the kernels take them, and which media meet at a face.

A walker remembers which parts it is inside of as the bits of a mask; `region_of_mask` tells the region that this makes
(0 outside, part p + 1 where part p is the deepest). A face belongs to one part: crossing it from the front sets the
part's bit, from behind clears it, and where that changes the region, an interface stands between the two indices.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.without_counts import called_function, walk_function
from prt_bake.tracer.surface.embree import nearest_hit
from prt_bake.tracer.surface.interface import MATCHED, ROUGH, SMOOTH

PASS, DIFFUSE, OPAQUE = -1, 3, 4
"""What a crossing may be beside the kinds of dielectrics: nothing, a diffuse surface met, one met from within."""
SAME_INDEX = 1e-9
"""Relative indices closer to 1 than this are index-matched."""
SMOOTHEST = 1e-4
"""A rough interface below this alpha is taken as smooth: its lobe is narrower than what float64 samples tell apart."""
CLEARANCE = 1e-6
"""How far a ray that starts on a face must fly before it may meet another one: some ten roundings of a position, so
that at a vertex no walk is handed to and fro between faces that all lie at distance 0. Faces of several parts that lie
so near one another are met together, as one interface between what is before and what is behind all of them."""


class Boundary(NamedTuple):
    """All parts' surfaces; lengths in units of the object's longest side, about its centre.

    Kernels hand this record from function to function, each array as some ten words: few wide tables cost less than
    many narrow ones (a third of the walk's time).
    """

    intersect: int
    scene: int
    faces: NDArray[np.float64]
    """[F,29]: normal (first), corners, normals and texture coordinates of the corners, part, and whether nothing lies
    in front of its plane. Those of part 0, the object itself, come first."""
    planes: NDArray[np.float64]
    """[F,4]: each face's normal, and its plane's distance from the origin along it."""
    parts: NDArray[np.float64]
    """[P,13]: alpha, mean reflectance, whether diffuse, whether normals are interpolated, the texture's first texel,
    height (0: no texture) and width, whether a rough interface is compensated, the absolute index inside, the address
    of Embree's scene of the part alone (float64 holds it exactly), and the part's first face."""
    texels: NDArray[np.float32]
    """The textures of all parts, three channels, one after the other."""
    losses: NDArray[np.float64]
    """What compensated interfaces give back (`prt_bake.tracer.surface.losses.loss_tables`); empty where there are none.
    """
    region_of_mask: NDArray[np.int64]
    clearance: NDArray[np.float32]
    """[n,n,n], z first, over the box −½ … ½: from anywhere in the cell no face is nearer; 0 outside the object."""
    near: NDArray[np.int32]
    """The faces near each cell of a grid (`prt_bake.tracer.surface.clearance.near_faces`)."""
    nested: bool
    kind: int
    alpha: float
    eta: float
    """Kind, mean alpha and index of the object's own interface."""
    radius: float
    """A ball about the origin of this radius holds the object."""
    most_events: int
    """A walk ends after so many events; what it still carried is counted as lost and reported."""


CORNERS, CORNER_NORMALS, CORNER_UV, PART, OPEN, FACE_SIZE = 3, 12, 21, 27, 28, 29
ALPHA, REFLECTANCE, IS_DIFFUSE, INTERPOLATED, FIRST_TEXEL, HEIGHT, WIDTH = 0, 1, 4, 5, 6, 7, 8
COMPENSATED, INDEX, TREE, FIRST_FACE, PART_SIZE = 9, 10, 11, 12, 13


@walk_function()
def part_of(boundary: Any, face: Any) -> Any:
    """The part that a face belongs to."""
    return int(boundary.faces[face, PART])


@called_function()
def normal_at(boundary: Any, face: Any, u: Any, v: Any, normal: Any) -> None:
    """Write the interface's normal at (u, v) of a face: the face's own, or the interpolated one where it is asked
    for.
    """
    row = boundary.faces[face]
    for k in range(3):
        normal[k] = row[k]
    if boundary.parts[part_of(boundary, face), INTERPOLATED] == 0.0:
        return
    w, n = 1.0 - u - v, CORNER_NORMALS
    x = w * row[n] + u * row[n + 3] + v * row[n + 6]
    y = w * row[n + 1] + u * row[n + 4] + v * row[n + 7]
    z = w * row[n + 2] + u * row[n + 5] + v * row[n + 8]
    length = math.sqrt(x * x + y * y + z * z)
    if length > 1e-6:
        normal[0], normal[1], normal[2] = x / length, y / length, z / length


@walk_function()
def place_on(boundary: Any, face: Any, u: Any, v: Any, position: Any) -> None:
    """Write the point at (u, v) of a face."""
    row = boundary.faces[face]
    for k in range(3):
        position[k] = (1.0 - u - v) * row[CORNERS + k] + u * row[CORNERS + 3 + k] + v * row[CORNERS + 6 + k]


@walk_function()
def _texel(boundary: Any, part: Any, s: Any, t: Any, channel: Any) -> Any:
    """A part's texture at (s, t), bilinear and repeating; t = 0 is the bottom row's lower edge."""
    row = boundary.parts[part]
    first, height, width = int(row[FIRST_TEXEL]), int(row[HEIGHT]), int(row[WIDTH])
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


@called_function()
def _textured(boundary: Any, face: Any, u: Any, v: Any, channel: Any) -> Any:
    row = boundary.faces[face]
    s = (1.0 - u - v) * row[CORNER_UV] + u * row[CORNER_UV + 2] + v * row[CORNER_UV + 4]
    t = (1.0 - u - v) * row[CORNER_UV + 1] + u * row[CORNER_UV + 3] + v * row[CORNER_UV + 5]
    return _texel(boundary, part_of(boundary, face), s, t, channel)


@walk_function()
def alpha_at(boundary: Any, face: Any, u: Any, v: Any) -> Any:
    """GGX alpha of the interface at (u, v) of a face."""
    row = boundary.parts[part_of(boundary, face)]
    if row[HEIGHT] == 0.0 or row[IS_DIFFUSE] != 0.0:
        return row[ALPHA]
    return _textured(boundary, face, u, v, 0)


@called_function()
def reflectance_at(boundary: Any, face: Any, part: Any, u: Any, v: Any, channel: Any) -> Any:
    """What the diffuse `part` reflects where it is met at a face (of another part where both surfaces coincide)."""
    if boundary.parts[part, HEIGHT] == 0.0 or part_of(boundary, face) != part:
        return boundary.parts[part, REFLECTANCE + channel]
    return _textured(boundary, face, u, v, channel)


@walk_function()
def is_compensated(boundary: Any, face: Any) -> Any:
    """Whether the interface at a face, where it is rough, gives back what single scattering loses."""
    return boundary.losses.shape[0] > 0 and boundary.parts[part_of(boundary, face), COMPENSATED] != 0.0


@walk_function()
def sees_sky(boundary: Any, face: Any, d: Any) -> Any:
    """Whether a ray that leaves the face along d is known to meet nothing any more."""
    row = boundary.faces[face]
    return row[OPEN] != 0.0 and d[0] * row[0] + d[1] * row[1] + d[2] * row[2] > 0.0


@walk_function()
def met_from_behind(boundary: Any, face: Any, d: Any) -> Any:
    """Whether a ray along d meets the face from inside its part."""
    g = boundary.faces[face]
    return d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0


@walk_function()
def mask_before(boundary: Any, face: Any, d: Any, mask: Any) -> Any:
    """The mask of a walker that meets the face along d: its side tells whether it is in the face's part."""
    bit = 1 << part_of(boundary, face)
    return mask | bit if met_from_behind(boundary, face, d) else mask & ~bit


@walk_function()
def meet(boundary: Any, ray: Any, p: Any, d: Any, t: Any, face: Any, mask: Any) -> Any:
    """What a walker with `mask` meets at p + t d, where `ray` has just hit a face: the face that decides, where on it
    (u, v), and the masks before and behind that place.

    All parts whose faces lie there are crossed as one; the first of them in the scene gives the interface.
    """
    u, v = np.float64(ray[15]), np.float64(ray[16])
    before = mask_before(boundary, face, d, mask)
    after = before ^ (1 << part_of(boundary, face))
    if boundary.nested:
        face, u, v, before, after = _meet_together(boundary, ray, p, d, t, face, u, v, before, after)
    return face, u, v, before, after


@called_function()
def _meet_together(
    boundary: Any, ray: Any, p: Any, d: Any, t: Any, face: Any, u: Any, v: Any, before: Any, after: Any
) -> Any:
    """Each part is asked by itself, since faces that lie on one another hide each other."""
    back = t - CLEARANCE
    start = (p[0] + back * d[0], p[1] + back * d[1], p[2] + back * d[2])
    hit = part_of(boundary, face)
    for part in range(len(boundary.parts)):
        if part == hit:
            continue
        tree, first = int(boundary.parts[part, TREE]), int(boundary.parts[part, FIRST_FACE])
        found, _t = nearest_hit(boundary.intersect, tree, ray, start, d, 0.0, 2.0 * CLEARANCE, -1)
        if found < 0:
            continue
        other, bit = first + found, 1 << part
        if met_from_behind(boundary, other, d):
            before, after = before | bit, after & ~bit
        else:
            before, after = before & ~bit, after | bit
        if part < part_of(boundary, face):
            face, u, v = other, np.float64(ray[15]), np.float64(ray[16])
    return face, u, v, before, after


@walk_function()
def crossing(boundary: Any, face: Any, before: Any, after: Any) -> Any:
    """Kind of interface, and relative index, at a face with these masks of the walker before and behind it."""
    kind = boundary.kind
    eta = boundary.eta if before == 0 else 1.0 / boundary.eta
    if boundary.nested:
        kind, eta = _crossing_of_parts(boundary, face, before, after)
    return kind, eta


@walk_function()
def _index(boundary: Any, region: Any) -> Any:
    return 1.0 if region == 0 else boundary.parts[region - 1, INDEX]


@called_function()
def _crossing_of_parts(boundary: Any, face: Any, before: Any, after: Any) -> Any:
    here, there = boundary.region_of_mask[before], boundary.region_of_mask[after]
    if here == there:
        return PASS, 1.0
    if here > 0 and boundary.parts[here - 1, IS_DIFFUSE] != 0.0:
        return OPAQUE, 1.0
    if there > 0 and boundary.parts[there - 1, IS_DIFFUSE] != 0.0:
        return DIFFUSE, 1.0
    eta = _index(boundary, there) / _index(boundary, here)
    if abs(eta - 1.0) < SAME_INDEX:
        return MATCHED, 1.0
    return SMOOTH if boundary.parts[part_of(boundary, face), ALPHA] < SMOOTHEST else ROUGH, eta


@walk_function()
def facing_normal(boundary: Any, face: Any, normal: Any, d: Any) -> Any:
    """The interface normal turned to the side that d comes from.

    An interpolated normal that d sees from the wrong side gives way to the face's own.
    """
    g = boundary.faces[face]
    geometric = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    sign = -1.0 if geometric > 0.0 else 1.0
    x, y, z = sign * normal[0], sign * normal[1], sign * normal[2]
    if -(d[0] * x + d[1] * y + d[2] * z) <= 1e-9:
        x, y, z = sign * g[0], sign * g[1], sign * g[2]
    return x, y, z


@walk_function()
def next_face(boundary: Any, ray: Any, p: Any, d: Any, at: Any, far: Any, face: Any) -> Any:
    """The nearest face along p + t d between `at`, where `face` lies (−1: none), and `far`, and its distance t.

    Faces closer to `face` than CLEARANCE are left out: they were met together with it.
    """
    near = at + CLEARANCE if face >= 0 else at
    return nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, max(far, near), face)


@called_function()
def reach(boundary: Any, ray: Any, p: Any, d: Any, face: Any, mask: Any) -> Any:
    """The first face along p + t d that is more than an index-matched boundary, where on it the ray arrives (u, v), its
    distance, and the masks before and behind it.

    Face −1: the ray reaches the sky. The ray starts on `face` (−1: on none) with the walker's `mask`.
    """
    at = 0.0
    while True:
        found, t = next_face(boundary, ray, p, d, at, np.inf, face)
        if found < 0:
            return found, 0.0, 0.0, t, mask, mask
        found, u, v, before, after = meet(boundary, ray, p, d, t, found, mask)
        kind, _eta = crossing(boundary, found, before, after)
        if kind != PASS and kind != MATCHED:
            return found, u, v, t, before, after
        face, mask, at = found, after, t


@called_function()
def contained(boundary: Any, p: Any, inward: Any, face: Any, ray: Any) -> Any:
    """Mask of the parts other than the face's own that hold the point just inside `face` along `inward`.

    Each part is asked by itself, so that surfaces that lie on one another do not hide each other.
    """
    mask = 0
    for part in range(len(boundary.parts)):
        if not boundary.nested or part == part_of(boundary, face):
            continue
        # What lies within the clearance lies on the face: the point just inside is beyond it.
        tree, first = int(boundary.parts[part, TREE]), int(boundary.parts[part, FIRST_FACE])
        found, _t = nearest_hit(boundary.intersect, tree, ray, p, inward, CLEARANCE, np.inf, -1)
        if found >= 0 and met_from_behind(boundary, first + found, inward):
            mask |= 1 << part
    return mask
