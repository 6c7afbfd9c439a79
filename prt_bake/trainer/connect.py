"""Connections: what a walk's event receives from given directions of incidence, without waiting for the walk to leave.

Index-matched: every scattering event looks straight towards the light. Rough: the walk's own arrivals at the boundary
look through the interface, and every scattering event also aims at the boundary by a lobe about the light's direction
(refraction bends light towards the normal, so what arrives flies near it); both are weighted by the balance heuristic
(Veach 1997).
"""

import math
from typing import Any

import numpy as np

from prt_bake.trainer.compiled import walk_function
from prt_bake.trainer.counter import uniform
from prt_bake.trainer.embree import nearest_hit
from prt_bake.trainer.interface import rough_density
from prt_bake.trainer.media import phase, transmittance
from prt_bake.trainer.walk import (
    AT,
    CLEARANCE,
    DIRECTION,
    FACE,
    NORMAL,
    PHASE,
    POSITION,
    THROUGHPUT,
    facing_normal,
    frame,
    normal_at,
)


@walk_function()
def straight_transmittance(
    boundary: Any, medium: Any, p: Any, d: Any, skip: Any, at: Any, ray: Any, stream: Any
) -> Any:
    """Transmittance from p along d to infinity through an index-matched object, every crossing included."""
    kept = 1.0
    near = 0.0
    begun = 0.0
    while kept > 0.0:
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, np.inf, skip)
        if face < 0:
            return kept
        g = boundary.face_normals[face]
        leaves = d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0
        if leaves:
            kept *= transmittance(medium, p, d, begun, t, at, stream)
        begun = t
        near = t + CLEARANCE
        skip = face
    return kept


@walk_function()
def connect_straight(
    boundary: Any, medium: Any, state: Any, counts: Any, incident: Any, share: Any, ray: Any, stream: Any, value: Any
) -> None:
    """Add to value [D,3] what a scattering event receives from the directions incident [D,3], index-matched.

    `share` of the directions are looked at in turn from a random first one, each weighted by D / looked at.
    """
    count = incident.shape[0]
    looked = min(count, share)
    first = 0 if looked == count else int(uniform(stream) * count)
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        cosine = d[0] * w[0] + d[1] * w[1] + d[2] * w[2]
        kept = straight_transmittance(boundary, medium, p, w, counts[FACE], state[AT : AT + 3], ray, stream)
        weight = phase(cosine, medium.phase_g) * kept * count / looked
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight


@walk_function(inline="always")
def lobe_density(cosine: Any, kappa: Any) -> Any:
    """A von Mises–Fisher lobe per solid angle."""
    return kappa / (2.0 * math.pi * (1.0 - math.exp(-2.0 * kappa))) * math.exp(kappa * (cosine - 1.0))


@walk_function()
def draw_aim(w: Any, kappa: Any, v: Any, stream: Any) -> Any:
    """Draw a direction v of the lobe about w; returns the cosine between them."""
    cosine = 1.0 + math.log(1.0 - uniform(stream) * (1.0 - math.exp(-2.0 * kappa))) / kappa
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    angle = 2.0 * math.pi * uniform(stream)
    a, b = sine * math.cos(angle), sine * math.sin(angle)
    sx, sy, sz, tx, ty, tz = frame(w[0], w[1], w[2])
    v[0], v[1], v[2] = (
        a * sx + b * tx + cosine * w[0],
        a * sy + b * ty + cosine * w[1],
        a * sz + b * tz + cosine * w[2],
    )
    return cosine


@walk_function()
def _through_boundary(boundary: Any, face: Any, normal: Any, d: Any, w: Any) -> Any:
    """f |cos| of the rough interface between an eye path flying along d and light from w."""
    g = boundary.face_normals[face]
    outside = w[0] * g[0] + w[1] * g[1] + w[2] * g[2]
    if outside <= 0.0:
        return 0.0
    nx, ny, nz, eta = facing_normal(boundary, face, normal, d)
    sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
    oz = w[0] * nx + w[1] * ny + w[2] * nz
    from_inside = d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0
    if (oz < 0.0) != from_inside:
        return 0.0
    ix, iy = -(d[0] * sx + d[1] * sy + d[2] * sz), -(d[0] * tx + d[1] * ty + d[2] * tz)
    iz = -(d[0] * nx + d[1] * ny + d[2] * nz)
    ox, oy = w[0] * sx + w[1] * sy + w[2] * sz, w[0] * tx + w[1] * ty + w[2] * tz
    return rough_density(boundary.alpha, eta, ix, iy, iz, ox, oy, oz)


@walk_function()
def connect_at_surface(boundary: Any, state: Any, counts: Any, incident: Any, kappa: Any, ray: Any, value: Any) -> None:
    """Add to value [D,3] what the walk's arrival at a rough boundary receives; counts[FACE] is the face reached."""
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    for i in range(incident.shape[0]):
        w = incident[i]
        weight = _through_boundary(boundary, counts[FACE], state[NORMAL : NORMAL + 3], d, w)
        if weight <= 0.0:
            continue
        if state[PHASE] > 0.0:
            cosine = d[0] * w[0] + d[1] * w[1] + d[2] * w[2]
            weight *= state[PHASE] / (state[PHASE] + lobe_density(cosine, kappa))
        face, _t = nearest_hit(boundary.intersect, boundary.scene, ray, p, w, 0.0, np.inf, counts[FACE])
        if face < 0:
            for c in range(3):
                value[i, c] += state[THROUGHPUT + c] * weight


@walk_function()
def connect_aimed(
    boundary: Any,
    medium: Any,
    state: Any,
    counts: Any,
    incident: Any,
    share: Any,
    kappa: Any,
    ray: Any,
    aim: Any,
    stream: Any,
    value: Any,
) -> None:
    """Add to value [D,3] what a scattering event receives through the rough boundary, aimed by a lobe about each
    direction.

    `aim` is room for 9 numbers: the aimed direction, where it meets the boundary, and the normal there.
    """
    count = incident.shape[0]
    looked = min(count, share)
    first = 0 if looked == count else int(uniform(stream) * count)
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    v, q, normal = aim[0:3], aim[3:6], aim[6:9]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        cosine = draw_aim(w, kappa, v, stream)
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, v, 0.0, np.inf, counts[FACE])
        if face < 0:
            continue
        normal_at(boundary, face, np.float64(ray[15]), np.float64(ray[16]), normal)
        through = _through_boundary(boundary, face, normal, v, w)
        if through <= 0.0:
            continue
        g = boundary.face_normals[face]
        if v[0] * g[0] + v[1] * g[1] + v[2] * g[2] <= 0.0:
            continue
        for k in range(3):
            q[k] = p[k] + t * v[k]
        blocked, _t = nearest_hit(boundary.intersect, boundary.scene, ray, q, w, 0.0, np.inf, face)
        if blocked >= 0:
            continue
        scattered = phase(d[0] * v[0] + d[1] * v[1] + d[2] * v[2], medium.phase_g)
        kept = transmittance(medium, p, v, 0.0, t, state[AT : AT + 3], stream)
        weight = scattered * through * kept / (scattered + lobe_density(cosine, kappa)) * count / looked
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight
