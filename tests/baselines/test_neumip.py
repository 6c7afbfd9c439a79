"""NeuMIP: what it learns, its files, and that bakes take it as they take a network."""

from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from formats.errors import MeshError, ModelError, QueryError
from formats.mesh import Mesh, build_mesh, write_mesh
from formats.scene import Scene, read_scene
from prt_bake.baking.bake import bake
from prt_bake.baselines import BASELINES, NeuMIP, NeuMIPSettings, train_baseline
from prt_bake.baselines.neumip_training import LEARNING, NeuMIPLearner, own_loss, train_neumip
from prt_bake.baselines.texture_space import cover
from prt_bake.geometry.surface import Location, Surface
from prt_bake.importance.targets import gather_targets
from prt_bake.network.bssrdf import load_model, save_model
from prt_bake.trainer.samples.rows import Batch, Box, RowSource, SourceStatistics, build_batch
from tests.baselines.shapes import ball_of_charts, queries_on
from tests.trainer.small_training import SCENE, STREAM

Array = NDArray[np.float64]
SMALL = NeuMIPSettings(texels=16, seed=1)
LARGER = NeuMIPSettings(texels=48, seed=1)
FAST = replace(LEARNING, batch=256, rate=3e-2, coarse_steps=0, held_out_queries=64, held_out_walks=32)


def model_of(mesh: Mesh, settings: NeuMIPSettings = SMALL, **metadata: Any) -> NeuMIP:
    faces, uv = np.asarray(mesh.faces, np.int64), mesh.corner_uv
    assert uv is not None
    return NeuMIP(settings, mesh, [cover(uv, faces, size).space(uv, size) for size in settings.sizes], 0.5, metadata)


def known_transport(incident: Array, positions: Array, outgoing: Array) -> Array:
    """A smooth Ŝ [N,D,3] that varies over the ball, and tells light from above from light from below."""
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    albedo = 0.6 + 0.3 * np.sin(3.0 * normals)
    cosine = np.einsum("nj,ndj->nd", normals, incident)
    view = 0.7 + 0.3 * np.sum(normals * outgoing, axis=1)
    return np.asarray(albedo[:, None] * (0.5 + 0.4 * cosine)[..., None] * view[:, None, None])


class KnownRows(RowSource):
    """Rows of `known_transport` on a mesh: values, or exits drawn uniformly over the sphere."""

    def __init__(self, mesh: Mesh, exits: bool) -> None:
        self.mesh, self.exits, self.drawn = mesh, exits, 0
        low, high = mesh.bounds
        self.box = Box(low, float((high - low).max()))

    def views(self, count: int, seed: int) -> tuple[Array, Array, Array]:
        """Positions and outgoing [N,3], and incident [N,8,3]."""
        generator = np.random.default_rng(seed)
        faces, _barycentric, positions = queries_on(self.mesh, count, seed)
        outgoing = unit(generator.normal(size=(count, 3)))
        below = np.sum(outgoing * self.mesh.face_normals[faces], axis=1, keepdims=True) < 0.0
        return positions, np.where(below, -outgoing, outgoing), unit(generator.normal(size=(count, 8, 3)))

    def draw(self, count: int) -> Batch:
        self.drawn += 1
        positions, outgoing, incident = self.views(count, self.drawn)
        values = known_transport(incident, positions, outgoing)
        channels = 4.0 * np.pi * values if self.exits else values
        return build_batch(np.arange(count), positions, outgoing, incident, channels, self.box)

    def describe(self, number: int) -> str:
        return str(number)

    def statistics(self) -> SourceStatistics:
        return SourceStatistics(0, 0, 0.0)

    def state(self) -> dict[str, int]:
        return {}

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass


def unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def learned(mesh: Mesh, exits: bool, steps: int, settings: NeuMIPSettings = SMALL, published: bool = False) -> NeuMIP:
    """A model after `steps` on rows of the known transport."""
    uv = mesh.corner_uv
    assert uv is not None
    coverages = [cover(uv, np.asarray(mesh.faces, np.int64), size) for size in settings.sizes]
    source, generator = KnownRows(mesh, exits), np.random.default_rng(0)
    learner = NeuMIPLearner(model_of(mesh, settings), FAST, coverages, published)
    for step in range(steps):
        learner.learn(source, source.draw(FAST.batch), step / steps, generator)
    return learner.result()


def error_of(model: NeuMIP, mesh: Mesh) -> float:
    positions, outgoing, incident = KnownRows(mesh, False).views(1000, 1 << 20)
    expected = known_transport(incident, positions, outgoing)
    found = model.evaluate(incident, positions, outgoing)
    return float(np.sqrt(np.sum((found - expected) ** 2) / np.sum(expected**2)))


@pytest.fixture(scope="module")
def fitted() -> NeuMIP:
    """A model of the known transport on the ball, learned from values."""
    return learned(ball_of_charts(), False, 300)


def test_a_texture_that_holds_a_known_transport_gives_it_everywhere() -> None:
    mesh, settings = ball_of_charts(), NeuMIPSettings(texels=256, layers=1, width=6)
    model = model_of(mesh, settings)
    uv = mesh.corner_uv
    assert uv is not None
    texels = np.arange(256 * 256)
    column, line = (texels % 256 + 0.5) / 256, (texels // 256 + 0.5) / 256
    held = np.stack([column, line, column * line], axis=1)
    with torch.no_grad():
        for weights in model.parameters():
            weights.zero_()
        model.table[: len(texels), :3] = torch.from_numpy(held)
        hidden, output = model.decoder
        for channel in range(3):
            hidden.weight[channel, channel], hidden.weight[channel, -1] = 1.0, 1.0
            hidden.bias[channel], output.weight[channel, channel] = 1.0, 1.0
    faces, barycentric, positions = queries_on(mesh, 200)
    normal = unit(np.einsum("nc,ncj->nj", _weights(barycentric), mesh.corner_normals[faces]))
    at = np.einsum("nc,ncj->nj", _weights(barycentric), uv[faces])
    incident = unit(np.random.default_rng(1).normal(size=(200, 4, 3)))
    cosine = np.einsum("nj,ndj->nd", normal, incident)
    expected = 0.5 * (np.stack([*at.T, at.prod(axis=1)], axis=1)[:, None] + cosine[..., None] + 1.0)
    np.testing.assert_allclose(model.evaluate(incident, positions, mesh.face_normals[faces]), expected, atol=1e-4)


def _weights(barycentric: Array) -> Array:
    return np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)


def test_a_known_transport_is_learned_from_values(fitted: NeuMIP) -> None:
    assert error_of(fitted, ball_of_charts()) < 0.1


@pytest.mark.statistics
@pytest.mark.parametrize(("exits", "published"), [(True, False), (False, True)])
def test_a_known_transport_is_learned_from_exits_and_by_the_published_loss(exits: bool, published: bool) -> None:
    mesh = ball_of_charts()
    assert error_of(learned(mesh, exits, 200, published=published), mesh) < 0.15


def test_features_of_coarser_textures_are_added() -> None:
    mesh = ball_of_charts()
    model = model_of(mesh, replace(SMALL, levels=3))
    rows = [space.rows for space in model.spaces]
    assert len(model.table) == sum(rows)
    positions, outgoing, incident = KnownRows(mesh, False).views(20, 0)
    before = model.evaluate(incident, positions, outgoing)
    with torch.no_grad():
        model.table[:] = 0.0
        model.table[: rows[0], 0], model.table[-rows[2] :, 0] = 0.75, 0.25
        several = model.evaluate(incident, positions, outgoing)
        model.table[: rows[0], 0], model.table[-rows[2] :, 0] = 1.0, 0.0
    np.testing.assert_allclose(model.evaluate(incident, positions, outgoing), several, atol=1e-6)
    assert not np.allclose(before, several)


def test_a_trained_model_is_continuous_across_seams(fitted: NeuMIP) -> None:
    mesh = ball_of_charts()
    faces = np.asarray(mesh.faces)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    pairs = owner[order].reshape(-1, 2)
    charts = pairs // (len(faces) // 6)
    seams = charts[:, 0] != charts[:, 1]
    middles = mesh.positions[edges[order][::2]].mean(axis=1)[seams]
    centres = mesh.positions[faces].mean(axis=1)
    sides = [middles + 1e-3 * (centres[pairs[seams, side]] - middles) for side in (0, 1)]
    outgoing = unit(middles)
    incident = unit(np.random.default_rng(0).normal(size=(16, 3)))
    one, other = (fitted.evaluate(incident, side, outgoing) for side in sides)
    assert len(middles) == 72
    assert np.sqrt(np.mean((one - other) ** 2) / np.mean(one**2)) < 0.1


def test_light_from_above_and_its_mirror_image_from_below_are_told_apart(fitted: NeuMIP) -> None:
    mesh = ball_of_charts()
    faces, _barycentric, positions = queries_on(mesh, 50)
    normal = mesh.face_normals[faces]
    above, below = (fitted.evaluate(sign * normal[:, None], positions, normal) for sign in (1.0, -1.0))
    assert (above > 2.0 * below).mean() > 0.95


def test_frames_are_orthonormal_and_continuous_where_the_surface_and_the_chart_are() -> None:
    mesh = ball_of_charts()
    faces, _barycentric, positions = queries_on(mesh, 100)
    frame = model_of(mesh)._frames(Surface(mesh).locate(positions, mesh.face_normals[faces]))
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (100, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(frame[:, 2], unit(positions), atol=0.03)
    assert (np.linalg.det(frame) > 0.0).all()
    first, second = np.arange(36), np.arange(36) + 36  # the two triangles of each quad of a chart
    diagonal = [np.array([[0.0, 0.3]] * 36), np.array([[0.3, 0.0]] * 36)]
    one, other = (
        model_of(mesh)._frames(Location(side, place, np.zeros((36, 3))))
        for side, place in zip((first, second), diagonal, strict=True)
    )
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_the_published_loss_is_that_of_logarithms_and_a_tenth_of_l1() -> None:
    predicted, value = torch.tensor([[[0.5, -3.0, 0.0]]]), torch.tensor([[[1.0, 0.2, 0.0]]])
    logs = np.log1p(np.maximum(predicted.numpy(), -0.1)) - np.log1p(value.numpy())
    expected = np.mean(logs**2 + 0.1 * np.abs((predicted - value).numpy()))
    assert float(own_loss(predicted, value)[0]) == pytest.approx(expected, rel=1e-6)


def test_untouched_texels_keep_their_features_and_touched_ones_are_averaged() -> None:
    mesh = ball_of_charts()
    model = model_of(mesh)
    uv = mesh.corner_uv
    assert uv is not None
    before = model.table.detach().clone()
    source, generator = KnownRows(mesh, False), np.random.default_rng(0)
    learner = NeuMIPLearner(model, FAST, [cover(uv, np.asarray(mesh.faces, np.int64), 16)])
    for step in range(3):
        learner.learn(source, source.draw(8), step / 3, generator)
    touched = learner._touches > 0
    assert 0 < touched.sum() <= 3 * 8 * 4
    for table in (learner.network.table, learner.model.table):
        changed = (table.detach() != before).any(dim=1)
        assert not changed[~touched].any()
        assert changed[touched].all()


@pytest.mark.parametrize("suffix", ["pt", "safetensors"])
def test_a_file_gives_the_same_values(tmp_path: Path, suffix: str) -> None:
    mesh = ball_of_charts()
    model = model_of(mesh, replace(SMALL, levels=2), unit="cm", up="y").rounded()
    path = tmp_path / f"m.{suffix}"
    save_model(model, path)
    loaded = load_model(path, mesh=mesh)
    positions, outgoing, incident = KnownRows(mesh, False).views(40, 0)
    np.testing.assert_array_equal(
        loaded.evaluate(incident, positions, outgoing), model.evaluate(incident, positions, outgoing)
    )
    assert loaded.metadata == {"unit": "cm", "up": "y"}
    assert loaded.kind == "neumip"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("table", lambda table: table[:-1], r"m.pt: expected a table of \d+ x 7 features"),
        ("decoder.0.bias", lambda bias: bias[:-1], r"m.pt: .*tensor decoder.0.bias has shape \(24,\)"),
        ("faces", None, r"m.pt: tensor faces is missing"),
    ],
)
def test_files_that_do_not_fit_are_refused(tmp_path: Path, name: str, change: Any, message: str) -> None:
    save_model(model_of(ball_of_charts()), tmp_path / "m.pt")
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    if change is None:
        del content["tensors"][name]
    else:
        content["tensors"][name] = change(content["tensors"][name]).clone()
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(ModelError, match=message):
        load_model(tmp_path / "m.pt")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"kind": "neumip"',
            '"kind": "tensors"',
            "a model of the kind 'tensors'; expected one of neural bssrdf, neumip",
        ),
        ('"texels": 16', '"texels": 1.5', "NeuMIP settings: texels: expected int, found 1.5"),
        ('"texels": 16', '"texels": 1', "NeuMIP settings: texels: expected 2 to 16384, found 1"),
        ('"texels": 16', '"rows": 16', "NeuMIP settings: rows: known are texels"),
    ],
)
def test_descriptions_that_do_not_fit_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    save_model(model_of(ball_of_charts()), tmp_path / "m.pt")
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    assert old in content["prtbake"]
    content["prtbake"] = content["prtbake"].replace(old, new)
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(ModelError, match=message):
        load_model(tmp_path / "m.pt")


def test_another_object_and_places_off_the_surface_are_refused() -> None:
    mesh = ball_of_charts()
    model = model_of(mesh)
    larger = replace(mesh, positions=1.01 * mesh.positions)
    with pytest.raises(QueryError, match=r"found 218 of 218 vertices off it; the first, number 0, is 0\.01 away"):
        model.refuse_foreign(larger)
    with pytest.raises(QueryError, match="positions: expected points within"):
        model.evaluate([[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.5]], [[0.0, 0.0, 1.0]])
    assert model.on(mesh) is model


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A scattering ball with texture coordinates."""
    mesh = ball_of_charts()
    write_mesh(mesh, tmp_path / "ball.obj")
    (tmp_path / "scene.toml").write_text(SCENE.format(eta=1.0, roughness=0.0).replace("ball.ply", "ball.obj"))
    return read_scene(tmp_path / "scene.toml")


@pytest.mark.statistics
def test_a_trained_model_is_baked_as_a_network_is(scene: Scene, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"settings": LARGER, "stream": STREAM, "learning": FAST, "seed": 1}
    model = train_neumip(scene, steps=200, synchronous=True, output=tmp_path / "m.pt", **arguments)
    training = model.metadata["training"]
    assert training["steps"] == 200
    assert training["relative_rmse"]["coefficients"] < 0.5
    asset = bake(load_model(tmp_path / "m.pt"), scene.mesh, rings=1, sectors=4, samples=18)
    assert np.isfinite(asset.coefficients).all()
    mean = np.asarray(asset.coefficients)[..., 0, :].mean(axis=(0, 1))
    assert (np.diff(mean) < 0.0).all(), "the medium's albedo falls from red to blue"


def test_synchronous_trainings_are_equal(scene: Scene) -> None:
    arguments: dict[str, Any] = {"settings": LARGER, "stream": STREAM, "learning": FAST, "synchronous": True}
    once, again = (train_neumip(scene, steps=10, **arguments) for _ in range(2))
    assert torch.equal(once.table, again.table)


def test_the_importance_module_learns_from_it(fitted: NeuMIP) -> None:
    targets = gather_targets(fitted, ball_of_charts(), range(1), 0)
    assert len(targets.positions) > 0


def test_a_stopped_training_goes_on_where_it_was(scene: Scene, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"settings": LARGER, "stream": STREAM, "learning": FAST, "synchronous": True}
    whole = train_neumip(scene, steps=40, **arguments)
    calls = iter(range(1000))
    train_neumip(scene, steps=40, output=tmp_path / "m.pt", stop=lambda: next(calls) >= 20, **arguments)
    resumed = train_neumip(scene, steps=40, output=tmp_path / "m.pt", resume=True, **arguments)
    assert torch.equal(whole.table, resumed.table)


def test_without_xatlas_it_stops_before_paths_are_traced(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prt_bake.baselines.unwrapping.missing_sentence", lambda *_: "xatlas is not installed")
    monkeypatch.setattr("prt_bake.baselines.unwrapping.fault_of", lambda *_: "its texture coordinates overlap")
    sentences: list[str] = []
    with pytest.raises(MeshError, match="xatlas is not installed"):
        train_neumip(scene, steps=2, say=sentences.append)
    assert not sentences


def test_the_pyramid_has_nine_levels_that_all_learn(scene: Scene) -> None:
    module, name = BASELINES["neumip-pyramid"]
    model = getattr(import_module(module), name)(scene, steps=2, synchronous=True, stream=STREAM, learning=FAST)
    assert model.settings.sizes == [512, 256, 128, 64, 32, 16, 8, 4, 2]
    start = NeuMIP(model.settings, scene.mesh, model.spaces)
    changed = (model.table - start.rounded().table).abs().amax(dim=1) > 0.0
    firsts = np.cumsum([0, *(space.rows for space in model.spaces)])
    assert all(changed[first:last].any() for first, last in pairwise(firsts))


def test_the_published_loss_needs_values(tmp_path: Path) -> None:
    write_mesh(build_mesh(ball_of_charts().positions, ball_of_charts().faces), tmp_path / "ball.ply")
    (tmp_path / "scene.toml").write_text(SCENE.format(eta=1.3, roughness=0.0))
    with pytest.raises(QueryError, match="is smooth; Ŝ has no values there, which the loss of neumip-log needs"):
        train_baseline(read_scene(tmp_path / "scene.toml"), "neumip-log", steps=2)


def test_unknown_baselines_and_other_devices_are_refused(scene: Scene) -> None:
    with pytest.raises(QueryError, match=r"expected one of neumip, neumip-pyramid, neumip-log.* found 'neumop'"):
        train_baseline(scene, "neumop", steps=2)
    with pytest.raises(QueryError, match="learns on the processor only; expected device 'cpu', found 'cuda'"):
        train_baseline(scene, "neumip", steps=2, device="cuda")
