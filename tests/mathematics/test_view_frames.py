"""Harmonics in view frames represent the same functions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.view_frames import mesh_view_frames, rotated
from tests.bakers.transports import icosphere

ROTATIONS = np.concatenate([
    np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])]),
    Rotation.random(40, random_state=1).as_matrix(),
    Rotation.from_euler("z", [[0.3], [2.0]]).as_matrix(),
    Rotation.from_rotvec(np.array([[1e-9, 0.0, 0.3], [np.pi - 1e-9, 0.0, 0.0]])).as_matrix(),
])  # fmt: skip


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 8])
def test_rotation_agrees_with_rotation_matrices(degree: int) -> None:
    """Identity, half turns about the axes, rotations about z or nearly z, and random ones."""
    coefficients = np.random.default_rng(degree).normal(size=(len(ROTATIONS), sh.count(degree), 2))
    expected = sh.rotations(ROTATIONS, degree) @ coefficients
    np.testing.assert_allclose(rotated(ROTATIONS, coefficients), expected, atol=1e-6 if degree else 0)
    np.testing.assert_allclose(rotated(ROTATIONS[:-2], coefficients[:-2]), expected[:-2], atol=1e-12)


def test_view_frame_has_the_normal_along_z_and_the_eye_in_the_xz_plane() -> None:
    mesh = icosphere(1)
    frames, vertices = mesh_view_frames(mesh), np.arange(42)
    outgoing = sphere.uniform(42, 3)
    outgoing *= np.sign(np.einsum("vi,vi->v", outgoing, mesh.normals))[:, None]
    outgoing[:2] = mesh.normals[:2]
    axes = frames.axes(vertices, outgoing)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    seen = np.einsum("vij,vj->vi", axes, outgoing)
    np.testing.assert_allclose(np.einsum("vij,vj->vi", axes, mesh.normals)[:, 2], 1.0)
    np.testing.assert_allclose(seen[:, 1], 0.0, atol=1e-12)
    assert (seen[2:, 0] > 0.0).all()
    np.testing.assert_allclose(axes[:2, 0], sphere.tangent_frame(mesh.normals)[:2], atol=1e-12)
    coefficients = np.random.default_rng(0).normal(size=(42, 9, 3))
    directions = sphere.uniform(42, 4)
    in_view = frames.in_view(vertices, outgoing, coefficients)
    there = sh.evaluate(np.einsum("vij,vj->vi", axes, directions), 2)
    expected = np.einsum("vk,vkc->vc", sh.evaluate(directions, 2), coefficients)
    np.testing.assert_allclose(np.einsum("vk,vkc->vc", there, in_view), expected, atol=1e-12)
    matrices = frames.matrices(vertices, outgoing, 9)
    np.testing.assert_allclose(matrices @ coefficients, in_view, atol=1e-12)
