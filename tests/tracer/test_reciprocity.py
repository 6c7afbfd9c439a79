"""Reciprocity of dielectrics that are not convex: Ŝ lacks the paths that are reflected first, and is whole with them.

Turned round, a path that enters at x, leaves, and is reflected once more elsewhere is one that is reflected first. Ŝ
counts the former and not the latter, so that ∫ Ŝ V (ωo·n)⁺ dA is not symmetric in ωi and ωo. With the paths that are
reflected at x and enter the object later it is. Both are taken over two caps of directions, so that smooth interfaces,
which no connection reaches, are held to it as well.

z-tests of false-alarm rate `significance.FALSE_ALARM` each.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numba import njit

from formats.mesh import Mesh, build_mesh
from formats.scene import Scene
from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.kernels import _take
from prt_bake.tracer.light_samples import walk_out
from prt_bake.tracer.prepared import prepare
from prt_bake.tracer.surface.boundary import next_face
from prt_bake.tracer.surface.embree import new_ray
from prt_bake.tracer.walk import (
    BEGUN,
    COUNTS_SIZE,
    DIRECTION,
    MASK,
    SKY,
    STATE_SIZE,
    THROUGHPUT,
    advance,
    begin,
    cross,
    goes_on,
)
from tests.mathematics.significance import assert_agree, largest_z, z_scores
from tests.tracer.scenes import make_scene, sphere
from tests.tracer.soundness import cap

SAMPLES = 480_000
MEDIUM: dict[str, Any] = {"sigma_t": 1.0, "albedo": [1.0, 0.9, 0.6], "phase_g": 0.3}
INTO, BEHIND = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
DEGREES = 70.0


def cup() -> Mesh:
    """A thin hollow ball, open towards +z: what the inside reflects mostly meets the inside again."""
    around = np.radians(np.linspace(-90.0, 30.0, 9))
    outside = np.stack([np.cos(around), np.sin(around)], axis=1)
    inside = 0.9 * outside[::-1]
    outside[0, 0] = inside[-1, 0] = 0.0
    turned = trimesh.creation.revolve(np.concatenate([outside, inside]), sections=24)
    return build_mesh(np.asarray(turned.vertices), np.asarray(turned.faces))


@njit
def reflected_first(boundary, media, queries, seed, exits, throughput):
    """Exits [N,3] and throughput [N,3] of walks that x reflects and that enter the object later; 0: of another kind."""
    keys, positions, outgoing, faces, barycentric = queries
    for n in range(len(keys)):
        ray, stream = new_ray(), np.zeros(2, np.uint64)
        state, counts = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64)
        begin_stream(stream, seed, keys[n], 0)
        begin(boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], 0)
        state[BEGUN] = 1.0
        alive = cross(boundary, state, counts, False, stream)
        alive = alive and counts[MASK] == 0
        entered = False
        while alive:
            event = advance(boundary, media, state, counts, ray, stream)
            if event == SKY:
                if entered:
                    exits[n] = state[DIRECTION : DIRECTION + 3]
                    throughput[n] = state[THROUGHPUT : THROUGHPUT + 3]
                break
            alive = _take(boundary, media, state, counts, event, stream)
            entered = entered or counts[MASK] != 0
            alive = alive and goes_on(boundary, state, counts, stream)


@njit
def visible(boundary, positions, faces, towards):
    """Whether the sky is seen from positions [N,3] on faces [N] in directions [N,3]."""
    seen = np.zeros(len(faces), np.bool_)
    for n in range(len(faces)):
        seen[n] = next_face(boundary, new_ray(), positions[n], towards[n], 0.0, np.inf, faces[n])[0] < 0
    return seen


def sent(scene: Scene, light: np.ndarray, eye: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """∫∫ dωi dωo ∫ V (ωo·n)⁺ dA over the caps about `light` and `eye`, of Ŝ [N,3] and of what x reflects first [N,3],
    a sample a row.
    """
    generator, mesh, prepared = np.random.default_rng(seed), scene.mesh, prepare(scene)
    areas = np.asarray(mesh.face_areas)
    faces = generator.choice(len(areas), SAMPLES, p=areas / areas.sum()).astype(np.int64)
    barycentric = generator.dirichlet([1.0, 1.0, 1.0], SAMPLES)[:, 1:]
    outgoing, keys = cap(eye, DEGREES, SAMPLES, seed + 500), np.arange(SAMPLES, dtype=np.uint64)
    cosine = np.sum(outgoing * np.asarray(mesh.face_normals)[faces], axis=1)
    kept = np.flatnonzero(cosine > 1e-6)
    faces, barycentric, outgoing, keys = faces[kept], barycentric[kept], outgoing[kept], keys[kept]
    corners = prepared.positions[prepared.faces[faces]]
    weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    queries = (keys, np.einsum("nk,nkc->nc", weights, corners), outgoing, faces, barycentric)
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(DEGREES)))
    weight = solid_angle * areas.sum() * cosine[kept] * visible(prepared.boundary, queries[1], faces, outgoing)
    entering = walk_out(scene, faces, barycentric, outgoing, keys, 1, seed)
    reflected, more = np.zeros((len(keys), 3)), np.zeros((len(keys), 3))
    reflected_first(prepared.boundary, prepared.medium, queries, seed + 1000, reflected, more)
    within = np.cos(np.radians(DEGREES))
    totals = np.zeros((2, SAMPLES, 3))
    totals[0, kept] = (weight * (entering.directions[:, 0] @ light > within))[:, None] * entering.throughput[:, 0]
    totals[1, kept] = (weight * (reflected @ light > within))[:, None] * more
    return totals[0], totals[1]


def averaged(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


@pytest.mark.parametrize("roughness", [0.0, 0.2])
def test_what_reflects_first_makes_a_hollow_dielectric_reciprocal(tmp_path: Path, roughness: float) -> None:
    scene = make_scene(tmp_path, cup(), **MEDIUM, eta=2.5, roughness=roughness)
    there, more_there = sent(scene, BEHIND, INTO, 1)
    back, more_back = sent(scene, INTO, BEHIND, 2)
    # Ŝ alone is far from it: seen from the hollow side more paths are reflected first.
    assert (z_scores(*averaged(back), *averaged(there)) > 2.0 * largest_z(3)).all()
    assert_agree(*averaged(there + more_there), *averaged(back + more_back))


def test_a_convex_dielectric_is_reciprocal_without(tmp_path: Path) -> None:
    """The same measure, where no path that x reflects can enter later."""
    scene = make_scene(tmp_path, askew(), **MEDIUM, eta=2.5, roughness=0.2)
    there, more_there = sent(scene, BEHIND, INTO, 1)
    back, more_back = sent(scene, INTO, BEHIND, 2)
    assert not more_there.any()
    assert not more_back.any()
    assert_agree(*averaged(there), *averaged(back))


def askew() -> Mesh:
    """A ball stretched askew, so that nothing but reciprocity makes both ways alike."""
    ball = sphere(2)
    stretched = np.asarray(ball.positions) @ np.array([[1.0, 0.3, 0.0], [0.0, 0.7, 0.2], [0.4, 0.0, 1.2]])
    return build_mesh(stretched, np.asarray(ball.faces))
