"""Tests of the paths of view rays through meshes."""

import pickle
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from formats.errors import ModelError
from formats.mesh import Mesh
from formats.mesh.geometry import face_normals
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.refraction import normals
from prt_bake.network.features.view_features import ViewFeatures
from prt_bake.network.features.view_path import (
    Body,
    PathSamples,
    ViewPath,
    known_paths,
    media_of_masks,
)
from prt_bake.trainer.train import train
from tests.shapes import ball
from tests.tracer.scenes import make_scene
from tests.trainer import small_training

REFLECTING = replace(
    PRESETS["measured"], features=20, width=16, light_features=4, lobes=0, shape_places=0, grid_places=0, light_places=0
)
SPACING = 0.02
RNG = np.random.default_rng(4)
Array = NDArray[np.float64]


def cube(attenuation: float = 0.0, eta: float = 1.5, inner: bool = False) -> Interior:
    """The grids of a unit cube; with `inner`, it contains a dense slab from z = 0.4 to 0.6."""
    at = -0.1 + SPACING * np.arange(61)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    depths = [np.minimum.reduce([x, 1 - x, y, 1 - y, z, 1 - z])]
    depths += [np.minimum(z - 0.4, 0.6 - z)] if inner else []
    levels = np.clip(np.rint(np.stack(depths) * (LEVELS / (REACH * SPACING))), -LEVELS, LEVELS).astype(np.int8)
    return Interior(levels, (-0.1, -0.1, -0.1), SPACING, (attenuation, 1e3)[: len(depths)], eta)


def view_of(interior: Interior, chosen: NetworkSettings = REFLECTING, torch_only: bool = False) -> ViewFeatures:
    frequencies = torch.from_numpy(np.random.default_rng(5).normal(size=(chosen.features, 6)))
    view = ViewFeatures(chosen, frequencies, interior)
    view.torch_only = torch_only
    return view


def box(low: Sequence[float], high: Sequence[float]) -> Body:
    mesh = trimesh.creation.box(bounds=np.array([low, high]))
    return Body(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def paths(
    bodies: list[Body], eta: list[float], attenuation: list[float], samples: int, most: int, parents: Sequence[int] = ()
) -> ViewPath:
    """Each body is in the one before, unless parents are given."""
    above = parents or range(-1, len(bodies) - 1)
    media = zip(bodies, above, eta, attenuation, strict=True)
    return ViewPath([b._replace(parent=p, eta=n, attenuation=a) for b, p, n, a in media], samples, most)


def mesh_of(body: Body) -> Mesh:
    """With normals that nothing should use: metadata decides."""
    return Mesh(body.positions, body.faces.astype(np.int32), np.tile([0.0, 0.0, 1.0], (len(body.positions), 1)))


UNIT = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def found(path: ViewPath, x: Array, towards: Array) -> tuple[Array, Array, Array, Array]:
    samples = path(torch.from_numpy(x), torch.from_numpy(-towards))
    lengths, points, opacity, leaving = (part.double().numpy() for part in samples)
    return lengths, points, opacity, leaving


def downwards(count: int, steep: float = 0.1) -> tuple[Array, Array]:
    """Points on the cube's top, and directions into it."""
    towards = RNG.normal(size=(count, 3))
    towards[:, 2] = -np.abs(towards[:, 2]) - steep
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return np.column_stack([RNG.uniform(0.1, 0.9, (count, 2)), np.ones(count)]), towards


def trapped(count: int) -> tuple[Array, Array]:
    """Points on the cube's top, and directions that meet all six walls beyond the critical angle of 41.8°."""
    towards = RNG.uniform(0.45, 0.7, (count, 3)) * RNG.choice([-1.0, 1.0], (count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    towards[:, 2] = -np.abs(towards[:, 2])
    x = RNG.uniform(0.1, 0.9, (count, 3))
    x[:, 2] = 1.0
    assert np.abs(towards).max() < np.cos(np.arcsin(1.0 / 1.5))
    return x, towards


def test_a_trapped_path_is_reflected_as_by_mirrors() -> None:
    """In a cube of mirrors paths are straight lines in unfolded space."""
    x, towards = trapped(200)
    lengths, points, opacity, _leaving = found(paths([UNIT], [1.5], [0.5], 20, 16), x, towards)
    straight = x[:, None] + lengths[..., None] * towards[:, None]
    np.testing.assert_allclose(points, np.abs((straight + 1.0) % 2.0 - 1.0), atol=2e-5)
    assert opacity.min() > 0.98
    assert lengths.max() > 5.0


def test_a_path_leaves_within_the_critical_angle_by_snells_law() -> None:
    x = np.tile([0.1, 0.1, 1.0], (3, 1))
    sines = np.array([0.0, 0.3, 0.6])
    towards = np.column_stack([sines * 0.6, sines * 0.8, -np.sqrt(1.0 - sines**2)])
    lengths, points, opacity, leaving = found(paths([UNIT], [1.5], [0.7], 5, 16), x, towards)
    outside = 1.5 * sines
    expected = np.column_stack([outside * 0.6, outside * 0.8, -np.sqrt(1.0 - outside**2)])
    np.testing.assert_allclose(leaving, expected, atol=1e-6)
    np.testing.assert_allclose(opacity, -np.expm1(-0.7 / -towards[:, 2]), rtol=1e-6)
    share = (np.arange(5) + 0.5) / 5 * opacity[:, None]
    np.testing.assert_allclose(lengths, -np.log1p(-share) / 0.7, rtol=1e-5)
    np.testing.assert_allclose(points, x[:, None] + lengths[..., None] * towards[:, None], atol=1e-6)


def test_nothing_is_reflected_where_the_index_inside_is_lower() -> None:
    x, towards = trapped(100)
    opacity = found(paths([UNIT], [0.7], [0.5], 4, 16), x, towards)[2]
    ahead = np.where(towards > 0.0, 1.0 - x, x) / np.abs(towards)
    np.testing.assert_allclose(opacity, -np.expm1(-0.5 * ahead.min(axis=1)), rtol=1e-5)


def test_a_slab_shifts_a_path_and_keeps_its_direction() -> None:
    """A slab of index 1.2 from z = 0.6 to 0.4 absorbs, the glass of index 1.5 around it does not."""
    x = np.array([[0.3, 0.5, 1.0]])
    towards = np.array([[0.4, 0.0, -np.sqrt(1.0 - 0.16)]])
    slab = box((-1.0, -1.0, 0.4), (2.0, 2.0, 0.6))
    lengths, points, opacity, leaving = found(paths([UNIT, slab], [1.5, 1.2], [0.0, 3.0], 8, 16), x, towards)
    sine = 0.4 * 1.5 / 1.2
    cosine = np.sqrt(1.0 - sine**2)
    np.testing.assert_allclose(opacity, -np.expm1(-3.0 * 0.2 / cosine), rtol=1e-5)
    np.testing.assert_allclose(leaving, [[0.6, 0.0, -0.8]], atol=1e-6)
    before = 0.4 / -towards[0, 2]
    inside = lengths[0] - before
    np.testing.assert_allclose(points[0, :, 0], 0.3 + 0.4 * before + sine * inside, atol=1e-5)
    np.testing.assert_allclose(points[0, :, 2], 0.6 - cosine * inside, atol=1e-5)


def test_matched_bodies_bend_nothing_and_do_not_count_as_interfaces() -> None:
    x, towards = trapped(50)
    inner = [box((0.2, 0.2, low), (0.8, 0.8, low + 0.1)) for low in (0.1, 0.4, 0.7)]
    plain = found(paths([UNIT], [1.5], [0.4], 6, 3), x, towards)
    matched = found(paths([UNIT, *inner], [1.5] * 4, [0.4] * 4, 6, 3, (-1, 0, 0, 0)), x, towards)
    for part, other in zip(plain, matched, strict=True):
        np.testing.assert_allclose(part, other, atol=2e-5)


def test_an_opaque_body_ends_a_path_in_the_mirror_image() -> None:
    """A path that meets a wall first sees the slab in it: light comes from the slab, not from behind the wall."""
    eye, x = np.array([[0.9, 0.0, np.sqrt(1.0 - 0.81)]]), np.array([[0.15, 0.5, 1.0]])
    normal = np.array([[0.0, 0.0, 1.0]])
    slab = box((-1.0, -1.0, 0.4), (2.0, 2.0, 0.6))
    path = paths([UNIT, slab], [1.5, 1.5], [0.0, 1e4], REFLECTING.ray_samples, 16)
    view = view_of(cube(inner=True))
    encoding = view.encode(*map(torch.from_numpy, (x, eye, normal)), path)
    np.testing.assert_allclose(encoding.points[0, :, 2], 0.6, atol=1e-3)
    inner = 0.6 / np.sqrt(1.0 - 0.36) * 0.4
    np.testing.assert_allclose(encoding.points[0, :, 0], inner - 0.15, atol=1e-3)


def _nearest(corners: Array, p: Array, d: Array) -> tuple[int, float]:
    """The nearest face [F,3,3] that a ray meets beyond 1e-6, and its distance (Möller and Trumbore 1997)."""
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    h = np.cross(d, c)
    scale = 1.0 / np.einsum("fk,fk->f", b, h)
    u = scale * ((p - a) @ np.eye(3) * h).sum(1)
    q = np.cross(p - a, b)
    v, t = scale * (q @ d), scale * (q * c).sum(1)
    t = np.where((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 1e-6), t, np.inf)
    return int(np.argmin(t)), float(t.min())


def _second_opinion(
    bodies: list[Body], eta: list[float], attenuation: list[float], x: Array, d: Array
) -> tuple[float, Array]:
    """Optical depth and last leaving direction of a path, by vectors instead of by components."""
    corners = np.concatenate([body.positions[body.faces] for body in bodies])
    owner = np.repeat(np.arange(len(bodies)), [len(body.faces) for body in bodies])
    index, density = {-1: 1.0, **dict(enumerate(eta))}, {-1: 0.0, **dict(enumerate(attenuation))}
    inside, depth, met, first, leaving = {0}, 0.0, 0, d, None
    while met <= 16 and depth < 12.0:
        face, t = _nearest(corners, x, d)
        if not np.isfinite(t):
            break
        here = max(inside, default=-1)
        depth, x = depth + density[here] * t, x + t * d
        n = np.cross(corners[face, 1] - corners[face, 0], corners[face, 2] - corners[face, 0])
        n /= np.linalg.norm(n)
        other = inside - {int(owner[face])} if d @ n > 0.0 else inside | {int(owner[face])}
        ratio = index[here] / index[max(other, default=-1)]
        across = d - (d @ n) * n
        met += ratio != 1.0
        if np.linalg.norm(ratio * across) < 1.0:
            d = ratio * across + np.sign(d @ n) * np.sqrt(1.0 - np.linalg.norm(ratio * across) ** 2) * n
            inside = other
        else:
            d = across - (d @ n) * n
        leaving = leaving if inside else d
    return depth, first if leaving is None else leaving


def test_a_second_implementation_finds_the_same_optical_depths() -> None:
    """Balls of other indices in a ball, one of them in another, from all sides; the object has a second ball aside."""
    shapes = [(0.5, 0.5, 0.5, 0.5), (0.6, 0.5, 0.5, 0.3), (0.65, 0.5, 0.5, 0.15), (0.2, 0.5, 0.5, 0.08)]
    bodies = []
    for *centre, radius in shapes:
        mesh = trimesh.creation.icosphere(2, radius)
        bodies.append(Body(np.asarray(mesh.vertices, np.float64) + centre, np.asarray(mesh.faces, np.int64)))
    aside = bodies[0].positions + np.array([1.05, 0.0, 0.0]), bodies[0].faces + len(bodies[0].positions)
    both = np.concatenate([bodies[0].positions, aside[0]]), np.concatenate([bodies[0].faces, aside[1]])
    bodies[0] = Body(*both)
    eta, attenuation = [1.5, 1.33, 1.1, 1.8], [0.3, 1.5, 6.0, 2.0]
    corners = bodies[0].positions[bodies[0].faces][::4]
    x = corners.mean(axis=1)
    towards = RNG.normal(size=x.shape)
    towards *= -np.sign((towards * face_normals(bodies[0].positions, bodies[0].faces)[::4]).sum(1, keepdims=True))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    _lengths, _points, opacity, leaving = found(paths(bodies, eta, attenuation, 4, 16, (-1, 0, 1, 0)), x, towards)
    opinions = [_second_opinion(bodies, eta, attenuation, *ray) for ray in zip(x, towards, strict=True)]
    expected, ahead = [depth for depth, _ in opinions], np.array([leaves for _, leaves in opinions])
    apart = np.abs(opacity + np.expm1(-np.array(expected))) + np.linalg.norm(leaving - ahead, axis=1)
    # Near the critical angle, or an edge, rounding decides.
    assert np.mean(apart < 1e-4) > 0.97
    assert np.std(expected) > 0.5


@pytest.mark.parametrize("top", [1.0, 1.2])
def test_bodies_that_reach_the_surface_are_seen(top: float) -> None:
    """The path begins in the body, whose upper face it does not meet: the lower one tells that it was inside."""
    x, towards = downwards(300)
    below = box((0.05, 0.05, 0.5), (0.95, 0.95, top))
    opacity = found(paths([UNIT, below], [1.5, 1.5], [0.0, 1e4], 4, 16), x, towards)[2]
    np.testing.assert_allclose(opacity, 1.0)


def test_a_body_ends_where_the_one_around_it_ends() -> None:
    """A rod from z = 0.1 to 0.9 in a slab from 0.4 to 0.6: it bends and absorbs nothing outside of the slab."""
    slab, rod = box((-1.0, -1.0, 0.4), (2.0, 2.0, 0.6)), box((0.2, 0.2, 0.1), (0.8, 0.8, 0.9))
    x, towards = np.array([[0.45, 0.5, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    clipped = found(paths([UNIT, slab, rod], [1.5, 1.5, 1.9], [0.0, 0.0, 2.0], 4, 16), x, towards)
    np.testing.assert_allclose(clipped[2], -np.expm1(-0.4), rtol=1e-5)
    loose = found(paths([UNIT, slab, rod], [1.5, 1.5, 1.9], [0.0, 0.0, 2.0], 4, 16, (-1, 0, 0)), x, towards)
    np.testing.assert_allclose(loose[2], -np.expm1(-1.6), rtol=1e-5)


def test_media_are_those_of_scenes() -> None:
    """The last body counts whose surroundings count, as `prt_bake.tracer.prepared` decides for parts."""
    media = media_of_masks([-1, 0, 1, 0])
    expected = {0: 0, 0b0001: 1, 0b0011: 2, 0b0111: 3, 0b0101: 1, 0b1111: 4, 0b1110: 0}
    assert {mask: int(media[mask]) for mask in expected} == expected


def test_a_wall_next_to_an_edge_is_met() -> None:
    """From just beside an edge a path soon meets the other wall from inside, and is reflected there."""
    x, towards = np.array([[1e-6, 0.5, 1.0]]), np.array([[-0.6, 0.0, -0.8]])
    _lengths, points, opacity, _leaving = found(paths([UNIT], [1.7], [3.0], 4, 16), x, towards)
    assert opacity[0] > 0.9
    assert (points[0, :, 0] >= -1e-5).all()


def test_calls_of_several_threads_agree() -> None:
    x, towards = trapped(500)
    path = paths([UNIT], [1.5], [0.5], 4, 16)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: found(path, x, towards), range(8)))
    for result in results[1:]:
        for part, other in zip(results[0], result, strict=True):
            np.testing.assert_array_equal(part, other)


def test_paths_bend_at_interpolated_normals() -> None:
    """On a coarse ball with the normals of its vertices a path runs as in a smooth ball."""
    mesh = trimesh.creation.icosphere(4, 0.5)
    positions, faces = np.asarray(mesh.vertices) + 0.5, np.asarray(mesh.faces)
    smooth = Body(positions, faces.astype(np.int64), 2.0 * (positions[faces] - 0.5))
    x, d = np.array([[0.5, 0.5, 1.0]]), np.array([[0.5, 0.1, -np.sqrt(1.0 - 0.26)]])
    leaving = [
        found(paths([body], [1.5], [0.1], 4, 16), x, d)[3] for body in (smooth, Body(positions, faces.astype(np.int64)))
    ]
    chord = x + 2.0 * ((0.5 - x) * d).sum() * d - 0.5
    n = chord / np.linalg.norm(chord)
    across = 1.5 * (d - (d * n).sum() * n)
    exact = across + np.sqrt(1.0 - (across**2).sum()) * n
    turned = found(paths([smooth._replace(corners=-2.0 * (positions[faces] - 0.5))], [1.5], [0.1], 4, 16), x, d)[3]
    np.testing.assert_allclose(turned, leaving[1], err_msg="normals of the faces where those of vertices look away")
    errors = [np.linalg.norm(ahead - exact) for ahead in leaving]
    assert errors[0] < 0.01 < errors[1]


def test_paths_are_pickled_copied_and_packed() -> None:
    x, towards = downwards(30)
    path = paths([UNIT], [1.5], [0.5], 4, 16)
    assert deepcopy(path) is path
    at = torch.from_numpy(x), torch.from_numpy(-towards)
    samples = path(*at)
    for part, other in zip(samples, pickle.loads(pickle.dumps(path))(*at), strict=True):
        assert torch.equal(part, other)
    again = known_paths(samples.packed())
    assert again is not None
    for part, other in zip(samples, again(*at), strict=True):
        assert torch.equal(part, other)
    assert PathSamples.unpacked(samples.packed()).points.shape == (30, 4, 3)
    assert known_paths(samples.packed()[:, :0]) is None


def test_a_network_follows_paths_on_its_mesh_alone() -> None:
    network = NeuralBSSRDF(REFLECTING, (0.0, 0.0, 0.0), 1.0, 1.0, {}, cube(0.5))
    mesh = mesh_of(UNIT)
    on_mesh = network.on(mesh)
    assert network.path is None
    assert on_mesh.path is not None
    x, towards = trapped(40)
    ratio = 1.5 * towards
    eye = np.column_stack([-ratio[:, :2], np.sqrt(np.maximum(1.0 - (ratio[:, :2] ** 2).sum(1), 1e-3))])
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    at = torch.from_numpy(x), torch.from_numpy(eye)
    encoding = on_mesh.encode_views(*at)
    assert encoding is not None
    normal = torch.tensor([0.0, 0.0, 1.0]).double().expand(40, 3)
    packed = on_mesh.packed_paths(*at, normal)
    again = network.view.encode(*at, normal, known_paths(packed.float())) if network.view is not None else None
    assert again is not None
    for part, other in zip(encoding, again, strict=True):
        torch.testing.assert_close(part, other, atol=1e-5, rtol=1e-5)
    assert network.packed_paths(*at, normal).shape == (40, 0)
    straight = network.view.encode(*at, normal) if network.view is not None else None
    assert straight is not None
    assert float((straight.points - encoding.points).abs().max()) > 0.3
    unbent = NeuralBSSRDF(replace(REFLECTING, interfaces=0), (0.0, 0.0, 0.0), 1.0, 1.0, {}, cube(0.5)).on(mesh)
    assert unbent.path is None


def test_torch_and_compiled_features_of_straight_rays_agree() -> None:
    outside = np.concatenate([RNG.uniform(0.1, 0.9, (50, 2)), np.ones((50, 1))], axis=1)
    eye = np.stack([RNG.normal(size=50), RNG.normal(size=50), RNG.uniform(0.05, 1.0, 50)], axis=1)
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    by_both = [
        view_of(cube(0.5, inner=True), torch_only=torch_only)(torch.from_numpy(outside), torch.from_numpy(eye))
        for torch_only in (False, True)
    ]
    assert float(((by_both[0] - by_both[1]).abs().amax(dim=1) < 1e-3).float().mean()) > 0.95


def test_normals_of_a_wall_are_exact() -> None:
    view = view_of(cube())
    at_walls = torch.tensor([[0.5, 0.5, 1.0], [0.0, 0.5, 0.5]])
    by_grid = normals(lambda points: view._inside(0, points), SPACING, at_walls)
    np.testing.assert_allclose(by_grid.numpy(), [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], atol=1e-6)


def test_a_negative_number_of_interfaces_is_refused() -> None:
    with pytest.raises(ModelError, match="ray_samples and interfaces must not be negative"):
        replace(REFLECTING, interfaces=-1)


def test_an_older_network_of_a_clear_object_is_refused() -> None:
    """Its rays were reflected in a coarse grid: it would give other values in silence."""
    values = REFLECTING.as_json()
    del values["interfaces"]
    assert NetworkSettings.from_json(values | {"ray_turns": 0}).interfaces == 0
    with pytest.raises(ModelError, match="followed in the meshes; train the model again"):
        NetworkSettings.from_json(values | {"ray_turns": 4})
    with pytest.raises(ModelError, match="interfaces needs tells_normal"):
        replace(REFLECTING, tells_normal=False)


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("eta", "sigma_t", "phase_g", "turns"),
    [(1.0, 0.5, 0.0, 0), (1.4, 0.5, 0.0, 64), (1.4, 1.9, 0.0, 64), (1.4, 2.1, 0.0, 0), (1.4, 3.0, 0.5, 64)],
)
def test_training_follows_paths_in_clear_refracting_objects(
    tmp_path: Path, eta: float, sigma_t: float, phase_g: float, turns: int
) -> None:
    """A ball of diameter 2 and albedo 0.9 is clear up to an optical depth of 4, without forward scattering."""
    scene = make_scene(tmp_path, ball(3), eta=eta, sigma_t=sigma_t, phase_g=phase_g, albedo=0.9)
    network = train(
        scene,
        steps=1,
        synchronous=True,
        settings=REFLECTING,
        stream=small_training.STREAM,
        learning=small_training.LEARNING,
    )
    assert network.settings.interfaces == turns
