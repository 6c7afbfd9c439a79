"""Reflection of baked assets: furnaces with and without a bounce, suns, mirrors, agreement with unbiased samples."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from formats.asset import Asset
from formats.errors import QueryError
from formats.mesh import Mesh, build_mesh
from formats.scene.lights import DirectionalLight
from prt_bake.geometry.camera import Hits, Visibility
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics import sh
from prt_bake.reflection.finish import SurfacePoints
from prt_bake.reflection.microfacet import fresnel, mirrored
from prt_bake.reflection.reflector import Reflector
from prt_bake.shading.picture import render_picture, shade
from prt_bake.shading.sun_shading import SunTreatment
from prt_bake.shading.surface_reflection import AssetReflection, reflects
from prt_bake.shading.visible_points import VisiblePoints
from tests.shading.test_picture import constant, front, make_asset
from tests.shapes import ring
from tests.tracer.scenes import lumpy, sphere

POINTS = 9
DARK = np.zeros((9, 3))


def glossy(mesh: Mesh, roughness=0.3, eta=1.5, sent=1.0) -> Asset:
    """An asset of the radiance `sent` in all directions under a white sky."""
    asset = make_asset(mesh, provenance={"eta": eta, "roughness": roughness})
    coefficients = np.zeros_like(asset.coefficients)
    coefficients[:, :, 0] = sent / math.sqrt(4 * math.pi)
    return dataclasses.replace(asset, coefficients=coefficients)


def white_weights() -> np.ndarray:
    weights = np.zeros((9, 3))
    weights[0] = math.sqrt(4 * math.pi)
    return weights


def patchy(seed=1) -> Sky:
    image = np.random.default_rng(seed).random((16, 32, 3)).astype(np.float32) ** 4
    return Sky(image, "y", environment.rotation(30.0, "y"))


def visible_points(mesh: Mesh, count: int, seed=0) -> VisiblePoints:
    """POINTS points of each of `count` pixels, seen from above their face."""
    generator = np.random.default_rng(seed)
    faces = np.repeat(generator.integers(0, len(mesh.faces), count), POINTS)
    barycentric = generator.dirichlet([1, 1, 1], len(faces))[:, :2]
    outgoing = mesh.face_normals[faces] + 0.7 * np.repeat(generator.normal(size=(count, 3)), POINTS, axis=0)
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    pixels, samples = np.divmod(np.arange(len(faces)), POINTS)
    return VisiblePoints(pixels, samples, faces, barycentric, outgoing)


def on_surface(mesh: Mesh, points: VisiblePoints, alpha: float) -> SurfacePoints:
    normals, rough = mesh.face_normals[points.faces], np.full(len(points.faces), alpha)
    return SurfacePoints(points.faces, points.barycentric, normals, points.outgoing, rough)


def keys(points: VisiblePoints) -> np.ndarray:
    return np.arange(len(points.faces), dtype=np.uint64)


def pixels(values: np.ndarray) -> np.ndarray:
    return values.reshape(-1, POINTS, 3).mean(axis=1)


@pytest.mark.parametrize("roughness", [0.0, 0.02, 0.3, 1.0])
def test_in_a_white_furnace_the_bounce_replaces_occluded_sky(roughness: float) -> None:
    """A ring as bright as the sky reflects its directional albedo."""
    mesh = ring()
    asset = glossy(mesh, roughness)
    white = Lighting((Sky(np.ones((8, 16, 3), np.float32), "y", np.eye(3)),))
    where = visible_points(mesh, 400)
    seen = Visibility(mesh)
    whole, without = (
        pixels(AssetReflection(asset, white, weights, seen, POINTS).radiance(where)[0])
        for weights in (white_weights(), DARK)
    )
    assert (without <= whole + 1e-12).all()
    assert (without < 0.9 * whole).any()

    class Free:
        def first_hits(self, _origins, rays):
            return Hits(np.full(len(rays), -1), np.zeros((len(rays), 2)))

    alone = AssetReflection(asset, white, DARK, Free(), POINTS).radiance(where)[0]
    np.testing.assert_allclose(whole, pixels(alone), rtol=1e-5, atol=1e-9)


def with_sun(sky: Sky) -> Sky:
    """The sky, 16 times as fine, with a sun of 1e5 in one pixel."""
    image = np.repeat(np.repeat(sky.image, 16, axis=0), 16, axis=1)
    image[90, 300] = 1e5
    return dataclasses.replace(sky, image=image)


def with_window(sky: Sky) -> Sky:
    """The sky with a bright pixel of 11 degrees, wider than most lobes, which counts as a sun."""
    image = sky.image.copy()
    image[4, 9] = 3e3
    return dataclasses.replace(sky, image=image)


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("sky", "most"),
    [(patchy(), 0.08), (with_sun(patchy()), 0.08), (with_window(patchy()), 0.15)],
    ids=["patchy", "sun", "window"],
)
@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.8])
def test_reflection_agrees_with_unbiased_samples_within_its_error(roughness: float, sky: Sky, most: float) -> None:
    """Without a bounce, as in path-traced pictures."""
    mesh = lumpy(2)
    asset, lighting = glossy(mesh, roughness), Lighting((sky,))
    where = visible_points(mesh, 300)
    seen = Visibility(mesh)
    ours, difference = AssetReflection(asset, lighting, DARK, seen, POINTS, normals="face").radiance(where)
    reflector, points = Reflector(mesh, lighting, 1.5, seen), on_surface(mesh, where, roughness)
    rounds = 120
    samples = [pixels(reflector.reflected(points, keys(where), seed)) for seed in range(rounds)]
    truth, noise = np.mean(samples, axis=0), np.var(samples, axis=0).sum() / rounds
    squared = ((pixels(ours) - truth) ** 2).sum()
    signal = (truth**2).sum()
    error = math.sqrt(max(0.0, squared - noise) / signal)
    predicted = math.sqrt((pixels(difference) ** 2).sum() / signal)
    assert error < most
    assert error < 1.3 * predicted < 6.0 * max(error, 0.01)
    assert pixels(ours).sum() == pytest.approx(truth.sum(), rel=max(0.02, error))


def test_a_sun_without_size_is_exact() -> None:
    mesh = sphere(2)
    sun = DirectionalLight(np.array([0.0, 0.6, 0.8]), np.array([3.0, 2.0, 1e5]), 0.0)
    where = visible_points(mesh, 200)
    lighting = Lighting((), (sun,))
    surface = AssetReflection(glossy(mesh), lighting, DARK, Visibility(mesh), POINTS, normals="face")
    ours, difference = surface.radiance(where)
    expected = Reflector(mesh, lighting, 1.5).reflected(on_surface(mesh, where, 0.3), keys(where), 0)
    np.testing.assert_allclose(ours, expected, rtol=1e-9)
    assert ours.any()
    assert not difference.any()


def test_a_mirror_reflects_the_exact_sky() -> None:
    mesh = sphere(2)
    lighting = Lighting((patchy(),), (DirectionalLight(np.array([0.0, 1.0, 0.0]), np.full(3, 2.0), 60.0),))
    where = visible_points(mesh, 200)
    surface = AssetReflection(glossy(mesh, 0.0), lighting, DARK, Visibility(mesh), POINTS, normals="face")
    normals, outgoing = mesh.face_normals[where.faces], where.outgoing
    towards = mirrored(outgoing, normals)
    expected = fresnel((outgoing * normals).sum(axis=1), 1.5)[:, None] * lighting.radiance(towards)
    above = ((outgoing * normals).sum(axis=1) > 1e-6) & ((towards * normals).sum(axis=1) > 1e-6)
    np.testing.assert_allclose(surface.radiance(where)[0][above], expected[above], rtol=1e-9, atol=1e-12)


def test_a_ray_that_hits_the_object_gets_its_radiance_along_the_ray() -> None:
    """A polished ring with view-dependent radiance, compared with `shade` for each hit."""
    mesh = ring()
    asset = dataclasses.replace(make_asset(mesh, rings=8, sectors=16), provenance={"eta": 1.5, "roughness": 0.0})
    asset.coefficients[:] *= np.random.default_rng(3).uniform(0.2, 2.0, asset.coefficients.shape[:2])[:, :, None, None]
    black = Lighting((Sky(np.zeros((2, 4, 3), np.float32), "y", np.eye(3)),))
    seen = Visibility(mesh)
    where = visible_points(mesh, 400).subset(slice(None, None, POINTS))
    faces, barycentric, outgoing = where.faces, where.barycentric, where.outgoing
    reflected = AssetReflection(asset, black, white_weights(), seen, 1, normals="face").radiance(where)[0]
    normals = mesh.face_normals[faces]
    towards = mirrored(outgoing, normals)
    corners = mesh.positions[mesh.faces[faces]]
    shares = np.concatenate([1 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    hits = seen.first_hits(np.einsum("nk,nki->ni", shares, corners) + 1e-5 * normals, towards)
    share = fresnel((outgoing * normals).sum(axis=1), 1.5)
    met = np.flatnonzero((hits.faces >= 0) & ((towards * normals).sum(axis=1) > 1e-3))
    assert len(met) > 20
    for n in met:
        at_vertices = shade(asset, white_weights(), np.broadcast_to(-towards[n], mesh.positions.shape))
        u, v = hits.barycentric[n]
        expected = np.array([1 - u - v, u, v]) @ at_vertices[mesh.faces[hits.faces[n]]]
        np.testing.assert_allclose(reflected[n], share[n] * expected, rtol=2e-3)


def test_reflection_is_invariant_under_a_common_rotation() -> None:
    turn = environment.rotation(50.0, "y")
    mesh = lumpy(2)
    turned = build_mesh(mesh.positions @ turn.T, mesh.faces)
    sky = patchy()
    where = visible_points(mesh, 200)
    still = AssetReflection(glossy(mesh), Lighting((sky,)), white_weights(), Visibility(mesh), POINTS)
    other = AssetReflection(
        glossy(turned), Lighting((sky,)).turned(50.0, "y"), white_weights(), Visibility(turned), POINTS
    )
    ours = pixels(still.radiance(where)[0])
    theirs = pixels(other.radiance(where._replace(outgoing=where.outgoing @ turn.T))[0])
    # A ray along a silhouette may hit in one case and miss in the other.
    assert (abs(ours - theirs).max(axis=1) < 1e-5).mean() > 0.98
    assert abs(ours - theirs).mean() < 1e-5


def test_reflection_is_linear_in_the_light() -> None:
    mesh = lumpy(2)
    asset, where = glossy(mesh), visible_points(mesh, 60)
    first, second = patchy(1), patchy(2)
    sun = DirectionalLight(np.array([0.6, 0.0, 0.8]), np.array([1e5, 1e4, 1.0]), 0.5)
    seen = Visibility(mesh)

    def reflected(*lights: Sky | DirectionalLight, weights: np.ndarray) -> np.ndarray:
        skies = tuple(light for light in lights if isinstance(light, Sky))
        suns = tuple(light for light in lights if isinstance(light, DirectionalLight))
        return AssetReflection(asset, Lighting(skies, suns), weights, seen, POINTS).radiance(where)[0]

    parts = [reflected(light, weights=DARK) for light in (first, second, sun)]
    together = reflected(first, second, sun, weights=DARK)
    np.testing.assert_allclose(together, sum(parts), rtol=1e-6, atol=1e-9)


def test_layers_sum_to_the_picture_and_an_index_of_1_reflects_nothing() -> None:
    mesh = ring()
    picture = render_picture(
        glossy(mesh), constant(), front(), reflection=True, layers=("radiance", "subsurface", "reflection")
    )
    layers = picture.layers
    np.testing.assert_allclose(layers["radiance"], layers["subsurface"] + layers["reflection"], atol=1e-6)
    assert layers["reflection"].max() > 0.03
    assert picture.reflects
    without = render_picture(glossy(mesh), constant(), front(), layers=("reflection",))
    assert not without.layers["reflection"].any()
    np.testing.assert_allclose(picture.image - without.image, layers["reflection"], atol=1e-6)
    matched = render_picture(glossy(mesh, eta=1.0), constant(), front(), reflection=True)
    assert not matched.reflects
    np.testing.assert_array_equal(matched.image, without.image)
    assert not reflects(glossy(mesh, eta=1.0))


def mirror_picture(mesh: Mesh, normals=None) -> np.ndarray:
    """The reflection of a sky that brightens towards +x in a mirror."""
    sky = np.tile(np.linspace(0.0, 1.0, 128, dtype=np.float32)[None, :, None], (64, 1, 3))
    sky = np.minimum(sky, sky[:, ::-1])
    options = {"reflection": True, "background": False, "samples": 2}
    return render_picture(glossy(mesh, 0.0, sent=0.0), sky, front(64, 64), normals=normals, **options).image


def test_reflections_are_smooth_by_default_whatever_normals_the_model_was_trained_with() -> None:
    """In the middle of a coarse ball the reflected gradient has no steps; on its facets it jumps."""
    steps = {}
    for kind in (None, "vertex", "face"):
        row = mirror_picture(sphere(2), kind)[32, 22:42, 0]
        steps[kind] = np.abs(np.diff(row, 2)).max() / row.mean()
    assert steps[None] == steps["vertex"] < 0.3 * steps["face"]


def test_a_box_and_a_flat_shaded_ball_reflect_by_their_faces() -> None:
    box = build_mesh(*((made := trimesh.creation.box()).vertices, made.faces))
    np.testing.assert_allclose(mirror_picture(box), mirror_picture(box, "face"), atol=1e-7)
    flat = dataclasses.replace(sphere(2), flat_shaded=True)
    np.testing.assert_array_equal(mirror_picture(flat), mirror_picture(flat, "face"))
    assert np.abs(mirror_picture(flat) - mirror_picture(flat, "vertex")).max() > 0.01


def test_a_surface_of_unknown_or_impossible_roughness_is_refused() -> None:
    asset = glossy(ring())
    bare = dataclasses.replace(asset, provenance={"eta": 1.5})
    with pytest.raises(QueryError, match="has no roughness"):
        render_picture(bare, constant(), front(), reflection=True)
    assert render_picture(bare, constant(), front(), reflection=True, roughness=0.2).reflects
    with pytest.raises(QueryError, match="a GGX alpha from 0 to 1"):
        render_picture(bare, constant(), front(), reflection=True, roughness=1.5)
    with pytest.raises(QueryError, match="finite index"):
        render_picture(
            dataclasses.replace(asset, provenance={"eta": -1.0, "roughness": 0.1}), constant(), front(), reflection=True
        )


def test_roughness_of_a_texture_is_local() -> None:
    mesh = sphere(3)
    left = mesh.positions[:, 0] < 0.0
    mesh = dataclasses.replace(mesh, uv=np.stack([np.where(left, 0.25, 0.75), np.full(len(left), 0.5)], axis=1))
    asset, sun = glossy(mesh), DirectionalLight(np.array([0.0, 0.6, 0.8]), np.ones(3), 0.0)

    def picture(roughness) -> np.ndarray:
        return render_picture(asset, Lighting((), (sun,)), front(), reflection=True, roughness=roughness).image

    mixed, smooth, rough = picture(np.array([[0.2, 0.6]])), picture(0.2), picture(0.6)
    equal = [(abs(mixed - uniform) <= 1e-6 * uniform).all(axis=2) for uniform in (smooth, rough)]
    assert (abs(smooth - rough).max(axis=2) > 1e-3).sum() > 100
    assert equal[0][:, :18].all()
    assert equal[1][:, 22:].all()
    with pytest.raises(QueryError, match="no texture coordinates"):
        render_picture(glossy(ring()), constant(), front(), reflection=True, roughness=np.array([[0.2, 0.6]]))
    unusable = np.where(left[:, None], np.nan, mesh.uv)
    damaged = glossy(dataclasses.replace(mesh, uv=unusable, corner_uv=None))
    with pytest.raises(QueryError, match="corners of faces have texture coordinates that are not finite"):
        render_picture(damaged, constant(), front(), reflection=True, roughness=np.array([[0.2, 0.6]]))
    assert render_picture(damaged, constant(), front(), reflection=True, roughness=0.2).reflects


@pytest.mark.parametrize("suns", ["split", "window", "plain"])
def test_rotating_the_light_equals_rotating_object_and_camera_back(suns: SunTreatment) -> None:
    """With a sky, a sun in it, a separate sun, and inter-reflection of the ring."""
    asset = make_asset(ring(), provenance={"eta": 1.5, "roughness": 0.3})
    sky = with_window(patchy())
    back = environment.rotation(-37.0, "y")
    light = Lighting((sky,), (DirectionalLight(np.array([0.6, 0.48, 0.64]), np.ones(3), 0.5),))
    about = light.turned(37.0, "y")
    turned = dataclasses.replace(
        asset,
        mesh=dataclasses.replace(
            asset.mesh, positions=asset.mesh.positions @ back.T, normals=asset.mesh.normals @ back.T
        ),
        tangents=asset.tangents @ back.T,
        coefficients=(sh.rotation(back, 2) @ asset.coefficients).astype(np.float32),
    )
    view = front()
    seen_back = dataclasses.replace(view, eye=back @ view.eye, target=back @ view.target)
    one = render_picture(asset, about, view, reflection=True, suns=suns)
    other = render_picture(turned, light, seen_back, reflection=True, suns=suns)
    assert one.coverage.sum() > 100.0
    np.testing.assert_allclose(other.image, one.image, rtol=1e-5, atol=1e-5 * one.image.mean())
