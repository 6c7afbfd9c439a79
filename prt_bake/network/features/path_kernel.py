"""The compiled search for the path of a view ray through meshes; see `view_path`."""

import math
from typing import Any

import numpy as np

from prt_bake.geometry.embree import nearest_hit, new_ray
from prt_bake.jit.compilation import compiled

_OPAQUE_DEPTH = 12.0
"""Optical depth after which a path ends: what lies behind it is not seen."""
_NEAR = 1e-5
"""Faces that the path enters nearer to x, in box sides, are those on which x lies."""
_APART = 1e-7
_SAME_INDEX = 1e-9
_SEGMENTS_AN_INTERFACE = 8
"""Room for segments: between two interfaces a path may cross matched bodies."""
_BEGIN, _END, _DEPTH, _START, _TOWARDS, _SEGMENT_SIZE = 0, 1, 2, 3, 6, 9
"""Columns of a segment: lengths of the path at its begin and end, optical depth at its end, start and direction."""


@compiled(nogil=True)
def path_rows(
    first: Any,
    last: Any,
    address: Any,
    scene: Any,
    tables: Any,
    most: Any,
    positions: Any,
    towards: Any,
    lengths: Any,
    points: Any,
    opacity: Any,
    leaving: Any,
) -> None:
    """Sets lengths [N,K], points [N,K,3], opacity [N] and leaving [N,3] of paths first … last − 1.

    They start at positions [N,3] on the surface along unit vectors towards [N,3], inside, and are bent or reflected at
    most `most` times. `tables` are `view_path.Tables`.
    """
    segments = np.empty((_SEGMENTS_AN_INTERFACE * (most + 1), _SEGMENT_SIZE))
    ray, p, d, normal = new_ray(), np.empty(3), np.empty(3), np.empty(3)
    for n in range(first, last):
        for k in range(3):
            p[k], d[k] = positions[n, k], towards[n, k]
            leaving[n, k] = d[k]
        count = _follow(address, scene, tables, most, ray, p, d, normal, segments, leaving[n])
        depth = segments[count - 1, _DEPTH] if count else 0.0
        opacity[n] = -math.expm1(-depth)
        _place(segments, count, positions[n], opacity[n], lengths[n], points[n])


@compiled(nogil=True)
def _follow(
    address: Any,
    scene: Any,
    tables: Any,
    most: Any,
    ray: Any,
    p: Any,
    d: Any,
    normal: Any,
    segments: Any,
    leaving: Any,
) -> int:
    """Fills `segments` of a path from p along d, and the direction in which it last leaves; returns their number.

    A face that is met from behind was reached from inside its body: this corrects the bodies that contain the path,
    where these touch, or where a ray slipped through an edge.
    """
    bodies, normals, _corners, media, eta, attenuation = tables
    inside, bent, count = 1, 0, 0
    length, depth, near, skip = 0.0, 0.0, 0.0, -1
    while bent <= most and count < len(segments) and depth < _OPAQUE_DEPTH:
        face, t = nearest_hit(address, scene, ray, p, d, near, np.inf, skip)
        if face < 0:
            break
        bit = 1 << bodies[face]
        leaves = d[0] * normals[face, 0] + d[1] * normals[face, 1] + d[2] * normals[face, 2] > 0.0
        before, behind = (inside | bit, inside & ~bit) if leaves else (inside & ~bit, inside | bit)
        if not leaves and bodies[face] == 0 and length + t < _NEAR:
            near = t + _APART
            continue
        here, there = media[before], media[behind]
        depth += attenuation[here] * t
        _append(segments, count, length, length + t, depth, p, d)
        count, length = count + 1, length + t
        for k in range(3):
            p[k] += t * d[k]
        ratio, inside = eta[here] / eta[there], behind
        if abs(ratio - 1.0) > _SAME_INDEX:
            bent += 1
            _facing_normal(tables, face, ray[15], ray[16], d, normal)
            if not _bend(ratio, normal, d):
                inside = before
        if media[inside] == 0:
            for k in range(3):
                leaving[k] = d[k]
        near, skip = 0.0, face
    return count


@compiled(nogil=True)
def _append(segments: Any, count: Any, begin: Any, end: Any, depth: Any, p: Any, d: Any) -> None:
    segment = segments[count]
    segment[_BEGIN], segment[_END], segment[_DEPTH] = begin, end, depth
    for k in range(3):
        segment[_START + k], segment[_TOWARDS + k] = p[k], d[k]


@compiled(nogil=True)
def _facing_normal(tables: Any, face: Any, u: Any, v: Any, d: Any, normal: Any) -> None:
    """The normal at (u, v) of a face on the side from which d comes, the face's own if that is on the other side."""
    _bodies, normals, corners, _media, _eta, _attenuation = tables
    ahead, across, squared = 0.0, 0.0, 0.0
    for k in range(3):
        normal[k] = (1.0 - u - v) * corners[face, 0, k] + u * corners[face, 1, k] + v * corners[face, 2, k]
        ahead += d[k] * normal[k]
        across += d[k] * normals[face, k]
        squared += normal[k] * normal[k]
    scale = 1.0 / math.sqrt(max(squared, 1e-30))
    for k in range(3):
        if ahead * across <= 0.0:
            normal[k], scale = normals[face, k], 1.0
        normal[k] *= -scale if across > 0.0 else scale


@compiled(nogil=True)
def _bend(ratio: Any, normal: Any, d: Any) -> Any:
    """Turn d by Snell's law at a facing normal; ratio: index before over behind. False if it is totally reflected."""
    cosine = -(d[0] * normal[0] + d[1] * normal[1] + d[2] * normal[2])
    squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    crosses = squared > 0.0
    scale, along = (ratio, ratio * cosine - math.sqrt(squared)) if crosses else (1.0, 2.0 * cosine)
    total = 0.0
    for k in range(3):
        d[k] = scale * d[k] + along * normal[k]
        total += d[k] * d[k]
    for k in range(3):
        d[k] /= math.sqrt(total)
    return crosses


@compiled(nogil=True)
def _place(segments: Any, count: Any, x: Any, opacity: Any, lengths: Any, points: Any) -> None:
    """Sets lengths [K] and points [K,3] from where light comes, equally probable; x where the path meets nothing."""
    at, before = 0, 0.0
    for k in range(len(lengths)):
        lengths[k] = 0.0
        points[k] = x
        if opacity <= 0.0:
            continue
        depth = -math.log1p(-(k + 0.5) / len(lengths) * opacity)
        while at + 1 < count and segments[at, _DEPTH] < depth:
            before = segments[at, _DEPTH]
            at += 1
        segment = segments[at]
        share = min(1.0, (depth - before) / max(segment[_DEPTH] - before, 1e-30))
        distance = share * (segment[_END] - segment[_BEGIN])
        lengths[k] = segment[_BEGIN] + distance
        for axis in range(3):
            points[k, axis] = segment[_START + axis] + distance * segment[_TOWARDS + axis]
