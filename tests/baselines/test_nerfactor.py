"""NeRFactor as a transport: its BRDF, its visibility, its files, and a bake of it."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest
import torch

import prt_bake as prt
from formats.errors import ModelError, QueryError
from prt_bake.baselines import nerfactor_training
from prt_bake.baselines.nerfactor import NeRFactor, NeRFactorSettings, glossy
from prt_bake.baselines.nerfactor_training import LEARNING, lobe_share, train_nerfactor
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.bssrdf import load_model, save_model
from prt_bake.reflection import microfacet
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.queries import QuerySource
from tests.shapes import ball, ring
from tests.trainer.small_training import LEARNING as SMALL_LEARNING
from tests.trainer.small_training import STREAM, make_scene

SMALL = NeRFactorSettings(width=16, octaves=2, bounded=False)
LATTICE = fibonacci(4096)


def white(mesh, **settings) -> NeRFactor:
    """A model whose albedo is 1 everywhere."""
    model = NeRFactor(dataclasses.replace(SMALL, reflectance=0.0, **settings), mesh)
    output = model.albedo_layers[-1]
    torch.nn.init.zeros_(output.weight)
    torch.nn.init.constant_(output.bias, np.log(np.e - 1.0))
    return model


def on_faces(mesh, faces):
    return mesh.positions[mesh.faces[faces]].mean(axis=1), np.array(mesh.face_normals)[faces]


@pytest.mark.parametrize("normals", ["face", "vertex"])
def test_a_white_convex_body_under_a_white_sky_is_white(normals):
    mesh = ball(3)
    model = white(mesh)
    model = NeRFactor(model.settings, mesh, metadata={"normals": normals})
    model.load_state_dict(white(mesh).state_dict())
    positions, outgoing = on_faces(mesh, np.arange(0, len(mesh.faces), 41))
    furnace = 4.0 * np.pi / len(LATTICE) * model.evaluate(LATTICE, positions, outgoing).sum(axis=1)
    # 4,096 directions of a lattice integrate the clamped cosine to 1e-3.
    np.testing.assert_allclose(furnace, 1.0, atol=2e-3)


def test_light_from_behind_the_tangent_plane_gives_nothing():
    mesh = ball(2)
    model = NeRFactor(SMALL, mesh)
    positions, normals = on_faces(mesh, np.arange(20))
    transport = model.evaluate(LATTICE[:500], positions, normals)
    cosines = normals @ LATTICE[:500].T
    assert (transport[cosines <= 0.0] == 0.0).all()
    assert (transport[cosines > 0.0] > 0.0).all()


def test_the_other_side_of_a_ring_occludes_light():
    """At the inner equator of a torus light arrives above the tangent plane, but not through the other side."""
    mesh = ring(around=48, across=24)
    inner = np.argmin(
        np.linalg.norm(mesh.face_normals + np.array([1.0, 0.0, 0.0]), axis=1)
        + 9.0 * (mesh.positions[mesh.faces][:, :, 0].mean(axis=1) < 0)
    )
    positions, normals = on_faces(mesh, [inner])
    height = np.array([0.0, 0.1, 0.2, 3.0])
    towards = np.stack([-np.ones(4), height, np.zeros(4)], axis=1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    lit = white(mesh).evaluate(towards, positions, normals)[0, :, 0]
    assert (lit[:3] == 0.0).all()
    assert lit[3] == pytest.approx(towards[3] @ normals[0] / np.pi, rel=1e-4)


def test_the_lobe_is_the_microfacet_model_of_reflections():
    """GGX with separable Smith masking, as `prt_bake.reflection` computes it; Schlick's is the Fresnel term."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(2, 300, 3))
    directions[..., 2] = np.abs(directions[..., 2]) + 0.02
    incident, outgoing = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    incident[:50] = outgoing[:50] * [-1.0, -1.0, 1.0]  # the peak
    alpha = generator.uniform(0.01, 0.9, 300)
    half = microfacet.half_vectors(incident, outgoing)
    fresnel = 0.04 + 0.96 * (1.0 - np.sum(half * outgoing, axis=1)) ** 5
    density = microfacet.reflection_density(incident, half, alpha)
    expected = fresnel * density * microfacet.masking(outgoing[:, 2], alpha) / outgoing[:, 2] * incident[:, 2]
    columns = (alpha, incident[:, 2], outgoing[:, 2], np.sum(incident * outgoing, axis=1))
    roughness, cosines, eye, between = (torch.from_numpy(column[:, None]).float() for column in columns)
    found = glossy(roughness, 0.04, cosines, eye, between)[:, 0].numpy()
    # In float32 1 − cos² of the half vector is exact to 1e-7, which is 1e-3 of the least alpha².
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=1e-6)


def test_the_albedo_is_bounded_as_published():
    model = NeRFactor(NeRFactorSettings(width=16, octaves=2), ball(1))
    torch.nn.init.constant_(model.albedo_layers[-1].bias, 50.0)
    encoded = model.encode_positions(torch.zeros(1, 3))
    assert model.albedo(encoded)[0].tolist() == pytest.approx([0.8] * 3)
    assert 0.1 <= model.roughness_at(encoded).item() <= 1.0


def test_a_file_holds_the_model_and_its_object(tmp_path):
    mesh = ring()
    model = NeRFactor(SMALL, mesh, 0.5, {"normals": "vertex", "scene": "ring"})
    model.albedo_scale.copy_(torch.tensor([1.0, 2.0, 0.3]))
    model = model.rounded()
    assert model.albedo_scale.tolist() == pytest.approx([1.0, 2.0, 0.3])
    save_model(model, tmp_path / "model.pt")
    read = load_model(tmp_path / "model.pt", mesh=mesh)
    assert (read.kind, read.settings, read.metadata, read.output_scale) == ("nerfactor", SMALL, model.metadata, 0.5)
    positions, normals = on_faces(mesh, np.arange(0, len(mesh.faces), 7))
    expected = model.evaluate(LATTICE[:200], positions, normals)
    np.testing.assert_array_equal(read.evaluate(LATTICE[:200], positions, normals), expected)


@pytest.mark.parametrize("copied", [lambda model: pickle.loads(pickle.dumps(model)), copy.deepcopy])
def test_a_copy_has_the_same_values(copied):
    model = NeRFactor(SMALL, ring(), metadata={"normals": "vertex"})
    positions, normals = on_faces(ring(), np.arange(0, 300, 7))
    other = copied(model)
    expected = model.evaluate(LATTICE[:200], positions, normals)
    np.testing.assert_array_equal(other.evaluate(LATTICE[:200], positions, normals), expected)
    points, incident = model.lit.points(positions, normals), np.broadcast_to(LATTICE[:9], (len(normals), 9, 3))
    copied_lit = copied(model.lit)
    np.testing.assert_array_equal(copied_lit.lambert(points, incident), model.lit.lambert(points, incident))


def test_a_bake_does_not_depend_on_its_workers():
    model = NeRFactor(SMALL, ball(1))
    one, two = (prt.bake(model, ball(1), rings=2, sectors=2, samples=18, workers=workers) for workers in (1, 2))
    np.testing.assert_array_equal(one.coefficients, two.coefficients)


def test_the_share_of_the_lobe_is_what_exceeds_a_lambert_surface(tmp_path):
    """On a white convex body the diffuse part of ∫ Ŝ dωi is 1."""
    scene = make_scene(tmp_path)
    assert lobe_share(white(scene.mesh), scene) == 0.0
    model = white(scene.mesh)
    model.settings = dataclasses.replace(model.settings, reflectance=0.5)
    queries = QuerySource(prepare(scene), 1, 3).draw(0, 500)
    total = 4.0 * np.pi / 1000 * model.evaluate(fibonacci(1000), queries.positions, queries.outgoing).sum(axis=1).mean()
    # 256 other queries, views at grazing angles among them
    assert lobe_share(model, scene) == pytest.approx(1.0 - 1.0 / total, abs=0.03)


def test_files_that_do_not_fit_are_refused(tmp_path):
    model = NeRFactor(SMALL, ball(1))
    head, tensors = model.file_content()
    head = {"format": "prtbake model", "format_version": 1, **head}
    from prt_bake.network.checkpoint import write_checkpoint

    def refusal(head, tensors) -> str:
        import json

        write_checkpoint(tmp_path / "model.pt", json.dumps(head), tensors)
        with pytest.raises(ModelError) as caught:
            load_model(tmp_path / "model.pt")
        return str(caught.value)

    assert "tensor faces is missing" in refusal(head, {key: value for key, value in tensors.items() if key != "faces"})
    wide = {**head, "settings": {**head["settings"], "width": 4096}}
    assert "a larger model than its" in refusal(wide, tensors)
    named = {**head, "settings": {**head["settings"], "octaves": 2.5}}
    assert "NeRFactor settings: octaves: expected int, found 2.5" in refusal(named, tensors)
    outside = {**head, "settings": {**head["settings"], "reflectance": 2.0}}
    assert "reflectance: expected 0 to 1, found 2.0" in refusal(outside, tensors)
    faces = {**tensors, "faces": tensors["faces"] + 1000.0}
    assert "model.pt" in refusal(head, faces)


def test_a_foreign_mesh_is_refused():
    model = NeRFactor(SMALL, ball(2))
    model.refuse_foreign(ball(2))
    with pytest.raises(QueryError, match="found 66 of 66 vertices off it"):
        model.refuse_foreign(ball(2, radius=1.01))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"), eta=1.3, roughness=0.4)


@pytest.fixture(scope="module")
def trained(scene):
    """A model of a small rough scene, trained from walks in a second."""
    learning = dataclasses.replace(
        LEARNING,
        **{
            name: getattr(SMALL_LEARNING, name)
            for name in ("batch", "rate", "spread", "held_out_queries", "held_out_walks")
        },
    )
    return scene, train_nerfactor(scene, steps=150, settings=SMALL, stream=STREAM, learning=learning, seed=1)


@pytest.mark.statistics
def test_walks_teach_the_brdf(trained):
    """The medium's albedo falls from red to blue, and so does the BRDF's; its errors are those of its class."""
    scene, model = trained
    with torch.no_grad():
        red, green, blue = model.albedo(model.encode_positions(torch.from_numpy(scene.mesh.positions))).mean(dim=0)
    assert red > green > blue > 0.0
    errors = model.metadata["training"]["relative_rmse"]
    assert 0.0 < errors["transport"] < 1.0
    assert errors["coefficients"] < 0.9


@pytest.mark.statistics
def test_a_bake_has_the_harmonics_of_the_model(trained):
    scene, model = trained
    asset = prt.bake(model, scene.mesh, rings=2, sectors=4, samples=512)
    environment = np.zeros((16, 32, 3))
    environment[:8] = 1.0
    camera = prt.fit_camera(scene.mesh, 24, 24)
    baked = prt.render_picture(asset, environment, camera, background=False).image
    sampled = prt.render_network(model, scene.mesh, environment, camera, spp=64, background=False).image
    # Two rings of bins and harmonics of degree 2 of a clamped cosine.
    assert baked.mean() == pytest.approx(sampled.mean(), rel=0.05)


def test_the_command_trains_it(prtbake, scene, tmp_path, monkeypatch):
    few = dataclasses.replace(LEARNING, batch=64, held_out_queries=16, held_out_walks=16)
    monkeypatch.setattr(nerfactor_training, "LEARNING", few)
    output = tmp_path / "nerfactor.pt"
    arguments = ["--baseline", "nerfactor", "--steps", 2, "-o", output, "--no-report", "--no-importance"]
    outcome = prtbake("train", scene.path, *arguments)
    assert outcome.code == 0, outcome
    read = load_model(output)
    assert read.kind == "nerfactor"
    assert 0.0 < read.metadata["training"]["lobe_share"] < 1.0
    assert f"{read.metadata['training']['lobe_share']:.1%} of its Ŝ is its glossy lobe" in outcome.out
    assert "no BRDF has the light that comes through the object" in outcome.out
    described = prtbake("info", output)
    assert described.out.splitlines()[0].endswith("model: NeRFactor, a baseline, trained on one object")
    assert f"{read.metadata['training']['lobe_share']:.1%} of Ŝ" in described.out
    assert prtbake("train", scene.path, *arguments, "--force", "--device", "cuda").code != 0


def test_it_learns_on_the_processor_only(scene):
    with pytest.raises(QueryError, match="expected device 'cpu', found 'cuda'"):
        train_nerfactor(scene, steps=1, device="cuda")
