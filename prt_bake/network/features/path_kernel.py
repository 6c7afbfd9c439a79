"""The compiled search for the path of a view ray through meshes; see `view_path`."""

import math
from typing import Any

import numpy as np

from prt_bake.geometry.embree import nearest_hit, new_ray
from prt_bake.jit.compilation import compiled
from prt_bake.mathematics.fresnel import fresnel

_DARK = math.exp(-12.0)
"""Share of the light of a view ray after which a branch of its path ends: what lies behind is not seen."""
_LEAST_BRANCH = 0.05
"""Share of the light of a view ray that a branch has at least where it begins."""
_NEAR = 1e-5
"""Faces that the path enters nearer to x, in box sides, are those on which x lies."""
_APART = 1e-7
_ALMOST_ALL = 1.0 - 1e-15
_SAME_INDEX = 1e-9
_SEGMENTS_AN_INTERFACE = 8
"""Room for segments: between two interfaces a path may cross matched bodies."""
_SHARE, _LENGTH, _START, _TOWARDS = 0, 1, 2, 5
"""Columns of branches and segments: the share of the view ray's light that comes from here on, the length of the path
so far, the point that it has reached, and its direction. Segments have those at their begin."""
_INSIDE, _BENT, _SKIP, _LEAVING, _BRANCH_SIZE = 8, 9, 10, 11, 14
"""Other columns of a branch: the bit mask of the bodies around it, how often it was bent, the face on which it is, and
the direction in which it left the object last."""
_REACH, _DEPTH, _LIGHT, _SEGMENT_SIZE = 8, 9, 10, 11
"""Other columns of a segment: its length, its optical depth, and the share of light from it and all segments before."""


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
    most `most[0]` times; `most[1]` branches are followed at most. `tables` are `view_path.Tables`.
    """
    segments = np.empty((_SEGMENTS_AN_INTERFACE * (most[0] + 1), _SEGMENT_SIZE))
    branches = np.empty((most[1] + 1, _BRANCH_SIZE))
    ray, normal = new_ray(), np.empty(3)
    for n in range(first, last):
        whole = branches[0]
        whole[_SHARE], whole[_LENGTH], whole[_INSIDE], whole[_BENT], whole[_SKIP] = 1.0, 0.0, 1, 0, -1
        for k in range(3):
            whole[_START + k] = positions[n, k]
            whole[_TOWARDS + k] = whole[_LEAVING + k] = towards[n, k]
        count = _follow(address, scene, tables, most, ray, normal, branches, segments)
        opacity[n] = segments[count - 1, _LIGHT] if count else 0.0
        leaving[n] = whole[_LEAVING : _LEAVING + 3]
        _place(segments, count, positions[n], opacity[n], lengths[n], points[n])


@compiled(nogil=True)
def _follow(
    address: Any, scene: Any, tables: Any, most: Any, ray: Any, normal: Any, branches: Any, segments: Any
) -> int:
    """Fills `segments` of the path that begins as the first of `branches`, branch by branch; returns their number.

    A face that is met from behind was reached from inside its body: this corrects the bodies that contain the path,
    where these touch, or where a ray slipped through an edge.
    """
    bodies, normals, _corners, media, eta, attenuation = tables
    number, begun, count = 0, 1, 0
    while number < begun:
        branch, near = branches[number], 0.0
        p, d = branch[_START : _START + 3], branch[_TOWARDS : _TOWARDS + 3]
        while branch[_BENT] <= most[0] and count < len(segments) and branch[_SHARE] >= _DARK:
            face, t = nearest_hit(address, scene, ray, p, d, near, np.inf, int(branch[_SKIP]))
            if face < 0:
                break
            inside, bit = int(branch[_INSIDE]), 1 << bodies[face]
            leaves = d[0] * normals[face, 0] + d[1] * normals[face, 1] + d[2] * normals[face, 2] > 0.0
            before, behind = (inside | bit, inside & ~bit) if leaves else (inside & ~bit, inside | bit)
            if not leaves and bodies[face] == 0 and branch[_LENGTH] + t < _NEAR:
                near = t + _APART
                continue
            here, there = media[before], media[behind]
            _advance(branch, t, attenuation[here] * t, segments, count)
            count += 1
            branch[_INSIDE], branch[_SKIP], near = behind, face, 0.0
            if abs(eta[here] / eta[there] - 1.0) > _SAME_INDEX:
                _facing_normal(tables, face, ray[15], ray[16], d, normal)
                rest = branches[begun]
                _split(eta[here] / eta[there], normal, before, behind, len(branches) > 2, branch, rest)
                begun += rest[_SHARE] >= _LEAST_BRANCH and begun < len(branches) - 1
            if media[int(branch[_INSIDE])] == 0:
                branch[_LEAVING : _LEAVING + 3] = d
        number += 1
    return count


@compiled(nogil=True)
def _advance(branch: Any, reach: Any, depth: Any, segments: Any, count: Any) -> None:
    """Sets segment `count`: a length and an optical depth from where a branch has got; moves the branch to its end."""
    segment = segments[count]
    segment[: _TOWARDS + 3] = branch[: _TOWARDS + 3]
    segment[_REACH], segment[_DEPTH] = reach, depth
    before = segments[count - 1, _LIGHT] if count else 0.0
    segment[_LIGHT] = before - branch[_SHARE] * math.expm1(-depth)
    branch[_SHARE] *= math.exp(-depth)
    branch[_LENGTH] += reach
    for k in range(3):
        branch[_START + k] += reach * branch[_TOWARDS + k]


@compiled(nogil=True)
def _split(ratio: Any, normal: Any, before: Any, behind: Any, both: Any, branch: Any, rest: Any) -> None:
    """Splits the light of a branch at an interface: the larger part stays in it, and `rest` gets the other one.

    ratio: index before over behind. Unless `both` are followed, all light is refracted where it can be.
    """
    d = branch[_TOWARDS : _TOWARDS + 3]
    cosine = min(1.0, -(d[0] * normal[0] + d[1] * normal[1] + d[2] * normal[2]))
    reflectance = fresnel(cosine, 1.0 / ratio)
    if not both and reflectance < 1.0:
        reflectance = 0.0
    branch[_BENT] += 1
    rest[:] = branch
    refracted, reflected = (branch, rest) if reflectance <= 0.5 else (rest, branch)
    along = ratio * cosine - math.sqrt(max(0.0, 1.0 - ratio * ratio * (1.0 - cosine * cosine)))
    _turn(refracted, 1.0 - reflectance, behind, ratio, along, normal)
    _turn(reflected, reflectance, before, 1.0, 2.0 * cosine, normal)


@compiled(nogil=True)
def _turn(branch: Any, part: Any, inside: Any, scale: Any, along: Any, normal: Any) -> None:
    """Gives a branch a part of its light, the bodies that contain it, and the direction scale·d + along·normal."""
    branch[_SHARE] *= part
    branch[_INSIDE] = inside
    total = 0.0
    for k in range(3):
        branch[_TOWARDS + k] = scale * branch[_TOWARDS + k] + along * normal[k]
        total += branch[_TOWARDS + k] ** 2
    for k in range(3):
        branch[_TOWARDS + k] /= math.sqrt(max(total, 1e-300))


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
def _place(segments: Any, count: Any, x: Any, opacity: Any, lengths: Any, points: Any) -> None:
    """Sets lengths [K] and points [K,3] from where light comes, equally probable; x where the path meets nothing."""
    at, before = 0, 0.0
    for k in range(len(lengths)):
        lengths[k] = 0.0
        points[k] = x
        if opacity <= 0.0:
            continue
        light = (k + 0.5) / len(lengths) * opacity
        while at + 1 < count and segments[at, _LIGHT] < light:
            before = segments[at, _LIGHT]
            at += 1
        segment = segments[at]
        depth = -math.log1p(-min((light - before) / segment[_SHARE], _ALMOST_ALL))
        distance = min(1.0, depth / max(segment[_DEPTH], 1e-30)) * segment[_REACH]
        lengths[k] = segment[_LENGTH] + distance
        for axis in range(3):
            points[k, axis] = segment[_START + axis] + distance * segment[_TOWARDS + axis]
