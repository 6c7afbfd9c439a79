"""The nearest hit of a ray, from a tree of boxes, in scalar code for the processor and for CUDA.

Boxes are tested in float32; they are larger than their faces by more than the rounding (`tree.MARGIN`). Faces are
tested in float64, and reach a little beyond their edges, so that rays do not slip through between two of them, unless
these are extreme slivers.
"""

from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import called_function, inlined_function

LEVELS = 65535
"""Planes of boxes are stored in 16 bits: as multiples of 2 reach / LEVELS from −reach on."""
_WORD, _SHIFT = np.int32(0xFFFF), np.int32(16)
_HALF, _HALF_BITS = np.uint64(0xFFFFFFFF), np.uint64(32)
STACK_SIZE = 64
"""Nodes that wait while others are visited, at most: the depth of a tree."""
U_PLACE, V_PLACE, STACK_PLACE = 15, 16, 32
"""Places of the hit's u and v in a ray's record, and of the stack. Embree's record has the same u and v."""
RAY_SIZE = STACK_PLACE + STACK_SIZE
_BEYOND_EDGES = 1e-10


@inlined_function()
def _low(word: Any) -> Any:
    """The lower half of 64 bits, as an integer."""
    return np.uint32(word & _HALF).view(np.int32)


@inlined_function()
def _high(word: Any) -> Any:
    """The upper half of 64 bits, as an integer."""
    return np.uint32(word >> _HALF_BITS).view(np.int32)


@inlined_function()
def _slab(lower: Any, upper: Any, scale: Any, shift: Any, near: Any, far: Any) -> Any:
    """The part of a ray's interval (near, far) that lies between two parallel planes of a box."""
    first, second = np.float32(np.int32(lower)) * scale + shift, np.float32(np.int32(upper)) * scale + shift
    return max(near, min(first, second)), min(far, max(first, second))


@inlined_function()
def _axis(p: Any, d: Any, reach: Any) -> Any:
    """Factor and summand that turn a plane's stored number into the distance at which p + t d meets it."""
    inverse = np.float32(1.0 / d) if abs(d) > 1e-20 else np.float32(1e20)
    return np.float32(2.0 * reach / LEVELS) * inverse, np.float32(-reach - p) * inverse


@inlined_function()
def _entry(x: Any, y: Any, z: Any, sx: Any, sy: Any, sz: Any, near: Any, far: Any) -> Any:
    """Distance at which a ray enters a box, inf if it misses it. x, y, z: its lower and upper planes, 16 bits each."""
    near, far = _slab(x & _WORD, (x >> _SHIFT) & _WORD, sx[0], sx[1], near, far)
    near, far = _slab(y & _WORD, (y >> _SHIFT) & _WORD, sy[0], sy[1], near, far)
    near, far = _slab(z & _WORD, (z >> _SHIFT) & _WORD, sz[0], sz[1], near, far)
    return near if near <= far else np.float32(np.inf)


@called_function()
def nearest_hit(tree: Any, root: Any, ray: Any, p: Any, d: Any, near: Any, far: Any, skip: Any) -> Any:
    """Nearest hit of p + t d with near < t < far: (face or −1, t), as `prt_bake.geometry.embree.nearest_hit`.

    tree: a `Tree`; root: the node to begin with. ray float32 [RAY_SIZE] holds the stack, and u and v of the hit after.
    """
    stack = ray.view(np.int32)
    sx, sy, sz = _axis(p[0], d[0], tree.reach), _axis(p[1], d[1], tree.reach), _axis(p[2], d[2], tree.reach)
    found, best = -1, far
    waiting, node = 0, root
    while True:
        if node >= 0:
            low, high = np.float32(near), np.float32(best * 1.000001)
            x, y, z, both = tree.nodes[node, 0], tree.nodes[node, 1], tree.nodes[node, 2], tree.nodes[node, 3]
            left = _entry(_low(x), _low(y), _low(z), sx, sy, sz, low, high)
            right = _entry(_high(x), _high(y), _high(z), sx, sy, sz, low, high)
            nearer, other = _low(both), _high(both)
            if right < left:
                nearer, other = other, nearer
            if max(left, right) < np.inf:
                stack[STACK_PLACE + waiting] = other
                waiting += 1
            if min(left, right) < np.inf:
                node = nearer
                continue
        else:
            first = (-1 - node) >> 3
            for i in range(first, first + ((-1 - node) & 7)):
                face, t, u, v = _face_hit(tree.triangles[i], p, d)
                if near < t < best and face != skip:
                    found, best = face, t
                    ray[U_PLACE], ray[V_PLACE] = u, v
        if waiting == 0:
            break
        waiting -= 1
        node = stack[STACK_PLACE + waiting]
    return found, best if found >= 0 else np.inf


@inlined_function()
def _numbers(word: Any) -> Any:
    """Two float32 numbers of 64 bits, as float64."""
    first, second = np.uint32(word & _HALF).view(np.float32), np.uint32(word >> _HALF_BITS).view(np.float32)
    return np.float64(first), np.float64(second)


@inlined_function()
def _face_hit(triangle: Any, p: Any, d: Any) -> Any:
    """Number of a face, distance along p + t d to it, and (u, v) there; inf if the ray misses it (Möller and Trumbore
    1997).
    """
    (ax, ay), (az, bx) = _numbers(triangle[0]), _numbers(triangle[1])
    (by, bz), (cx, cy) = _numbers(triangle[2]), _numbers(triangle[3])
    (cz, _), face = _numbers(triangle[4]), _high(triangle[4])
    ex, ey, ez = bx - ax, by - ay, bz - az
    fx, fy, fz = cx - ax, cy - ay, cz - az
    qx, qy, qz = d[1] * fz - d[2] * fy, d[2] * fx - d[0] * fz, d[0] * fy - d[1] * fx
    determinant = ex * qx + ey * qy + ez * qz
    if determinant == 0.0:
        return face, np.inf, 0.0, 0.0
    inverse = 1.0 / determinant
    sx, sy, sz = p[0] - ax, p[1] - ay, p[2] - az
    u = (sx * qx + sy * qy + sz * qz) * inverse
    if not (u >= -_BEYOND_EDGES and u <= 1.0 + _BEYOND_EDGES):
        return face, np.inf, 0.0, 0.0
    rx, ry, rz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
    v = (d[0] * rx + d[1] * ry + d[2] * rz) * inverse
    if not (v >= -_BEYOND_EDGES and u + v <= 1.0 + _BEYOND_EDGES):
        return face, np.inf, 0.0, 0.0
    return face, (fx * rx + fy * ry + fz * rz) * inverse, u, v
