"""The surfaces of a scene in the kernels' layout, and the interface at a hit.

A walk keeps the set of parts that contain it as the bits of a mask. `region_of_mask` maps a mask to a region: 0
outside, p + 1 if part p is the innermost. A face belongs to one part. Crossing it from the front sets the part's bit,
crossing from behind clears it. If that changes the region, there is an interface between the two refractive indices.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.geometry.embree import nearest_hit
from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.tracer.surface.interface import MATCHED, ROUGH, SMOOTH

PASS, DIFFUSE, OPAQUE = -1, 3, 4
"""Kinds of interfaces beside the dielectric ones: none, a diffuse surface, a diffuse surface hit from inside."""
SAME_INDEX = 1e-9
"""Relative indices closer to 1 than this are index-matched."""
SMOOTHEST = 1e-4
"""Rough interfaces below this alpha count as smooth: float64 samples cannot resolve a narrower lobe."""
RAY_EPSILON = 1e-6
"""Least distance from a face to the next hit: some ten roundings of a position, so that at a vertex no walk bounces
between faces at distance 0. Faces of several parts within this distance count as one interface between the media before
and behind all of them."""


class Boundary(NamedTuple):
    """Surfaces of all parts; lengths in units of the object's longest side, relative to its centre.

    Kernels pass this record by value, about ten words per array. Few wide tables instead of many narrow ones save a
    third of the walk's time.
    """

    intersect: int
    scene: int
    faces: NDArray[np.float64]
    """[F,29]: normal, corners, normals and texture coordinates of the corners, part, and whether nothing lies in front
    of the face's plane. Faces of part 0, the object itself, come first."""
    planes: NDArray[np.float64]
    """[F,4]: normal, and distance of the plane from the origin along it."""
    parts: NDArray[np.float64]
    """[P,13]: alpha, mean reflectance, whether diffuse, whether normals are interpolated, the texture's first texel,
    height (0: no texture) and width, whether a rough interface is compensated, the absolute index inside, the address
    of an Embree scene of this part alone (exact in float64), and the part's first face."""
    texels: NDArray[np.float32]
    """Concatenated textures of all parts, three channels."""
    losses: NDArray[np.float64]
    """Tables of compensated interfaces (`prt_bake.tracer.surface.losses.loss_tables`); empty if there are none."""
    region_of_mask: NDArray[np.int64]
    clearance: NDArray[np.float32]
    """[n,n,n], z first, over the box −½ … ½: lower bound of the distance from a cell to any face; 0 outside."""
    near: NDArray[np.int32]
    """Faces near each cell of a grid (`prt_bake.tracer.surface.clearance.near_faces`)."""
    nested: bool
    kind: int
    alpha: float
    eta: float
    """Kind, mean alpha and refractive index of the outer interface."""
    radius: float
    """Radius of a bounding ball about the origin."""
    most_events: int
    """Events after which a walk is truncated; the throughput that it still carries is reported as lost."""


CORNERS, CORNER_NORMALS, CORNER_UV, PART, OPEN, FACE_SIZE = 3, 12, 21, 27, 28, 29
ALPHA, REFLECTANCE, IS_DIFFUSE, INTERPOLATED, FIRST_TEXEL, HEIGHT, WIDTH = 0, 1, 4, 5, 6, 7, 8
COMPENSATED, INDEX, TREE, FIRST_FACE, PART_SIZE = 9, 10, 11, 12, 13


@inlined_function()
def part_of(boundary: Any, face: Any) -> Any:
    """The part that a face belongs to."""
    return int(boundary.faces[face, PART])


@called_function()
def normal_at(boundary: Any, face: Any, u: Any, v: Any, normal: Any) -> None:
    """Write the shading normal at (u, v) of a face: the face's own, or the interpolated one if the part uses those."""
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


@inlined_function()
def point_on_face(boundary: Any, face: Any, u: Any, v: Any, position: Any) -> None:
    """Write the point at (u, v) of a face."""
    row = boundary.faces[face]
    for k in range(3):
        position[k] = (1.0 - u - v) * row[CORNERS + k] + u * row[CORNERS + 3 + k] + v * row[CORNERS + 6 + k]


@inlined_function()
def _texel(boundary: Any, part: Any, s: Any, t: Any, channel: Any) -> Any:
    """Texture of a part at (s, t), bilinear and repeating; t = 0 is the lower edge of the bottom row."""
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


@inlined_function()
def alpha_at(boundary: Any, face: Any, u: Any, v: Any) -> Any:
    """GGX alpha of the interface at (u, v) of a face."""
    row = boundary.parts[part_of(boundary, face)]
    if row[HEIGHT] == 0.0 or row[IS_DIFFUSE] != 0.0:
        return row[ALPHA]
    return _textured(boundary, face, u, v, 0)


@called_function()
def reflectance_at(boundary: Any, face: Any, part: Any, u: Any, v: Any, channel: Any) -> Any:
    """Reflectance of the diffuse `part` at a hit; the face is another part's if both surfaces coincide."""
    if boundary.parts[part, HEIGHT] == 0.0 or part_of(boundary, face) != part:
        return boundary.parts[part, REFLECTANCE + channel]
    return _textured(boundary, face, u, v, channel)


@inlined_function()
def is_compensated(boundary: Any, face: Any) -> Any:
    """Whether a rough interface at this face compensates the energy that single scattering loses."""
    return boundary.losses.shape[0] > 0 and boundary.parts[part_of(boundary, face), COMPENSATED] != 0.0


@inlined_function()
def sees_sky(boundary: Any, face: Any, d: Any) -> Any:
    """Whether a ray that leaves the face along d certainly hits nothing."""
    row = boundary.faces[face]
    return row[OPEN] != 0.0 and d[0] * row[0] + d[1] * row[1] + d[2] * row[2] > 0.0


@inlined_function()
def hits_back(boundary: Any, face: Any, d: Any) -> Any:
    """Whether a ray along d hits the face from behind, that is from inside its part."""
    g = boundary.faces[face]
    return d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0


@inlined_function()
def mask_before(boundary: Any, face: Any, d: Any, mask: Any) -> Any:
    """The mask of a walk that hits the face along d; the side that it hits tells whether it is in the face's part."""
    bit = 1 << part_of(boundary, face)
    return mask | bit if hits_back(boundary, face, d) else mask & ~bit


@inlined_function()
def resolve_hit(boundary: Any, ray: Any, p: Any, d: Any, t: Any, face: Any, mask: Any) -> Any:
    """The interface at p + t d, where `ray` has just hit a face: decisive face, (u, v) on it, masks before and behind.

    Coincident faces of several parts count as one. The first of these parts in the scene decides the interface.
    """
    u, v = np.float64(ray[15]), np.float64(ray[16])
    before = mask_before(boundary, face, d, mask)
    after = before ^ (1 << part_of(boundary, face))
    if boundary.nested:
        face, u, v, before, after = _resolve_coincident(boundary, ray, p, d, t, face, u, v, before, after)
    return face, u, v, before, after


@called_function()
def _resolve_coincident(
    boundary: Any, ray: Any, p: Any, d: Any, t: Any, face: Any, u: Any, v: Any, before: Any, after: Any
) -> Any:
    """Traces each part alone, since coincident faces hide each other."""
    back = t - RAY_EPSILON
    start = (p[0] + back * d[0], p[1] + back * d[1], p[2] + back * d[2])
    hit = part_of(boundary, face)
    for part in range(len(boundary.parts)):
        if part == hit:
            continue
        tree, first = int(boundary.parts[part, TREE]), int(boundary.parts[part, FIRST_FACE])
        found, _t = nearest_hit(boundary.intersect, tree, ray, start, d, 0.0, 2.0 * RAY_EPSILON, -1)
        if found < 0:
            continue
        other, bit = first + found, 1 << part
        if hits_back(boundary, other, d):
            before, after = before | bit, after & ~bit
        else:
            before, after = before & ~bit, after | bit
        if part < part_of(boundary, face):
            face, u, v = other, np.float64(ray[15]), np.float64(ray[16])
    return face, u, v, before, after


@inlined_function()
def interface_at(boundary: Any, face: Any, before: Any, after: Any) -> Any:
    """Kind of interface and relative index at a face, from the masks before and behind it."""
    kind = boundary.kind
    eta = boundary.eta if before == 0 else 1.0 / boundary.eta
    if boundary.nested:
        kind, eta = _nested_interface(boundary, face, before, after)
    return kind, eta


@inlined_function()
def _index(boundary: Any, region: Any) -> Any:
    return 1.0 if region == 0 else boundary.parts[region - 1, INDEX]


@called_function()
def _nested_interface(boundary: Any, face: Any, before: Any, after: Any) -> Any:
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


@inlined_function()
def facing_normal(boundary: Any, face: Any, normal: Any, d: Any) -> Any:
    """The shading normal on the side that d comes from; the face's own normal if d sees the shading normal from
    behind.
    """
    g = boundary.faces[face]
    geometric = d[0] * g[0] + d[1] * g[1] + d[2] * g[2]
    sign = -1.0 if geometric > 0.0 else 1.0
    x, y, z = sign * normal[0], sign * normal[1], sign * normal[2]
    if -(d[0] * x + d[1] * y + d[2] * z) <= 1e-9:
        x, y, z = sign * g[0], sign * g[1], sign * g[2]
    return x, y, z


@inlined_function()
def next_face(boundary: Any, ray: Any, p: Any, d: Any, start: Any, far: Any, face: Any) -> Any:
    """Nearest face along p + t d between `start`, on `face` (−1: none), and `far`, with its distance t.

    Skips faces within RAY_EPSILON of `face`: `resolve_hit` has treated them together with it.
    """
    near = start + RAY_EPSILON if face >= 0 else start
    return nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, max(far, near), face)


@called_function()
def next_interface(boundary: Any, ray: Any, p: Any, d: Any, face: Any, mask: Any) -> Any:
    """The first face along p + t d that is not index-matched: face, u, v, distance, masks before and behind it.

    Face −1: the ray reaches the sky. The ray starts on `face` (−1: none), inside the parts of `mask`.
    """
    start = 0.0
    while True:
        found, t = next_face(boundary, ray, p, d, start, np.inf, face)
        if found < 0:
            return found, 0.0, 0.0, t, mask, mask
        found, u, v, before, after = resolve_hit(boundary, ray, p, d, t, found, mask)
        kind, _eta = interface_at(boundary, found, before, after)
        if kind != PASS and kind != MATCHED:
            return found, u, v, t, before, after
        face, mask, start = found, after, t


@called_function()
def containing_parts(boundary: Any, p: Any, inward: Any, face: Any, ray: Any) -> Any:
    """Mask of the other parts that contain the point just inside `face` along `inward`.

    Traces each part alone, since coincident faces hide each other.
    """
    mask = 0
    for part in range(len(boundary.parts)):
        if not boundary.nested or part == part_of(boundary, face):
            continue
        # Faces within RAY_EPSILON coincide with this one: the point just inside is beyond them.
        tree, first = int(boundary.parts[part, TREE]), int(boundary.parts[part, FIRST_FACE])
        found, _t = nearest_hit(boundary.intersect, tree, ray, p, inward, RAY_EPSILON, np.inf, -1)
        if found >= 0 and hits_back(boundary, first + found, inward):
            mask |= 1 << part
    return mask
