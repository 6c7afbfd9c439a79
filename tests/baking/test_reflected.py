"""Reflected light that pictures lack: none for an index of 1, no second reflection on a convex body."""

import numpy as np
import pytest

from prt_bake.baking.report.reflected import noise_free_rms, reflected_at
from prt_bake.geometry.camera import Camera, Visibility, rays
from prt_bake.reflection.microfacet import fresnel, mirrored
from tests.shapes import ring
from tests.tracer.scenes import sphere

WHITE = np.ones((4, 8, 3), np.float32)


def seen(mesh, eye):
    """Faces, (u, v) and directions to the eye of the points that a camera sees."""
    view = Camera(np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]), 40.0, 24, 24)
    origins, towards = rays(view, slice(None), np.array([[0.5, 0.5]])).rows()
    hits = Visibility(mesh).first_hits(origins, towards)
    visible = hits.faces >= 0
    return hits.faces[visible], hits.barycentric[visible], -towards[visible]


def test_an_index_of_1_reflects_nothing() -> None:
    once, twice = reflected_at(ring(), WHITE, "y", 1.0, 0.2, *seen(ring(), [0.0, 2.0, 4.0]), 0)
    assert not once.any()
    assert not twice.any()


def test_a_polished_convex_body_reflects_once_by_fresnels_law() -> None:
    mesh = sphere(2)
    faces, barycentric, outgoing = seen(mesh, [0.0, 1.0, 4.0])
    once, twice = reflected_at(mesh, WHITE, "y", 1.5, 0.0, faces, barycentric, outgoing, 0)
    assert not twice.any()
    np.testing.assert_allclose(
        once[0, :, 0], fresnel((mesh.face_normals[faces] * outgoing).sum(axis=1), 1.5), rtol=1e-6
    )


def test_a_second_reflection_in_a_polished_ring_is_the_product_of_two_reflectances() -> None:
    mesh = ring()
    faces, barycentric, outgoing = seen(mesh, [0.0, 1.2, 4.0])
    once, twice = reflected_at(mesh, WHITE, "y", 1.5, 0.0, faces, barycentric, outgoing, 0)
    meets = twice[0].any(axis=1)
    assert 0.01 < meets.mean() < 0.6
    assert not once[0][meets].any()
    normals = mesh.face_normals[faces]
    towards = mirrored(outgoing, normals)
    corners = mesh.positions[mesh.faces[faces]]
    u, v = barycentric.T[..., None]
    places = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    hits = Visibility(mesh).first_hits(places[meets] + 1e-5 * normals[meets], towards[meets])
    first = fresnel((normals * outgoing).sum(axis=1)[meets], 1.5)
    second = fresnel(abs((mesh.face_normals[hits.faces] * towards[meets]).sum(axis=1)), 1.5)
    np.testing.assert_allclose(twice[0][meets, 0], first * second, rtol=1e-5)


def test_noise_of_half_buffers_does_not_count_as_light() -> None:
    draws = np.random.default_rng(1).normal(size=(2, 4000, 3))
    reference = np.ones((4000, 3))
    assert noise_free_rms(draws, reference) < 0.2
    assert noise_free_rms(0.5 + 0.1 * draws, reference) == pytest.approx(0.5, rel=0.02)
