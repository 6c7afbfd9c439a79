"""Reciprocity of concave dielectrics: Ŝ excludes paths that are reflected first, and is reciprocal together with them.

Reversing a path that enters at x, leaves, and is reflected elsewhere gives a path that is reflected first. Ŝ counts the
former but not the latter, so ∫ Ŝ V (ωo·n)⁺ dA is not symmetric in ωi and ωo. Adding the paths that are reflected at x
and enter the object later makes it symmetric. Both are integrated over two caps of directions, which includes smooth
interfaces, where no connections exist.

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
from prt_bake.geometry.embree import new_ray
from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.kernels import sample_event
from prt_bake.tracer.light_samples import sample_exits
from prt_bake.tracer.prepared import prepare
from prt_bake.tracer.surface.boundary import next_face
from prt_bake.tracer.walk import (
    COUNTS_SIZE,
    DIRECTION,
    INITIAL,
    MASK,
    SKY,
    STATE_SIZE,
    THROUGHPUT,
    advance,
    begin,
    cross,
    survives_roulette,
)
from tests.mathematics.significance import assert_agree, largest_z, z_scores
from tests.tracer.scenes import make_scene, sphere
from tests.tracer.soundness import cap

pytestmark = pytest.mark.statistics

SAMPLES = 480_000
MEDIUM: dict[str, Any] = {"sigma_t": 1.0, "albedo": [1.0, 0.9, 0.6], "phase_g": 0.3}
INTO, BEHIND = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
DEGREES = 70.0


def cup() -> Mesh:
    """A thin hollow ball, open towards +z: light reflected inside mostly hits the inside again."""
    around = np.radians(np.linspace(-90.0, 30.0, 9))
    outside = np.stack([np.cos(around), np.sin(around)], axis=1)
    inside = 0.9 * outside[::-1]
    outside[0, 0] = inside[-1, 0] = 0.0
    turned = trimesh.creation.revolve(np.concatenate([outside, inside]), sections=24)
    return build_mesh(np.asarray(turned.vertices), np.asarray(turned.faces))


@njit
def reflected_first(boundary, media, queries, seed, exits, throughput):
    """Exits [N,3] and throughput [N,3] of walks that are reflected at x and enter the object later; 0 for others."""
    keys, positions, outgoing, faces, barycentric = queries
    for n in range(len(keys)):
        ray, stream = new_ray(), np.zeros(2, np.uint64)
        state, counts = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64)
        begin_stream(stream, seed, keys[n], 0)
        begin(boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], 0)
        state[INITIAL] = 1.0
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
            alive = sample_event(boundary, media, state, counts, event, stream)
            entered = entered or counts[MASK] != 0
            alive = alive and survives_roulette(boundary, state, counts, stream)


@njit
def visible(boundary, positions, faces, towards):
    """Whether directions [N,3] from positions [N,3] on faces [N] reach the sky."""
    result = np.zeros(len(faces), np.bool_)
    for n in range(len(faces)):
        result[n] = next_face(boundary, new_ray(), positions[n], towards[n], 0.0, np.inf, faces[n])[0] < 0
    return result


def transported(scene: Scene, light: np.ndarray, eye: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples of ∫∫ dωi dωo ∫ V (ωo·n)⁺ dA over the caps about `light` and `eye`: of Ŝ [N,3], and of the paths that are
    reflected first [N,3].
    """
    generator, mesh, prepared = np.random.default_rng(seed), scene.mesh, prepare(scene)
    areas = np.asarray(mesh.face_areas)
    faces = generator.choice(len(areas), SAMPLES, p=areas / areas.sum()).astype(np.int64)
    barycentric = generator.dirichlet([1.0, 1.0, 1.0], SAMPLES)[:, 1:]
    outgoing, keys = cap(eye, DEGREES, SAMPLES, seed + 500), np.arange(SAMPLES, dtype=np.uint64)
    cosine = np.sum(outgoing * np.asarray(mesh.face_normals)[faces], axis=1)
    visible_rows = np.flatnonzero(cosine > 1e-6)
    faces, barycentric, outgoing, keys = (
        faces[visible_rows],
        barycentric[visible_rows],
        outgoing[visible_rows],
        keys[visible_rows],
    )
    corners = prepared.positions[prepared.faces[faces]]
    weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    queries = (keys, np.einsum("nk,nkc->nc", weights, corners), outgoing, faces, barycentric)
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(DEGREES)))
    weight = solid_angle * areas.sum() * cosine[visible_rows] * visible(prepared.boundary, queries[1], faces, outgoing)
    entering = sample_exits(scene, faces, barycentric, outgoing, keys, 1, seed)
    reflected, reflected_throughput = np.zeros((len(keys), 3)), np.zeros((len(keys), 3))
    reflected_first(prepared.boundary, prepared.medium, queries, seed + 1000, reflected, reflected_throughput)
    within = np.cos(np.radians(DEGREES))
    totals = np.zeros((2, SAMPLES, 3))
    totals[0, visible_rows] = (weight * (entering.directions[:, 0] @ light > within))[:, None] * entering.throughput[
        :, 0
    ]
    totals[1, visible_rows] = (weight * (reflected @ light > within))[:, None] * reflected_throughput
    return totals[0], totals[1]


def mean_and_error(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


@pytest.mark.parametrize("roughness", [0.0, 0.2])
def test_concave_dielectric_is_reciprocal_with_paths_reflected_first(tmp_path: Path, roughness: float) -> None:
    scene = make_scene(tmp_path, cup(), **MEDIUM, eta=2.5, roughness=roughness)
    forward, forward_first = transported(scene, BEHIND, INTO, 1)
    backward, backward_first = transported(scene, INTO, BEHIND, 2)
    # Ŝ alone is not reciprocal: from the hollow side more paths are reflected first.
    assert (z_scores(*mean_and_error(backward), *mean_and_error(forward)) > 2.0 * largest_z(3)).all()
    assert_agree(*mean_and_error(forward + forward_first), *mean_and_error(backward + backward_first))


def test_convex_dielectric_is_reciprocal(tmp_path: Path) -> None:
    """No path that is reflected at x can enter a convex object later."""
    scene = make_scene(tmp_path, sheared_ball(), **MEDIUM, eta=2.5, roughness=0.2)
    forward, forward_first = transported(scene, BEHIND, INTO, 1)
    backward, backward_first = transported(scene, INTO, BEHIND, 2)
    assert not forward_first.any()
    assert not backward_first.any()
    assert_agree(*mean_and_error(forward), *mean_and_error(backward))


def sheared_ball() -> Mesh:
    """A sheared ball without symmetry between both directions."""
    ball = sphere(2)
    stretched = np.asarray(ball.positions) @ np.array([[1.0, 0.3, 0.0], [0.0, 0.7, 0.2], [0.4, 0.0, 1.2]])
    return build_mesh(stretched, np.asarray(ball.faces))
