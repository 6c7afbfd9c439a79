"""Normals and roughness at points of a mesh equal those of the walk's kernels."""

from pathlib import Path

import numpy as np
import pytest
from numba import njit

from formats.image import write_image
from formats.mesh import Mesh
from prt_bake.reflection.finish import interface_alpha, interface_normals
from prt_bake.tracer.prepared import prepare
from prt_bake.tracer.surface.boundary import alpha_at, normal_at
from tests.tracer.scenes import lumpy, make_scene, with_uv


@njit
def kernel_finish(boundary, faces, barycentric):
    normals, alpha = np.empty((len(faces), 3)), np.empty(len(faces))
    for n in range(len(faces)):
        normal_at(boundary, faces[n], barycentric[n, 0], barycentric[n, 1], normals[n])
        alpha[n] = alpha_at(boundary, faces[n], barycentric[n, 0], barycentric[n, 1])
    return normals, alpha


def random_points(mesh: Mesh, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(2)
    return generator.integers(0, len(mesh.faces), count), generator.dirichlet([1, 1, 1], count)[:, :2]


@pytest.mark.parametrize("kind", ["face", "vertex"])
def test_finish_equals_that_of_the_kernels(tmp_path: Path, kind: str) -> None:
    texture = np.random.default_rng(1).random((6, 9))
    write_image(tmp_path / "rough.exr", np.repeat(texture[..., None], 3, axis=2).astype(np.float32))
    scene = make_scene(tmp_path, with_uv(lumpy(2)), kind, eta=1.3, roughness="rough.exr")
    faces, barycentric = random_points(scene.mesh)
    normals, alpha = kernel_finish(prepare(scene).boundary, faces, barycentric)
    found = interface_normals(scene.mesh, faces, barycentric, scene.normals)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-12)
    # The kernels use float32 positions.
    np.testing.assert_allclose(found, normals, atol=1e-5)
    assert np.ptp(alpha) > 0.5
    np.testing.assert_allclose(interface_alpha(scene.mesh, faces, barycentric, scene.roughness), alpha, atol=1e-6)


def test_face_normals_replace_vertex_normals_that_cancel() -> None:
    mesh = lumpy(1)
    normals = mesh.normals.copy()
    a, b, c = mesh.faces[0]
    normals[[a, b]] = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    cancelling = Mesh(mesh.positions, mesh.faces, normals)
    found = interface_normals(cancelling, np.array([0, 0]), np.array([[0.5, 0.0], [0.0, 1.0]]), "vertex")
    np.testing.assert_array_equal(found[0], mesh.face_normals[0])
    np.testing.assert_allclose(found[1], mesh.normals[c], rtol=1e-12)


def test_a_single_roughness_holds_everywhere() -> None:
    mesh = lumpy(1)
    np.testing.assert_array_equal(interface_alpha(mesh, *random_points(mesh, 5), 0.3), np.full(5, 0.3))
