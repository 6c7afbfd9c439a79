"""Hits from the table of nearby faces agree with Embree."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from prt_bake.geometry.embree import nearest_hit, new_ray
from prt_bake.tracer.prepared import prepare
from prt_bake.tracer.surface.nearby_faces import nearby_hit
from tests.tracer.scenes import lumpy, make_scene, moved, slab, sphere, unit_directions

MESHES = {"sphere": moved(sphere(4), 0.5), "lumpy": lumpy(4), "flat": slab(1.0), "wide": slab(30.0)}
PLACES = 20_000


@njit
def _nearby_and_traced(boundary: Any, places: Any, along: Any, known: Any, traced: Any) -> None:
    ray = new_ray()
    for n in range(len(places)):
        face, t, u, v, inside = nearby_hit(boundary, places[n], along[n], -1)
        known[n, 0], known[n, 1], known[n, 2], known[n, 3], known[n, 4] = face, t, u, v, inside
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, places[n], along[n], 0.0, np.inf, -1)
        traced[n, 0], traced[n, 1], traced[n, 2], traced[n, 3] = face, t, ray[15], ray[16]


@pytest.mark.parametrize("name", MESHES)
def test_nearby_hits_agree_with_traced_rays(tmp_path: Path, name: str) -> None:
    scene = make_scene(tmp_path, MESHES[name], sigma_t=200.0)
    prepared = prepare(scene)
    generator = np.random.default_rng(1)
    faces = generator.integers(0, len(prepared.faces), PLACES)
    weights = generator.dirichlet([1, 1, 1], PLACES)
    depth = generator.uniform(1e-5, 0.02, PLACES)
    corners = prepared.positions[prepared.faces[faces]]
    normals = prepared.boundary.planes[faces, :3]
    places = np.einsum("nk,nkc->nc", weights, corners) - depth[:, None] * normals
    along = unit_directions(PLACES, 2)
    known, traced = np.zeros((PLACES, 5)), np.zeros((PLACES, 4))
    _nearby_and_traced(prepared.boundary, places, along, known, traced)

    hit, inside = known[:, 0] >= 0, known[:, 4] != 0
    assert hit.mean() > 0.15
    # Close to an edge float32 rays may hit the neighbouring face, at the same distance.
    assert (known[hit, 0] == traced[hit, 0]).mean() > 0.999
    np.testing.assert_allclose(known[hit, 1], traced[hit, 1], atol=2e-6)
    same = hit & (known[:, 0] == traced[:, 0])
    np.testing.assert_allclose(known[same, 2:4], traced[same, 2:4], atol=2e-3)
    # Rays hit nothing before the known clearance.
    assert (traced[~hit, 1] > known[~hit, 1] - 2e-6).all()
    through = hit & inside
    assert (np.einsum("nc,nc->n", along, prepared.boundary.planes[known[:, 0].astype(int), :3])[through] > 0.0).all()
