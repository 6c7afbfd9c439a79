"""The self-test of a new asset: rows of radiance that a reader must reproduce.

Each row is there for faults of readers: an offset of one vertex, chunk, view bin, ring, sector, harmonic or channel,
the other handedness of the frame, a missed rule of the interpolation (docs/reference/asset.md, "Self-test").
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset import AssetHead
from prt_bake.mathematics import sh, sphere

Array = NDArray[np.float64]

LIGHTS = np.array([[2.0, 3.0, 6.0], [-6.0, 2.0, -3.0], [3.0, -6.0, 2.0]]) / 7.0
"""Directions of a red, a green and a blue light of irradiance 1."""
_GENERAL = np.array([[0.48, 0.36, 0.8], [-0.64, 0.6, 0.48], [-0.48, -0.6, 0.64], [0.6, -0.64, 0.48]])
"""One local direction in each quadrant of φ."""


def selftest_vertices(valid: NDArray[Any]) -> NDArray[np.int64]:
    """The first, the middle and the last of the vertices that were baked, [V] → at most [3], ascending."""
    baked = np.flatnonzero(valid)
    return np.unique(baked[[0, len(baked) // 2, -1]]) if len(baked) else baked


def selftest_views(rings: int, sectors: int) -> Array:
    """Local unit directions [11,3] to the eye, where readers go wrong.

    Four general ones; the normal, and half-way from it to the centre of ring 0; both sides of φ = 0, between the first
    two rings and beyond the centre of the last one; below the horizon.
    """
    near_pole, between, grazing, below = 1.0 - 0.25 / rings, 1.0 - 1.0 / rings, 0.25 / rings, -0.2
    before, after = -0.5 * math.pi / sectors, 0.5 * math.pi / sectors
    places = [
        (1.0, 0.0),
        (near_pole, 2.0),
        (between, before),
        (between, after),
        (grazing, before),
        (grazing, after),
        (below, 4.0),
    ]
    cosine, phi = np.array(places).T
    sine = np.sqrt(1.0 - cosine**2)
    return np.concatenate([_GENERAL, np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)])


def selftest(
    head: AssetHead, vertices: NDArray[np.int64], coefficients: NDArray[np.floating], folded: Array | None
) -> dict[str, NDArray[Any]]:
    """A light, vertices in some views, and their radiance; nothing without vertices.

    coefficients: [n,B,K,C] of the vertices [n]. folded: the light [K,3] of an asset of radiance. The radiance is
    interpolated between view bins and not clamped at 0.
    """
    if not len(vertices):
        return {}
    light = sh.evaluate(LIGHTS, head.degree).T if folded is None else folded[: sh.count(head.degree)]
    lit = coefficients.astype(np.float64) * (light if folded is None else 1.0)
    by_bin = np.broadcast_to(lit.sum(axis=2), (len(vertices), head.rings * head.sectors, 3))
    # Frames as a reader finds them in the file.
    normals, tangents = (each[vertices].astype(np.float32)[:, None] for each in (head.mesh.normals, head.tangents))
    outgoing = sphere.to_world(selftest_views(head.rings, head.sectors), normals, tangents)
    outgoing /= np.linalg.norm(outgoing, axis=-1, keepdims=True)
    bins, weights = sphere.bin_weights(
        sphere.to_local(outgoing, normals, tangents).reshape(-1, 3), head.rings, head.sectors
    )
    vertex = np.repeat(np.arange(len(vertices)), outgoing.shape[1])
    return {
        "light": light,
        "vertex": vertices[vertex],
        "outgoing": outgoing.reshape(-1, 3),
        "radiance": np.einsum("nm,nmc->nc", weights, by_bin[vertex[:, None], bins]),
    }
