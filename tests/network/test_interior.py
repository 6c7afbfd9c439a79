"""Tests of a network's interior, of its storage, and of the features along view rays."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from torch import nn

from formats.errors import InputWarning, ModelError
from prt_bake.baking.bake import bake
from prt_bake.geometry.surface import Surface
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.view_features import ViewFeatures
from prt_bake.network.inference.pairs import content_hash
from prt_bake.trainer.train import train
from tests.network import WITHOUT_MESH
from tests.shapes import ball
from tests.trainer import small_training

RAY_SETTINGS = replace(
    PRESETS["measured"],
    features=20,
    width=16,
    light_features=4,
    interfaces=0,
    lobes=0,
    shape_places=0,
    grid_places=0,
    material_channels=0,
    light_places=0,
)
RNG = np.random.default_rng(3)


def full(attenuation: float = 3.0, eta: float = 1.0) -> Interior:
    """An interior that is inside everywhere."""
    return Interior(np.full((1, 2, 2, 2), LEVELS, np.int8), (-4.0, -4.0, -4.0), 8.0, (attenuation,), eta)


def half_space(attenuation: float = 3.0, eta: float = 1.0, spacing: float = 0.02) -> Interior:
    """An interior that is inside below z = ½."""
    z = -0.5 + spacing * np.arange(round(2.0 / spacing) + 1)
    column = np.clip(np.rint((0.5 - z) * LEVELS / (REACH * spacing)), -LEVELS, LEVELS).astype(np.int8)
    levels = np.broadcast_to(column, (1, 101, 101, len(z)))
    return Interior(levels, (-0.5, -0.5, -0.5), spacing, (attenuation,), eta)


def features(interior: Interior, chosen: NetworkSettings = RAY_SETTINGS) -> ViewFeatures:
    return ViewFeatures(chosen, torch.from_numpy(np.random.default_rng(5).normal(size=(chosen.features, 6))), interior)


def unit(count: int) -> torch.Tensor:
    vectors = RNG.normal(size=(count, 3))
    return torch.from_numpy(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def exact_mean(view: ViewFeatures, x: np.ndarray, eye: np.ndarray, back: np.ndarray, far: float) -> np.ndarray:
    """∫₀^far a·exp(−a s) exp(2πi G(x − s·back, ωo)) ds in closed form [N,F], over the opacity of a ray of 0.4."""
    g = view.frequencies.double().numpy()
    a = view.interior.attenuation[0]
    at_x = np.exp(2j * np.pi * (x @ g[:, :3].T + eye @ g[:, 3:].T))
    rate = a + 2j * np.pi * (back @ g[:, :3].T)
    return at_x * a / rate * (1.0 - np.exp(-rate * far)) / (1.0 - np.exp(-0.4 * a))


def complex_features(view: ViewFeatures, x: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """The Fourier features [N,F] of views as complex numbers."""
    found = view(torch.from_numpy(x), torch.from_numpy(eye)).numpy()
    count = len(view.frequencies)
    return np.asarray(found[:, :count] + 1j * found[:, count : 2 * count])


@settings(max_examples=20, deadline=None)
@given(arrays.arrays(np.int8, st.tuples(st.just(2), *[st.integers(2, 9)] * 3), elements=st.integers(-LEVELS, LEVELS)))
def test_packing_keeps_an_interior(levels: np.ndarray) -> None:
    interior = Interior(levels, (0.1, -0.2, 0.3), 0.25, (1e4, 0.0), 1.5)
    again = Interior.unpacked(json.loads(json.dumps(interior.as_json())), interior.packed())
    np.testing.assert_array_equal(again.levels, interior.levels)
    assert again.as_json() == interior.as_json()
    assert again.content_hash == interior.content_hash


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": [2, 2, 2]}, "places"),
        ({"places": [1, 4000, 4000, 4000]}, "places"),
        ({"places": [1, 2, 2, 3]}, "grids hold 8 bytes, expected 12"),
        ({"spacing": 0.0}, "spacing"),
        ({"corner": [0.0, float("nan"), 0.0]}, "finite"),
        ({"attenuation": [-1.0]}, "attenuation"),
    ],
)
def test_an_inconsistent_interior_is_refused(change: dict[str, object], message: str) -> None:
    interior = full()
    with pytest.raises(ModelError, match=message):
        Interior.unpacked(interior.as_json() | change, interior.packed())


def test_a_damaged_grid_is_refused_by_name(tmp_path: Path) -> None:
    network = NeuralBSSRDF(RAY_SETTINGS, interior=half_space())
    path = tmp_path / "model.pt"
    save_model(network, path)
    content = torch.load(path, weights_only=True)
    content["tensors"]["interior"] = content["tensors"]["interior"][:20]
    torch.save(content, path)
    with pytest.raises(ModelError, match=r"model\.pt: interior: its grid"):
        load_model(path)
    del content["tensors"]["interior"]
    torch.save(content, path)
    with pytest.raises(ModelError, match=r"model\.pt: network: an interior is needed if"):
        load_model(path)


@WITHOUT_MESH
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_file_restores_a_network_with_an_interior(tmp_path: Path, suffix: str) -> None:
    network = NeuralBSSRDF(RAY_SETTINGS, (-1.0, 0.0, 2.0), 3.0, 0.2, interior=half_space(eta=1.3))
    save_model(network, tmp_path / f"model{suffix}")
    again = load_model(tmp_path / f"model{suffix}")
    query = unit(6).numpy()[None].repeat(4, 0), RNG.uniform(-1, 3, (4, 3)), unit(4).numpy()
    np.testing.assert_array_equal(again.evaluate(*query), network.evaluate(*query))


@pytest.mark.parametrize("attenuation", [0.02, 3.0, 40.0])
def test_the_mean_along_the_ray_is_the_integral(attenuation: float) -> None:
    """Behind an interface, a quarter of the features are those of x itself."""
    view = features(full(attenuation), replace(RAY_SETTINGS, ray_samples=400))
    x, eye = RNG.random((30, 3)), unit(30).numpy()
    expected = exact_mean(view, x, eye, eye, min(4.0 / attenuation, 1.75))
    g = view.frequencies.double().numpy()
    expected[:, :5] = np.exp(2j * np.pi * (x @ g[:5, :3].T + eye @ g[:5, 3:].T))
    np.testing.assert_allclose(complex_features(view, x, eye), expected, atol=4e-3)


def test_points_outside_add_nothing() -> None:
    """A ray that enters a half space is averaged over its part inside; one that is never inside gives 0."""
    view = features(half_space(6.0, spacing=0.01), replace(RAY_SETTINGS, ray_samples=300, tells_normal=False))
    x = np.array([[0.5, 0.5, 0.8], [0.5, 0.5, 0.8]])
    eye = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    expected = exact_mean(view, np.array([[0.5, 0.5, 0.5]]), eye[:1], eye[:1], 4.0 / 6.0 - 0.3)
    found = complex_features(view, x, eye)
    np.testing.assert_allclose(found[0], expected[0], atol=0.03)
    np.testing.assert_array_equal(found[1], 0.0)


def test_rays_are_refracted_by_snells_law() -> None:
    """The features of x show the ray's direction: the refracted one, with sin θ / η to the normal."""
    eta = 1.4
    chosen = replace(RAY_SETTINGS, ray_samples=300, tells_normal=True)
    view = features(half_space(8.0, eta), chosen)
    angle = np.linspace(0.0, 1.5, 9)
    eye = np.stack([np.sin(angle), np.zeros(9), np.cos(angle)], axis=1)
    inner = np.stack([np.sin(angle) / eta, np.zeros(9), np.sqrt(1.0 - (np.sin(angle) / eta) ** 2)], axis=1)
    x = np.full((9, 3), 0.5) - [0.0, 0.0, 0.02]
    expected = exact_mean(view, x, eye, inner, 0.5)
    np.testing.assert_allclose(complex_features(view, x, eye)[:, 5:], expected[:, 5:], atol=0.02)
    found = view(torch.from_numpy(x), torch.from_numpy(eye)).numpy()
    np.testing.assert_allclose(found[:, 40:43] / 3.0, np.broadcast_to([0.0, 0.0, 1.0], (9, 3)), atol=1e-5)
    assert (np.abs(np.diff(found[:, 43:51], axis=0)).max(axis=1) > 0.1).all(), "the features of every angle differ"


def test_points_are_equally_probable_origins_of_light() -> None:
    """At the k-th point (k + ½)/K of the light comes from nearer points; rays that meet nothing have opacity 0."""
    view = features(half_space(5.0), replace(RAY_SETTINGS, tells_normal=False))
    x = torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.9]])
    eye = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    found = view(x, eye)[:, 40:].numpy()
    reach = 4.0 / 5.0
    for row, gap in ((0, 0.0), (2, 0.4)):
        opacity = 1.0 - np.exp(-5.0 * (reach - gap))
        wanted = (np.arange(12) + 0.5) / 12 * opacity
        np.testing.assert_allclose(found[row, :12] * reach / 2.0, gap - np.log(1.0 - wanted) / 5.0, atol=0.01)
        assert found[row, 12] * (1.0 - np.exp(-2.0)) == pytest.approx(opacity, abs=0.01)
    assert found[1, 12] < 0.05, "only that of the boundary, which the grid makes thick"


def test_a_ray_ends_in_an_opaque_body_inside() -> None:
    """Clear glass with an opaque block in it: all light along a ray comes from the block's face, or there is none."""
    levels = np.full((2, 51, 51, 51), -LEVELS, np.int8)
    levels[0] = LEVELS
    levels[1, 15:36, 15:36, 15:36] = LEVELS  # the boundary is halfway to the next node: 0.29 … 0.71
    view = features(Interior(levels, (0.0, 0.0, 0.0), 0.02, (0.0, 1e3), 1.0), replace(RAY_SETTINGS, tells_normal=False))
    x = torch.tensor([[0.5, 0.5, 0.0], [0.1, 0.5, 0.0]])
    eye = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    found = view(x, eye)[:, 40:53].numpy()
    np.testing.assert_allclose(found[0, :12] * 1.75 / 2.0, 0.29, atol=0.02)
    assert found[0, 12] == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_array_equal(found[1], 0.0)


def test_a_cavity_does_not_attenuate() -> None:
    """A clear block in a dense medium: the optical depth does not grow across it."""
    levels = np.full((2, 51, 51, 51), -LEVELS, np.int8)
    levels[0] = LEVELS
    levels[1, :, :, 15:36] = LEVELS
    interior = Interior(levels, (0.0, 0.0, 0.0), 0.02, (3.0, 0.0), 1.0)
    found = features(interior, replace(RAY_SETTINGS, tells_normal=False))(
        torch.tensor([[0.5, 0.5, 0.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    )
    opacity = float(found[0, 52]) * (1.0 - np.exp(-0.4 * 3.0))
    # Beyond the grid, values are clamped to the border: 1.75 of the ray less the block's 0.42.
    assert opacity == pytest.approx(1.0 - np.exp(-3.0 * (1.75 - 0.42)), abs=2e-3)
    lengths = found[0, 40:52].numpy() * 1.75 / 2.0
    assert not ((lengths > 0.31) & (lengths < 0.69)).any()


@pytest.mark.parametrize("eta", [0.7, 1.0, 1.5])
def test_torch_and_compiled_features_agree(eta: float) -> None:
    view = features(half_space(5.0, eta), replace(RAY_SETTINGS, shape_places=3))
    rng = np.random.default_rng(31)
    # Near the boundary, at ½, there is a normal on both sides.
    x = torch.from_numpy(rng.uniform(0, 1, (200, 3)) * [1.0, 1.0, 0.06] + [0.0, 0.0, 0.47])
    eye = nn.functional.normalize(torch.from_numpy(rng.normal(size=(200, 3))))
    kernel = view(x, eye)
    view.torch_only = True
    np.testing.assert_allclose(kernel.numpy(), view(x, eye).numpy(), atol=1e-4)


def test_autocast_does_not_round_the_phases() -> None:
    """Autocast rounds matrix products to eight bits; features must not be rounded."""
    view = features(half_space())
    plain = NeuralBSSRDF(replace(RAY_SETTINGS, ray_samples=0, tells_normal=False, low_axes=False))
    view.torch_only = True
    x, eye = torch.from_numpy(RNG.random((50, 3))), unit(50)
    for function in (view, plain.view_features, lambda x, eye: plain.light_features(eye)):
        exact = function(x, eye)
        with torch.autocast("cpu", torch.bfloat16):
            found = function(x, eye)
        np.testing.assert_array_equal(found.numpy(), exact.numpy())


@pytest.mark.parametrize("attenuation", [0.0, 1e-12, 1e5])
@pytest.mark.parametrize("eta", [0.5, 1.0, 2.5])
def test_extreme_views_have_finite_features(attenuation: float, eta: float) -> None:
    """Far outside, along the boundary, without a normal, through empty space and through opaque media."""
    for interior in (half_space(attenuation, eta), full(attenuation, eta)):
        view = features(interior, replace(RAY_SETTINGS, shape_places=2))
        x = torch.tensor([[0.5, 0.5, 0.5], [1e6, 0.0, 0.0], [-50.0, 2.0, 9.0], [0.0, 0.0, 0.0]])
        eye = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        for torch_only in (False, True):
            view.torch_only = torch_only
            found = view(x, eye)
            assert bool(found.isfinite().all())
            assert float(found.abs().max()) <= 1e3


def test_ray_settings_need_a_ray_and_an_interior() -> None:
    with pytest.raises(ModelError, match="tells_normal needs ray_samples"):
        NetworkSettings(tells_normal=True)
    with pytest.raises(ModelError, match="ray_samples needs light_layers"):
        NetworkSettings(ray_samples=3)
    with pytest.raises(ModelError, match="an interior is needed if ray_samples is above 0"):
        NeuralBSSRDF(RAY_SETTINGS)
    with pytest.raises(ModelError, match="an interior is needed if ray_samples is above 0"):
        NeuralBSSRDF(interior=full())


@WITHOUT_MESH
@pytest.mark.parametrize("kind", ["face", "vertex"])
def test_a_network_on_its_mesh_uses_the_normals_of_the_mesh(kind: str) -> None:
    """Within faces and at vertices, of the face that faces ωo most, as in the path tracer; off the mesh, the grid's."""
    mesh = ball(2)
    network = NeuralBSSRDF(
        replace(RAY_SETTINGS), (-1.0,) * 3, 2.0, metadata={"normals": kind}, interior=half_space(eta=1.3)
    )
    inside = mesh.positions[mesh.faces].mean(axis=1)[:40]
    rows = np.concatenate([inside, mesh.positions[:30], [[0.2, 0.1, 0.0]]])
    eye = rows / np.linalg.norm(rows, axis=1, keepdims=True) + 0.3 * unit(len(rows)).numpy()
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    location, cosines = Surface(mesh).choose(rows[:-1], eye[:-1])
    touching = [(mesh.faces == vertex).any(axis=1) for vertex in range(30)]
    facing = [(mesh.face_normals[faces] @ toward).max() for faces, toward in zip(touching, eye[40:70], strict=True)]
    np.testing.assert_allclose(cosines[40:], facing, atol=1e-12)
    expected = mesh.face_normals[location.faces]
    if kind == "vertex":
        u, v = location.barycentric.T[..., None]
        corners = mesh.normals[mesh.faces[location.faces]]
        expected = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    bound = network.on(mesh)
    found, plain = (
        each.view_features(torch.from_numpy(rows), torch.from_numpy(eye)).numpy() for each in (bound, network)
    )
    np.testing.assert_allclose(found[:-1, 40:43] / 3.0, expected, atol=2e-3)
    np.testing.assert_array_equal(found[-1], plain[-1])
    assert network.surface is None
    assert bound.hidden is network.hidden


def test_a_bake_uses_the_normals_of_its_mesh() -> None:
    mesh = ball(1)
    nodes = np.linalg.norm(np.indices((31, 31, 31)) * 0.04 - 0.6, axis=0)  # in box sides, as the spacing of 0.04
    levels = np.clip(np.rint((0.5 - nodes) * LEVELS / (REACH * 0.04)), -LEVELS, LEVELS)
    inside = Interior(levels[None].astype(np.int8), (-0.1, -0.1, -0.1), 0.04, (3.0,), 1.3)
    network = NeuralBSSRDF(RAY_SETTINGS, (-1.0,) * 3, 2.0, 0.1, {"eta": 1.3}, inside)
    asset = bake(network, mesh, rings=2, sectors=4, samples=16)
    bound = bake(network.on(mesh), mesh, rings=2, sectors=4, samples=16)
    np.testing.assert_array_equal(asset.coefficients, bound.coefficients)
    with pytest.warns(InputWarning, match="has no mesh to take them from"):
        prepared = network.prepared()
    without_mesh = bake(prepared, mesh, rings=2, sectors=4, samples=16)
    assert not np.array_equal(asset.coefficients, without_mesh.coefficients)


@pytest.mark.statistics
@pytest.mark.parametrize(("eta", "has_normal"), [(1.0, False), (1.3, True)])
def test_training_uses_normals_only_behind_an_interface(tmp_path: Path, eta: float, has_normal: bool) -> None:
    """The network in training uses its mesh; its file restores the same inputs."""
    scene = small_training.make_scene(tmp_path, eta, 0.3)
    network = train(
        scene,
        steps=2,
        synchronous=True,
        settings=RAY_SETTINGS,
        stream=small_training.STREAM,
        learning=small_training.LEARNING,
        output=tmp_path / "model.pt",
    )
    assert network.settings.tells_normal is has_normal
    assert (network.surface is not None) is has_normal
    assert network.view is not None
    assert network.view.interior.eta == eta
    again = load_model(tmp_path / "model.pt").on(scene.mesh)
    query = unit(6).numpy()[None].repeat(4, 0), scene.mesh.positions[:4], scene.mesh.normals[:4]
    np.testing.assert_array_equal(again.evaluate(*query), network.evaluate(*query))


def test_the_content_hash_depends_on_the_interior() -> None:
    """Otherwise a render of one network could be resumed with another."""
    one, other = (NeuralBSSRDF(RAY_SETTINGS, interior=half_space(attenuation)) for attenuation in (3.0, 4.0))
    assert content_hash(one) != content_hash(other)
    assert content_hash(one) == content_hash(NeuralBSSRDF(RAY_SETTINGS, interior=half_space(3.0)))
