"""Tests of the importance module: its fit, its density, its reproducibility and its files."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from formats.errors import ModelError, QueryError, StorageError
from formats.mesh import Mesh, build_mesh
from prt_bake.importance.fit import fit_importance
from prt_bake.importance.loss import TargetTensors, density, variance, wrapped
from prt_bake.importance.module import (
    IMPORTANCE_PRESETS,
    ImportanceModule,
    ImportanceSettings,
    importance_path,
    load_importance,
    read_importance,
    save_importance,
)
from prt_bake.importance.targets import QUERIES_PER_BLOCK, draw_queries, gather_targets
from prt_bake.mathematics import lobe
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from prt_bake.network.checkpoint import read_checkpoint, write_checkpoint
from tests.cli.command_line import Run

SMALL = ImportanceSettings(features=16, widths=(32, 16), position_spread=0.3)
BALL = trimesh.creation.icosphere(subdivisions=3)


def ball() -> Mesh:
    return build_mesh(np.asarray(BALL.vertices), np.asarray(BALL.faces))


class KnownLobe:
    """A stand-in for a network: on a ball about the origin, a lobe about the normal or the outgoing direction.

    σ is `sigma` on the equator and `sigma + slope` at the pole.
    """

    def __init__(
        self, sigma: float, slope: float = 0.0, towards_eye: bool = False, shape: float = 2.0, scale: float = 1.0
    ) -> None:
        self.base, self.slope, self.towards_eye, self.shape, self.scale = sigma, slope, towards_eye, shape, scale

    def sigma(self, positions: np.ndarray) -> np.ndarray:
        return self.base + self.slope * positions[:, 2]

    def evaluate_block(self, incident: Any, rotation: Any, positions: Any, outgoing: Any) -> np.ndarray:
        normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
        axes = outgoing if self.towards_eye else normals[:, None]
        cosine = np.einsum("nbdk,nbk->nbd", incident[rotation], axes)
        values = lobe.density(self.sigma(positions)[:, None, None], self.shape, cosine)
        return (self.scale * np.repeat(values[..., None], 3, axis=-1)).astype(np.float32)


KNOWN = KnownLobe(0.6, slope=0.25)
FIT = {"steps": 120, "blocks": 2, "seed": 3, "threads": 1}


@pytest.fixture(scope="module")
def fitted() -> ImportanceModule:
    settings = replace(SMALL, tilted=False, shape=2.0)
    return fit_importance(KNOWN, ball(), settings=settings, **FIT)


def test_the_fit_recovers_a_known_sigma(fitted: ImportanceModule) -> None:
    """The transport is a lobe with the shape and uniform share of the fit, σ from 0.35 to 0.85 along z."""
    positions, outgoing, _normals = draw_queries(ball(), 77, seed=1)
    error = np.abs(fitted.sigma(positions, outgoing) / KNOWN.sigma(positions) - 1.0)
    assert np.quantile(error, 0.5) < 0.03
    assert np.quantile(error, 0.95) < 0.1


def test_another_mesh_is_refused() -> None:
    network = NeuralBSSRDF(NetworkSettings(), (-0.5, -0.5, -0.5), 1.0)
    with pytest.raises(QueryError, match="outside the box that the model was trained in"):
        fit_importance(network, ball(), **FIT)


def test_the_fit_lowers_divergence_and_variance(fitted: ImportanceModule) -> None:
    fit = fitted.metadata["fit"]
    for quantity in ("divergence", "variance"):
        assert fit["module"][quantity] < 0.02 * fit["uniform"][quantity]
        assert fit["module"][quantity] < 0.3 * fit["constant"][quantity]


def test_a_tilted_axis_fits_lobes_that_are_not_about_the_normal() -> None:
    transport, options = KnownLobe(0.5, towards_eye=True, shape=3.0), {**FIT, "steps": 60}
    tilted = fit_importance(transport, ball(), settings=SMALL, **options).metadata["fit"]
    upright = fit_importance(transport, ball(), settings=replace(SMALL, tilted=False), **options).metadata["fit"]
    assert tilted["module"]["divergence"] < 0.5 * upright["module"]["divergence"]


def test_the_fit_does_not_depend_on_the_number_of_threads() -> None:
    options = {**FIT, "steps": 5}
    one, two = (
        fit_importance(KnownLobe(0.5), ball(), settings=SMALL, **{**options, "threads": threads}) for threads in (1, 2)
    )
    for first, second in zip(one.state_dict().values(), two.state_dict().values(), strict=True):
        assert torch.equal(first, second)


def test_targets_are_scale_invariant_and_negative_values_are_black() -> None:
    plain, dim = (gather_targets(KnownLobe(0.5, scale=scale), ball(), [0], 0) for scale in (1.0, 1e-4))
    np.testing.assert_allclose(plain.share, dim.share, rtol=1e-4)
    with pytest.raises(ModelError, match="black"):
        gather_targets(KnownLobe(0.5, scale=-1.0), ball(), [0], 0)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
def test_values_that_are_not_finite_are_refused_with_their_position() -> None:
    with pytest.raises(ModelError, match="not finite"):
        gather_targets(KnownLobe(0.5, scale=math.nan), ball(), [0], 0)


def test_queries_are_above_their_faces_and_cover_the_surface() -> None:
    positions, outgoing, normals = draw_queries(ball(), 0, seed=0)
    assert len(positions) == QUERIES_PER_BLOCK
    assert (np.sum(outgoing * normals, axis=1) >= 0.0).all()
    assert np.abs(positions.mean(axis=0)).max() < 4.5 / math.sqrt(3 * QUERIES_PER_BLOCK)


@pytest.mark.parametrize(("sigma", "shape"), [(0.1, 2.0), (0.8, 3.0), (3.0, 1.0), (6.2, 2.0)])
def test_the_density_of_the_fit_is_that_of_rendering(sigma: float, shape: float) -> None:
    cosine = np.cos(np.linspace(0.01, np.pi - 0.01, 60))
    fitted = wrapped(torch.full((60,), sigma), shape, torch.as_tensor(cosine, dtype=torch.float32))
    expected = (lobe.density(sigma, shape, cosine) - 0.1 / (4 * np.pi)) / 0.9
    np.testing.assert_allclose(fitted.numpy(), expected, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("lobes", [1, 3])
def test_the_modules_lobe_has_the_density_of_the_fit(lobes: int) -> None:
    module = ImportanceModule(replace(SMALL, lobes=lobes), (-1, -1, -1), 2.0)
    with torch.no_grad():
        module.output.weight.normal_(0.0, 0.5, generator=torch.Generator().manual_seed(1))
    targets = gather_targets(KnownLobe(0.5), ball(), [0], 0)
    tensors = TargetTensors.of(targets)
    fitted = density(module, tensors, torch.arange(20)).detach().numpy()
    rendered = module.lobe(targets.positions[:20], targets.outgoing[:20], targets.normals[:20])
    np.testing.assert_allclose(fitted, rendered.density(targets.directions[targets.turn[:20]]), rtol=5e-3)


def test_f_over_density_is_bounded_by_the_uniform_share(fitted: ImportanceModule) -> None:
    """For directions all around, behind the surface too, and a lobe about the normal."""
    targets = gather_targets(KnownLobe(0.5), ball(), [0], 0)
    rendered = fitted.lobe(targets.positions, targets.outgoing, targets.normals)
    ratio = 1.0 / rendered.density(targets.directions[targets.turn])
    assert ratio.max() <= 4.0 * np.pi / 0.1 * (1.0 + 1e-12)


def test_the_variance_of_uniform_directions_is_that_of_the_values() -> None:
    share = torch.tensor([[0.5, 0.5, 0.0, 0.0]])
    assert float(variance(share, torch.full((1, 4), 1.0 / (4.0 * math.pi)))) == pytest.approx(1.0)


def test_a_new_module_predicts_the_same_lobe_everywhere() -> None:
    for settings in IMPORTANCE_PRESETS.values():
        positions, outgoing, normals = draw_queries(ball(), 0, seed=0)
        module = ImportanceModule(settings, (-1, -1, -1), 2.0)
        np.testing.assert_allclose(module.sigma(positions, outgoing), 0.85, rtol=1e-5)
        np.testing.assert_allclose(module.lobe(positions, outgoing, normals).axes[:, 0], normals, atol=1e-12)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory, fitted: ImportanceModule) -> Path:
    folder = tmp_path_factory.mktemp("importance")
    (folder / "ball.pt").write_bytes(b"any model")
    save_importance(fitted, folder / "ball.pt")
    return folder


@pytest.fixture
def model(saved: Path, tmp_path: Path) -> Path:
    """A copy for a test to damage."""
    return Path(shutil.copytree(saved, tmp_path / "copy")) / "ball.pt"


def test_the_file_is_beside_its_model_and_restores_the_module(model: Path, fitted: ImportanceModule) -> None:
    assert (model.parent / "ball.importance.pt").is_file()
    again = load_importance(model)
    assert (again.settings, again.metadata) == (fitted.settings, fitted.metadata)
    positions, outgoing, _normals = draw_queries(ball(), 5, seed=0)
    np.testing.assert_array_equal(again.sigma(positions, outgoing), fitted.sigma(positions, outgoing))


def test_a_missing_module_is_reported_with_the_command_that_fits_one(model: Path) -> None:
    importance_path(model).unlink()
    with pytest.raises(ModelError, match=r"ball\.importance\.pt.*prtbake importance .*ball\.pt MESH"):
        load_importance(model)


def test_a_module_of_another_model_is_refused(model: Path) -> None:
    model.write_bytes(b"trained again")
    with pytest.raises(ModelError, match=r"belongs to another model.*prtbake importance"):
        load_importance(model)


def test_a_missing_model_is_reported(model: Path) -> None:
    model.unlink()
    with pytest.raises(StorageError, match="no such file"):
        load_importance(model)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "prtbake model", "prtbake importance"),
        ("settings", {"features": 10**13}, "shape"),
        ("settings", {"uniform_share": 0.0}, "uniform_share"),
        ("settings", {"widths": []}, "widths"),
        ("settings", {"widths": "wide"}, "widths"),
        ("settings", {"shape": math.nan}, "shape"),
        ("settings", {"colour": 1}, "unknown key"),
        ("settings", [], "not readable"),
        ("box_side", 0, "box_side"),
        ("box_min", [0, 0, math.inf], "box_min"),
        ("metadata", 3, "not readable"),
    ],
)
def test_a_hostile_description_is_refused(model: Path, key: str, value: Any, message: str) -> None:
    text, tensors = read_checkpoint(importance_path(model))
    head = json.loads(text)
    head[key] = {**head[key], **value} if isinstance(value, dict) else value
    write_checkpoint(importance_path(model), json.dumps(head), tensors)
    with pytest.raises(ModelError, match=rf"ball\.importance\.pt.*{message}.*prtbake importance"):
        load_importance(model)


def test_damaged_tensors_are_refused_by_name(model: Path) -> None:
    text, tensors = read_checkpoint(importance_path(model))
    for damage in (tensors["output.bias"] * math.nan, tensors["output.bias"][:0], None):
        damaged = {**tensors, "output.bias": damage}
        kept = {name: tensor for name, tensor in damaged.items() if tensor is not None}
        write_checkpoint(importance_path(model), text, kept)
        with pytest.raises(ModelError, match=r"output\.bias"):
            read_importance(importance_path(model))


@pytest.mark.parametrize("length", [0, 10, 1000])
def test_a_truncated_file_is_refused(model: Path, length: int) -> None:
    path = importance_path(model)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(ModelError, match=r"ball\.importance\.pt.*prtbake importance"):
        load_importance(model)


def test_info_and_check_read_the_file_that_the_command_writes(prtbake: Run, folder: Path) -> None:
    made = prtbake("importance", "model.pt", "sphere.ply", "--steps", 2)
    assert made.code == 0, made.err
    assert "KL divergence" in made.out
    assert prtbake("check", "model.importance.pt") == (0, "model.importance.pt: sound\n", "")
    info = json.loads(prtbake("info", "model.importance.pt", "--json").out)
    assert info["kind"] == "importance"
    assert info["fit"]["steps"] == 2
    importance_path(folder / "model.pt").rename(folder / "other.importance.pt")
    assert prtbake("check", "other.importance.pt").code == 1
    (folder / "other.importance.pt").unlink()
