"""Normals and roughness at points of a mesh equal those of the walk's kernels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from formats.errors import QueryError
from formats.image import write_image
from formats.mesh import Mesh
from prt_bake.reflection.finish import chosen_normals, interface_alpha, interface_normals, tilted_to_reflect
from prt_bake.reflection.microfacet import mirrored
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


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def random_points(mesh: Mesh, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(2)
    return generator.integers(0, len(mesh.faces), count), generator.dirichlet([1, 1, 1], count)[:, :2]


@pytest.mark.parametrize("kind", ["face", "vertex"])
def test_finish_equals_that_of_the_kernels(tmp_path: Path, kind: str) -> None:
    texture = np.random.default_rng(1).random((6, 9))
    write_image(tmp_path / "rough.exr", np.repeat(texture[..., None], 3, axis=2).astype(np.float32))
    scene = make_scene(tmp_path, with_uv(lumpy(3)), kind, eta=1.3, roughness="rough.exr")
    faces, barycentric = random_points(scene.mesh)
    normals, alpha = kernel_finish(prepare(scene).boundary, faces, barycentric)
    found = interface_normals(scene.mesh, faces, barycentric, scene.normals)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-12)
    # The kernels use float32 positions.
    np.testing.assert_allclose(found, normals, atol=1e-5)
    assert np.ptp(alpha) > 0.5
    np.testing.assert_allclose(interface_alpha(scene.mesh, faces, barycentric, scene.roughness), alpha, atol=1e-6)


@pytest.mark.parametrize("given", [None, "vertex", "face"])
def test_normals_of_a_flat_shaded_mesh_are_those_of_its_faces_by_default(given) -> None:
    mesh = lumpy(2)
    assert chosen_normals(mesh, given) == (given or "vertex")
    assert chosen_normals(replace(mesh, flat_shaded=True), given) == (given or "face")
    with pytest.raises(QueryError, match=r'normals: expected "vertex" or "face", found \'flat\''):
        chosen_normals(mesh, "flat")


def test_tilted_normals_reflect_the_eye_off_the_face_and_turn_no_more_than_needed() -> None:
    generator = np.random.default_rng(0)
    faces, outgoing, beside = (_unit(generator.normal(size=(5000, 3))) for _ in range(3))
    up = np.einsum("ni,ni->n", faces, outgoing)
    outgoing[up < 0.0] *= -1.0
    normals = _unit(faces + 0.9 * beside)
    tilted = tilted_to_reflect(normals, faces, outgoing)
    least = np.minimum(0.9 * np.abs(up), 0.01)
    changed = (tilted != normals).any(axis=1)
    assert 0.3 < changed.mean() < 0.7
    rise = np.einsum("ni,ni->n", mirrored(outgoing, tilted), faces)
    assert (rise >= least - 1e-9).all()
    np.testing.assert_allclose(rise[changed], least[changed], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1.0, rtol=1e-12)
    assert (np.einsum("ni,ni->n", tilted, outgoing) > 0.0).all()
    # The tilted normal lies between the given one and the one of the face.
    turn = np.einsum("ni,ni->n", np.cross(normals, faces), np.cross(normals, tilted))
    assert (turn[changed] > 0.0).all()


def test_a_face_seen_from_behind_keeps_its_normals() -> None:
    behind = tilted_to_reflect(np.array([[0.6, 0.0, 0.8]]), np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.6, -0.8]]))
    np.testing.assert_array_equal(behind, [[0.6, 0.0, 0.8]])


def test_a_single_roughness_holds_everywhere() -> None:
    mesh = lumpy(1)
    np.testing.assert_array_equal(interface_alpha(mesh, *random_points(mesh, 5), 0.3), np.full(5, 0.3))
