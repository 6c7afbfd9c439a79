"""`prtbake render` of a model: its outputs and errors."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from formats.image import read_image, read_layers
from formats.mesh import build_mesh, write_mesh
from prt_bake.cli.shared import after_training
from prt_bake.importance.module import ImportanceModule, ImportanceSettings, save_importance
from prt_bake.network.bssrdf import load_model, save_model
from prt_bake.network.file_names import importance_path
from tests.cli.command_line import Run
from tests.network.test_lobes import lobed as clear_network
from tests.shapes import ball

SPHERE = ball(2)
COMMAND = ["--light", "sky.exr", "--size", "12x10", "--workers", 1]


@pytest.fixture
def model(folder: Path, tmp_path: Path) -> Path:
    """A copy of the shared model with an importance module beside it."""
    path = Path(shutil.copy(folder / "model.pt", tmp_path / "model.pt"))
    settings = ImportanceSettings(features=8, widths=(16, 8))
    save_importance(ImportanceModule(settings, (-1.0,) * 3, 2.0), path)
    return path


def test_the_picture_states_its_contents(prtbake: Run, model: Path, tmp_path: Path) -> None:
    output, report, preview = tmp_path / "a.exr", tmp_path / "a.json", tmp_path / "so_far.png"
    options = ["--spp", 32, "--report", report, "--preview", preview, "--every", 0, "--seed", 3]
    outcome = prtbake("render", model, "sphere.ply", *COMMAND, "-o", output, *options)
    assert outcome.code == 0
    assert "samples per pixel and second, sampled by mis" in outcome.out
    read, reported = read_layers(output), json.loads(report.read_text())
    assert read.layers["error"].shape == (10, 12, 3)
    texts = {name.removeprefix("prtbake."): text for name, text in read.attributes.items()}
    assert texts["sampling"] == "mis"
    assert texts["shows"] == "subsurface light of the network, unscattered light left out"
    assert int(texts["spp"]) >= 32
    assert reported["sampling"]["by"] == "mis"
    assert reported["samples_a_pixel_a_second"] > 0
    assert reported["negative"] >= 0
    assert read_image(preview).shape == (10, 12, 3)
    assert prtbake("render", model, "sphere.ply", *COMMAND, "-o", output, *options).code == 0
    np.testing.assert_array_equal(read_image(output), read.image)


@pytest.mark.parametrize("suffix", [".png", ".hdr"])
def test_other_formats_hold_no_negative_radiance(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    output, radiance = tmp_path / f"a{suffix}", tmp_path / "a.exr"
    for each in (output, radiance):
        assert prtbake("render", "model.pt", "sphere.ply", *COMMAND, "-o", each, "--spp", 8).code == 0
    below = read_image(radiance) < 0.0
    assert below.any()
    assert (read_image(output)[below] == 0.0).all()


def test_errors_are_one_sentence(prtbake: Run, model: Path, tmp_path: Path) -> None:
    output = tmp_path / "a.exr"
    for sampling in ("lobe", "mis"):
        outcome = prtbake("render", "model.pt", "sphere.ply", *COMMAND, "-o", output, "--sampling", sampling)
        assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
        assert "prtbake importance" in outcome.err
    for option in (["--sampling", "light"], ["--precision", "bfloat16"], ["--device", "cuda"], ["--workers", "1"]):
        outcome = prtbake("render", "scene.toml", "sphere.ply", *COMMAND, "-o", output, *option)
        assert outcome.code == 2
        assert "is for networks" in outcome.err
    network = load_model(model)
    network.box_side = 0.5
    save_model(network, tmp_path / "small.pt")
    outcome = prtbake("render", tmp_path / "small.pt", "sphere.ply", *COMMAND, "-o", output)
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
    assert "outside the box that the model was trained in" in outcome.err
    outcome = prtbake("render", model, "sphere.ply", *COMMAND, "-o", output, "--preview", tmp_path / "a.txt")
    assert outcome.code == 1
    assert not output.exists()


def test_an_index_matched_object_reflects_nothing(prtbake: Run, tmp_path: Path) -> None:
    pictures = []
    for option in ("--reflection", "--no-reflection"):
        output = tmp_path / f"a{option}.exr"
        done = prtbake(
            "render", "scene.toml", "sphere.ply", "--light", "sky.exr", "--size", "8x8", "-o", output, option
        )
        assert done.code == 0
        pictures.append(read_layers(output))
    np.testing.assert_array_equal(pictures[0].image, pictures[1].image)
    assert "reflected" in pictures[0].attributes["prtbake.shows"]


@pytest.fixture
def clear_model(tmp_path: Path) -> tuple[Path, Path]:
    """A network with lobes of its own, and its mesh."""
    model, mesh = tmp_path / "clear.pt", tmp_path / "clear.ply"
    save_model(clear_network(), model)
    write_mesh(build_mesh(0.5 + 0.45 * np.asarray(SPHERE.positions), np.asarray(SPHERE.faces)), mesh)
    return model, mesh


def test_a_network_with_lobes_is_sampled_by_them(prtbake: Run, clear_model: tuple[Path, Path], tmp_path: Path) -> None:
    output = tmp_path / "a.exr"
    for sampling, method in (([], "mis"), (["--sampling", "lobe"], "lobe"), (["--sampling", "light"], "light")):
        outcome = prtbake("render", *clear_model, *COMMAND, "-o", output, "--spp", 16, *sampling)
        assert outcome.code == 0, outcome.err
        assert f"sampled by {method}" in outcome.out


def test_a_network_with_lobes_needs_no_importance_module(prtbake: Run, clear_model: tuple[Path, Path]) -> None:
    outcome = prtbake("importance", *clear_model, "--steps", 1)
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
    assert "needs no importance module" in outcome.err
    after_training.importance(clear_network(), None, clear_model[0], 0)
    assert not importance_path(clear_model[0]).exists()
