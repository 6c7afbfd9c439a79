"""Symmetries: reciprocity, and invariance under rotation.

z-tests at `significance.FALSE_ALARM` for all values of a test together.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.mesh import build_mesh
from formats.scene import Scene
from prt_bake import estimate_coefficients, estimate_transport
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import random_rotations
from tests.mathematics.significance import assert_agree
from tests.tracer.optical_depth import crossings
from tests.tracer.scenes import lumpy, make_scene, moved, queries, sphere, unit_directions

pytestmark = pytest.mark.statistics

GRIDS = np.random.default_rng(0)
SIGMA_T, ALBEDO = GRIDS.uniform(0.5, 6.0, (4, 5, 6)), GRIDS.uniform(0.5, 1.0, (3, 4, 3, 3))
BODIES: dict[str, tuple[Any, dict[str, Any]]] = {
    "matched, hollows": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.4}),
    "rough, convex": (
        sphere,
        {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": -0.3, "eta": 1.4, "roughness": 0.5},
    ),
    "rough, convex, below the outside's index": (
        sphere,
        {"sigma_t": 3.0, "albedo": [0.9, 0.7, 0.99], "eta": 0.8, "roughness": 0.6},
    ),
}


@pytest.mark.parametrize("body", BODIES)
def test_reciprocity(body: str, tmp_path: Path) -> None:
    """∫ Ŝ V (ωo·n)⁺ dA over the surface is symmetric in ωi and ωo."""
    shape, keys = BODIES[body]
    scene = make_scene(tmp_path, shape(2), **keys)
    pairs = unit_directions(6, 3).reshape(3, 2, 3)
    forward = [_transported(scene, light, eye, seed) for seed, (light, eye) in enumerate(pairs)]
    backward = [_transported(scene, eye, light, 10 + seed) for seed, (light, eye) in enumerate(pairs)]
    (mean, error), (other, other_error) = (
        map(np.array, zip(*direction, strict=True)) for direction in (forward, backward)
    )
    assert (error < 0.1 * mean).all()
    assert_agree(mean, error, other, other_error)


def _transported(scene: Scene, light: np.ndarray, eye: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """∫ Ŝ V (ωo·n)⁺ dA [3] and its standard error, from points spread over the surface."""
    positions, _, normals = queries(scene.mesh, 4000, seed)
    cosine = normals @ eye
    result = np.flatnonzero(cosine > 0.0)
    blocked = np.isfinite(crossings(scene, positions[result] + 1e-9 * normals[result], eye)).any(axis=1)
    result = result[~blocked]
    toward = np.repeat(eye[None], len(result), axis=0)
    values = estimate_transport(
        scene, positions[result], toward, np.repeat(light[None], len(result), axis=0), 12, seed
    ).mean
    area = float(np.sum(scene.mesh.face_areas))
    sent = np.zeros((len(positions), 3))
    sent[result] = area * cosine[result, None] * values
    return sent.mean(axis=0), sent.std(axis=0, ddof=1) / np.sqrt(len(sent))


ROTATED: dict[str, dict[str, Any]] = {
    "matched": {"sigma_t": 3.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.5},
    "rough": {"sigma_t": 2.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.3, "eta": 1.3, "roughness": 0.4},
    "smooth": {"sigma_t": 2.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.3, "eta": 1.3},
}


@pytest.mark.parametrize("kind", ROTATED)
def test_estimates_rotate_with_the_object(kind: str, tmp_path: Path) -> None:
    mesh, keys = lumpy(2), ROTATED[kind]
    rotation = random_rotations(1, 5)[0]
    (tmp_path / "turned").mkdir()
    scene = make_scene(tmp_path, mesh, **keys)
    rotated = make_scene(tmp_path / "turned", build_mesh(mesh.positions @ rotation.T, mesh.faces), **keys)
    positions, outgoing, _ = queries(mesh, 12, 2)
    incident = unit_directions(12, 3)
    if kind != "smooth":
        one = estimate_transport(scene, positions, outgoing, incident, 8_000, 1)
        two = estimate_transport(
            rotated, positions @ rotation.T, outgoing @ rotation.T, incident @ rotation.T, 8_000, 2
        )
        assert_agree(one.mean, one.standard_error, two.mean, two.standard_error)
    one = estimate_coefficients(scene, positions, outgoing, 2, 8_000, 1)
    two = estimate_coefficients(rotated, positions @ rotation.T, outgoing @ rotation.T, 2, 8_000, 2)
    harmonics = sh.rotation(rotation, 2)
    mean = np.einsum("jk,nkc->njc", harmonics, one.mean)
    # Upper bound of the errors of a rotated band.
    error = np.einsum("jk,nkc->njc", np.abs(harmonics), one.standard_error)
    assert_agree(mean, error, two.mean, two.standard_error)


def test_grid_axes_follow_the_axes_of_space(tmp_path: Path) -> None:
    """(x, y, z) → (y, z, x) for the mesh, [Z,Y,X] → [X,Z,Y] for the grids."""
    mesh = moved(lumpy(2), 1.0, [0.3, -0.2, 0.5])
    (tmp_path / "turned").mkdir()
    keys = {"phase_g": 0.5, "eta": 1.2, "roughness": 0.5}
    cyclic = [1, 2, 0]
    scene = make_scene(tmp_path, mesh, sigma_t=SIGMA_T, albedo=ALBEDO, **keys)
    rotated = make_scene(
        tmp_path / "turned",
        build_mesh(mesh.positions[:, cyclic], mesh.faces),
        sigma_t=SIGMA_T.transpose(2, 0, 1),
        albedo=ALBEDO.transpose(2, 0, 1, 3),
        **keys,
    )
    positions, outgoing, _ = queries(mesh, 12, 2)
    incident = unit_directions(12, 3)
    one = estimate_transport(scene, positions, outgoing, incident, 8_000, 1)
    two = estimate_transport(rotated, positions[:, cyclic], outgoing[:, cyclic], incident[:, cyclic], 8_000, 2)
    assert_agree(one.mean, one.standard_error, two.mean, two.standard_error)
