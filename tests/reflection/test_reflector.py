"""Light reflected at the surface: white furnace, suns, mirrors, self-shadowing, multiple importance sampling."""

import math

import numpy as np
import pytest

from formats.errors import QueryError
from formats.mesh import Mesh, build_mesh
from formats.scene.lights import DirectionalLight
from prt_bake.geometry.camera import Visibility
from prt_bake.lights import environment
from prt_bake.lights.emitters import BrightSky, Disc
from prt_bake.lights.lighting import Lighting, Sky, solid_angle
from prt_bake.mathematics.sphere import tangent_frame, to_local, to_world
from prt_bake.reflection import reflector as reflection
from prt_bake.reflection import surface
from prt_bake.reflection.finish import SurfacePoints
from prt_bake.reflection.lights import SkySource
from prt_bake.reflection.microfacet import (
    fresnel,
    half_vectors,
    masking,
    mirrored,
    reflection_density,
    visible_facets,
)
from prt_bake.reflection.reflector import Reflector
from prt_bake.tracer.surface import boundary
from tests.mathematics.sampling import SphereCells, assert_mean_is
from tests.shading.reference import nearest_hits
from tests.shapes import ring
from tests.tracer.scenes import lumpy, moved, sphere, unit_directions

Array = np.ndarray
SAMPLES = 40_000
WHITE = Sky(np.ones((8, 16, 3), np.float32), "y", np.eye(3))


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return sphere(2)


@pytest.fixture(scope="module")
def patchy() -> Sky:
    """A rotated sky with dark, bright and black parts."""
    image = np.random.default_rng(1).random((16, 32, 3)).astype(np.float32) ** 4
    image[::2, 1::3] = 0.0
    return Sky(image, "z", environment.rotation(30.0, "y"))


def sun(direction: Array, diameter: float = 0.0, strength: float = 2.0) -> DirectionalLight:
    return DirectionalLight(direction / np.linalg.norm(direction), np.array([strength, 0.5 * strength, 0.0]), diameter)


def at(mesh: Mesh, cosine: float, count: int, seed: int = 0) -> SurfacePoints:
    """Random points seen at one cosine to their face, with alpha 0."""
    generator = np.random.default_rng(seed)
    faces = generator.integers(0, len(mesh.faces), count)
    barycentric = generator.dirichlet([1, 1, 1], count)[:, :2]
    return SurfacePoints(faces, barycentric, *views(mesh, faces, cosine, generator), np.zeros(count))


def views(mesh: Mesh, faces: Array, cosine: float, generator: np.random.Generator) -> tuple[Array, Array]:
    normals = mesh.face_normals[faces]
    across = np.cross(normals, unit_directions(len(faces), int(generator.integers(1 << 30))))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return normals, cosine * normals + math.sqrt(1 - cosine * cosine) * across


def one_view(mesh: Mesh, cosine: float, count: int) -> SurfacePoints:
    """The same point and view, many times."""
    return SurfacePoints._make(np.repeat(part, count, axis=0) for part in at(mesh, cosine, 1, seed=5))


def subset(points: SurfacePoints, chosen: object) -> SurfacePoints:
    return SurfacePoints._make(part[chosen] for part in points)


def reflect(reflector: Reflector, points: SurfacePoints, alpha: float, seed: int = 1) -> Array:
    count = len(points.faces)
    rough = points._replace(alpha=np.full(count, alpha))
    return reflector.reflected(rough, np.arange(count, dtype=np.uint64), seed)


def reflected_density(towards: Array, local: Array, alpha: float, eta: float) -> Array:
    """f(i, o) |o·n| in the local frame, 0 below the horizon."""
    facets, rough = half_vectors(towards, local), np.full(len(local), alpha)
    share = fresnel(np.clip((towards * facets).sum(axis=1), 0.0, 1.0), eta) * masking(local[:, 2], rough)
    return share * reflection_density(towards, facets, rough)


def albedo(alpha: float, eta: float, cosine: float, cells: SphereCells) -> float:
    """The directional albedo by quadrature."""
    towards = np.array([[math.sqrt(1 - cosine * cosine), 0.0, cosine]]).repeat(len(cells.directions), axis=0)
    return float(cells.integrate(reflected_density(towards, cells.directions, alpha, eta)).sum())


@pytest.mark.parametrize("eta", [1.4, 2.5, 1 / 1.4])
@pytest.mark.parametrize("cosine", [1e-3, 0.2, 0.9])
def test_white_furnace_gives_the_directional_albedo(ball: Mesh, eta: float, cosine: float) -> None:
    reflector = Reflector(ball, Lighting((WHITE,)), eta)
    cells = SphereCells(96, 96)
    for alpha in (0.2, 0.5, 1.0):
        radiance = reflect(reflector, at(ball, cosine, SAMPLES), alpha)
        assert_mean_is(radiance[:, 0], albedo(alpha, eta, cosine, cells))
        np.testing.assert_array_equal(radiance[:, 0], radiance[:, 2])
        # At most one full sample of each method: no fireflies.
        assert radiance.max() <= 2.0


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 3e-4, 1e-3])
@pytest.mark.parametrize("cosine", [0.05, 0.5, 1.0])
def test_narrow_lobes_reflect_like_a_mirror(ball: Mesh, patchy: Sky, alpha: float, cosine: float) -> None:
    """Up to second order in the lobe's width over the cosine and over a pixel of the sky."""
    where = at(ball, cosine, 4000)
    mirror = mirrored(where.outgoing, where.normals)
    expected = fresnel(np.full(4000, cosine), 1.5)[:, None] * patchy.radiance(mirror)
    radiance = reflect(Reflector(ball, Lighting((patchy,)), 1.5), where, alpha)
    if alpha == 0.0:
        np.testing.assert_allclose(radiance, expected, rtol=1e-9, atol=1e-12)
    else:
        error = (radiance - expected).std(axis=0) / math.sqrt(4000)
        bias = 10 * (alpha / cosine) ** 2 + alpha
        assert (np.abs((radiance - expected).mean(axis=0)) < 5 * error + bias * expected.mean()).all()


@pytest.mark.parametrize("alpha", [1e-4, 0.05, 0.4, 1.0])
def test_suns_without_size_are_exact(ball: Mesh, alpha: float) -> None:
    """f |o·n| E on the outer side of the face, without noise."""
    light = sun(np.array([0.3, 0.8, -0.2]))
    generator = np.random.default_rng(3)
    where = at(ball, 0.5, 2000)
    normals = where.normals
    outgoing = 2 * (normals @ light.direction)[:, None] * normals - light.direction
    # Near the mirror direction, so that narrow lobes are visible.
    outgoing += alpha * generator.normal(size=(2000, 3)) * 0.5
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    keep = (outgoing * normals).sum(axis=1) > 1e-3
    where = subset(where._replace(outgoing=outgoing), keep)
    tangents = tangent_frame(where.normals)
    towards = to_local(where.outgoing, where.normals, tangents)
    local = to_local(np.broadcast_to(light.direction, towards.shape), where.normals, tangents)
    expected = reflected_density(towards, local, alpha, 1.4)[:, None] * light.irradiance
    radiance = reflect(Reflector(ball, Lighting(suns=(light,)), 1.4), where, alpha)
    np.testing.assert_allclose(radiance, expected, rtol=1e-6, atol=1e-12)
    assert (expected[:, 0] > 0.0).mean() > 0.3
    mirror = reflect(Reflector(ball, Lighting(suns=(light,)), 1.4), where, 0.0)
    assert not mirror.any()


@pytest.mark.parametrize("diameter", [1e-5, 0.53, 30.0])
@pytest.mark.parametrize("alpha", [1e-3, 0.02, 0.3, 1.0])
def test_both_sampling_methods_and_their_combination_agree_on_suns(ball: Mesh, alpha: float, diameter: float) -> None:
    where = one_view(ball, 0.6, SAMPLES)
    normals, outgoing = where.normals, where.outgoing
    mirror = mirrored(outgoing[:1], normals[:1])[0]
    light = sun(mirror + 0.3 * alpha * np.cross(mirror, outgoing[0]), diameter, 1e5)
    radiance = reflect(Reflector(ball, Lighting(suns=(light,)), 1.4), where, alpha)[:, 0]
    tangents = tangent_frame(normals)
    towards = to_local(outgoing, normals, tangents)
    generator = np.random.default_rng(8)
    drawn, weight = Disc(light).draw(generator.random((SAMPLES, 3)))
    by_light = weight[:, 0] * reflected_density(towards, to_local(drawn, normals, tangents), alpha, 1.4)
    facets = visible_facets(towards, np.full(SAMPLES, alpha), generator.random((SAMPLES, 2)))
    local = mirrored(towards, facets)
    share = fresnel((towards * facets).sum(axis=1), 1.4) * masking(local[:, 2], np.full(SAMPLES, alpha))
    within = np.linalg.norm(to_world(local, normals, tangents) - light.direction, axis=1)
    chord = 2 * math.sin(math.radians(diameter) / 4)
    by_facets = share * (within <= chord) * 1e5 / solid_angle(light)
    if by_light.std() < by_light.mean() * 10:
        assert_mean_is(radiance - by_light, 0.0)
    if np.count_nonzero(by_facets) > 400:
        assert_mean_is(radiance - by_facets, 0.0)
    # With a sample of each method, the balance heuristic adds at most half the squared mean to the lower variance.
    better = min(by_light.var(), by_facets.var() if by_facets.any() else math.inf)
    assert radiance.var() <= better + 0.51 * radiance.mean() ** 2


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_a_patchy_sky_agrees_with_light_sampling_alone(ball: Mesh, patchy: Sky, alpha: float) -> None:
    where = one_view(ball, 0.4, 4 * SAMPLES)
    radiance = reflect(Reflector(ball, Lighting((patchy,)), 1.4), where, alpha)
    tangents = tangent_frame(where.normals)
    drawn, weight = BrightSky(patchy).draw(np.random.default_rng(2).random((4 * SAMPLES, 3)))
    local = to_local(drawn, where.normals, tangents)
    towards = to_local(where.outgoing, where.normals, tangents)
    by_light = weight * reflected_density(towards, local, alpha, 1.4)[:, None]
    for channel in range(3):
        assert_mean_is(radiance[:, channel] - by_light[:, channel], 0.0)
    assert radiance.std() < by_light.std()


def test_the_density_of_a_sky_is_that_of_its_samples(patchy: Sky) -> None:
    cells = SphereCells(128, 128)
    source = SkySource(patchy)
    assert cells.integrate(source.evaluate(cells.directions)[1]).sum() == pytest.approx(1.0, abs=2e-3)
    directions, weight, density = source.draw(np.random.default_rng(4).random((5000, 3)))
    np.testing.assert_allclose(weight * density[:, None], patchy.radiance(directions), rtol=1e-6, atol=1e-9)


def test_a_bright_pixel_makes_no_fireflies(ball: Mesh) -> None:
    image = np.full((32, 64, 3), 0.1, np.float32)
    image[9, 20] = 1e5
    reflector = Reflector(ball, Lighting((Sky(image, "y", np.eye(3)),)), 1.4)
    towards = environment.direction_of(20.5 / 64, 9.5 / 32)
    faces = np.full(SAMPLES, int(np.argmax(ball.face_normals @ towards)))
    normals, outgoing = views(ball, faces, 0.6, np.random.default_rng(5))
    where = SurfacePoints(faces, np.full((SAMPLES, 2), 0.3), normals, outgoing, np.zeros(SAMPLES))
    for alpha in (0.1, 1.0):
        radiance = reflect(reflector, where, alpha)[:, 0]
        assert radiance.std() < 5 * radiance.mean()


@pytest.mark.parametrize("mesh", [lumpy(2), ring()])
def test_the_object_shadows_its_own_reflections(mesh: Mesh) -> None:
    """A mirror under a white sky: Fresnel for unoccluded mirror rays, black for the others."""
    where = at(mesh, 0.35, 1500)
    faces, barycentric, normals, outgoing, _alpha = where
    radiance = reflect(Reflector(mesh, Lighting((WHITE,)), 1.4), where, 0.0)[:, 0]
    corners = mesh.positions[mesh.faces]
    u, v = barycentric[:, :1], barycentric[:, 1:]
    starts = (1 - u - v) * corners[faces, 0] + u * corners[faces, 1] + v * corners[faces, 2]
    rays = mirrored(outgoing, normals)
    blocked = np.array(
        [
            nearest_hits(np.delete(corners, f, axis=0), p, d[None])[0][0] >= 0
            for f, p, d in zip(faces, starts, rays, strict=True)
        ]
    )
    assert 0.02 < blocked.mean() < 0.98
    expected = np.where(blocked, 0.0, fresnel(np.array([0.35]), 1.4)[0])
    np.testing.assert_allclose(radiance, expected, atol=1e-9)


def test_occlusion_darkens_rough_reflections() -> None:
    """In a white furnace a hollow object reflects the unoccluded share of its albedo."""
    mesh = ring()
    where = at(mesh, 0.5, SAMPLES)
    open_sky = reflect(Reflector(sphere(1), Lighting((WHITE,)), 1.4), at(sphere(1), 0.5, SAMPLES), 0.5)
    hidden = reflect(Reflector(mesh, Lighting((WHITE,)), 1.4), where, 0.5)
    assert 0.5 < hidden.mean() / open_sky.mean() < 0.97


@pytest.mark.parametrize(("scale", "offset"), [(1e-4, 0.0), (1e5, 0.0), (1.0, 1e6)])
def test_scale_and_position_do_not_matter(scale: float, offset: float, patchy: Sky) -> None:
    mesh = lumpy(2)
    other = moved(mesh, scale, [offset, -offset, offset])
    where = at(mesh, 0.3, 3000)
    lighting = Lighting((patchy,), (sun(np.array([1.0, 1.0, 1.0])),))
    first, second = (reflect(Reflector(m, lighting, 1.4), where, 0.2) for m in (mesh, other))
    # A ray along an edge may hit or miss.
    assert np.isclose(first, second, rtol=1e-6, atol=1e-9).all(axis=1).mean() > 0.999


def test_neighbouring_faces_do_not_shadow_grazing_reflections() -> None:
    """A fine sphere seen at grazing: no ray hits the faces around its own."""
    mesh = sphere(4)
    where = at(mesh, 1e-5, 20_000)
    radiance = reflect(Reflector(mesh, Lighting((WHITE,)), 1.4), where, 0.0)
    assert (radiance > 0.9999).all()


def test_an_index_of_one_reflects_nothing_and_builds_nothing(ball: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(mesh: Mesh) -> Visibility:
        raise AssertionError("a tree was built")

    monkeypatch.setattr(reflection, "Visibility", refuse)
    reflector = Reflector(ball, Lighting((WHITE,)), 1.0)
    assert not reflect(reflector, at(ball, 0.5, 5), 0.3).any()
    with pytest.raises(AssertionError):
        Reflector(ball, Lighting((WHITE,)), 1.0001)
    with pytest.raises(QueryError, match="index of refraction above 0, found -1"):
        Reflector(ball, Lighting((WHITE,)), -1.0)


def test_reflection_near_an_index_of_one_is_quadratic(ball: Mesh) -> None:
    where = at(ball, 0.9, SAMPLES)
    one, two = (reflect(Reflector(ball, Lighting((WHITE,)), 1 + e), where, 0.2).mean() for e in (1e-3, 2e-3))
    assert two / one == pytest.approx(4.0, rel=0.01)
    assert one < 1e-6


def test_face_normals_replace_normals_that_face_away(ball: Mesh) -> None:
    where = at(ball, 0.3, 2000)
    reflector = Reflector(ball, Lighting((WHITE,)), 1.4)
    away = reflect(reflector, where._replace(normals=-where.outgoing), 0.3)
    np.testing.assert_array_equal(away, reflect(reflector, where, 0.3))


def test_mirror_rays_below_the_face_are_black() -> None:
    """At grazing views an interpolated normal can mirror the ray below the face, also without an occluder."""
    sheet = build_mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.0], [0.1, 1.0, 0.3]]), np.array([[0, 1, 2]]))
    where = at(sheet, 0.1, 2000)
    normals, outgoing = where.normals, where.outgoing
    leaning = normals - np.linspace(0.0, 0.12, 2000)[:, None] * outgoing
    leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
    seen = (leaning * outgoing).sum(axis=1) > 1e-9
    under = (mirrored(outgoing, leaning) * normals).sum(axis=1) <= 0.0
    assert 0.1 < (seen & under).mean() < 0.9
    radiance = reflect(Reflector(sheet, Lighting((WHITE,)), 1.4), where._replace(normals=leaning), 0.0)
    np.testing.assert_array_equal(radiance[:, 0] == 0.0, seen & under)


def test_an_eye_below_the_face_sees_no_reflection(ball: Mesh) -> None:
    where = at(ball, 0.3, 2000)
    below = where._replace(outgoing=-where.outgoing)
    for alpha in (0.0, 0.3):
        assert not reflect(Reflector(ball, Lighting((WHITE,)), 1.4), below, alpha).any()


def test_samples_depend_on_their_keys_and_the_seed_alone(ball: Mesh, patchy: Sky) -> None:
    reflector = Reflector(ball, Lighting((patchy, WHITE), (sun(np.ones(3), 2.0),)), 1.4)
    alpha = np.random.default_rng(6).random(1000) * 0.4
    alpha[::5] = 0.0
    where, keys = at(ball, 0.5, 1000)._replace(alpha=alpha), np.arange(1000, dtype=np.uint64) * np.uint64(7)
    radiance = reflector.reflected(where, keys, 3)
    some = slice(100, 900, 3)
    part = reflector.reflected(subset(where, some), keys[some], 3)
    np.testing.assert_array_equal(part, radiance[some])
    assert not np.array_equal(radiance, reflector.reflected(where, keys, 4))
    assert reflector.reflected(subset(where, slice(0)), keys[:0], 3).shape == (0, 3)


def test_limits_equal_those_of_the_walks() -> None:
    assert surface.SMOOTHEST == boundary.SMOOTHEST
    assert surface.SAME_INDEX == boundary.SAME_INDEX


def test_black_lights_reflect_nothing(ball: Mesh) -> None:
    dark = Lighting((Sky(np.zeros((4, 8, 3), np.float32), "y", np.eye(3)),), (sun(np.ones(3), 0.5, 0.0),))
    assert not reflect(Reflector(ball, dark, 1.4), at(ball, 0.5, 100), 0.3).any()
