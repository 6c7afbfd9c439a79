"""The report from end to end on a few pixels, resumed; its models copied, trained and resumed."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from formats.errors import ModelError
from formats.image import read_image, read_layers
from formats.scene import read_scene
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, load_model, save_model
from prt_bake.paper.artefacts import Artefacts, Stopped
from prt_bake.paper.layers import ablation
from prt_bake.paper.models import scene_model
from prt_bake.paper.report import PaperReport
from prt_bake.paper.results import METHODS, Result
from prt_bake.paper.scenes import SCENES, BakeSettings
from prt_bake.paper.settings import ReportSettings
from prt_bake.paper.times import power_law
from prt_bake.shipped.demonstration import SHIPPED
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.samples.rows import StreamSettings
from tests import ROOT
from tests.cli.command_line import Run
from tests.paper.shipped_scene import write_scenes

pytestmark = pytest.mark.statistics

SKY = ROOT / "scenes/skies/outdoor.hdr"
SETTINGS = ReportSettings(size=32, spp=32, reference_spp=16)
LUCY = replace(SCENES[-1], files=("spot.toml",), bake=BakeSettings(0, 1, 4, 16))
"""The shipped object under the name of one of the five scenes."""
GOAL = "path tracing 16 paths per pixel"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scenes(tmp_path_factory.mktemp("scenes"), "lucy")


def run(out: Path, scenes: Path, messages: list[str], **options: Any) -> list[Result]:
    results: list[Result] = []
    report = PaperReport(out, scenes, SETTINGS, say=messages.append, **options)
    report.run([LUCY], {"outdoor": SKY}, results.append)
    return results


def test_a_report_is_built_once(tmp_path: Path, scenes: Path) -> None:
    messages: list[str] = []
    (first,) = run(tmp_path, scenes, messages)
    assert sum("building" in sentence for sentence in messages) == 11
    assert [line.method for line in first.lines] == list(METHODS)
    assert all(0.0 < line.alone["flip"] < 0.5 and line.whole for line in first.lines)
    assert first.line("light").megabytes < first.line("lobe").megabytes
    assert first.framing["object_share"] > 0.4
    page = (tmp_path / "tables.md").read_text()
    assert f"{first.line('mis').alone['flip']:.4f}" in page
    read = json.loads((tmp_path / "tables.json").read_text())
    assert read["results"][0]["lines"][0]["alone"]["flip"] == first.lines[0].alone["flip"]
    for name in ("sheet", "everything", "sigma", "training"):
        assert np.asarray(Image.open(tmp_path / f"{name}.png")).std() > 5.0

    truth = read_layers(tmp_path / "lucy/outdoor/reference.exr")
    off = np.s_[:4, :4]  # a corner of the background
    assert not truth.layers["coverage"][off].any()
    for image in (truth.image, read_image(tmp_path / "lucy/outdoor/sh.exr")):
        assert not image[off].any()
    surface = read_image(tmp_path / "lucy/outdoor/surface.exr")
    assert (surface[off] > 0.0).all()

    messages.clear()
    (again,) = run(tmp_path, scenes, messages)
    assert messages == []
    assert again == first
    (tmp_path / "lucy/outdoor/sh.exr").unlink()
    run(tmp_path, scenes, messages)
    assert messages == ["lucy/outdoor/sh.exr: building"]


def test_a_stopped_report_keeps_its_finished_steps(tmp_path: Path, scenes: Path) -> None:
    messages: list[str] = []
    with pytest.raises(Stopped, match="resumes"):
        run(tmp_path, scenes, messages, stop=lambda: len(messages) >= 3)
    assert (tmp_path / "lucy/model.importance.pt.made.json").is_file()
    assert not (tmp_path / "tables.md").exists()
    kept = len(messages)
    with pytest.raises(Stopped):
        run(tmp_path, scenes, messages, stop=lambda: len(messages) > kept)
    assert messages[kept:] == [f"lucy/outdoor/reference.exr: {GOAL}, 0 paths per pixel exist"]


class FakeTraining:
    """Replaces the trainer: writes a model and records its arguments."""

    def __init__(self, network: NeuralBSSRDF, error: float = 0.1) -> None:
        self.network = network
        self.calls: list[dict[str, Any]] = []
        self.error = error
        self.refuses_to_resume = False

    def __call__(self, scene: Any, **arguments: Any) -> Any:
        self.calls.append(arguments)
        if self.refuses_to_resume and arguments["resume"]:
            raise ModelError("model.train.pt: is of version 2, expected 3")
        network = self.network
        network.metadata["scene_hash"] = scene.content_hash
        layers = arguments["settings"].layers if arguments["settings"] else 5
        network.metadata["training"] = {
            **{"relative_rmse": {"transport": self.error / layers, "coefficients": 0.1}},
            **{"seconds": 1.0, "walks": 1000},
        }
        save_model(network, arguments["output"])
        arguments["output"].with_suffix(".train.pt").write_bytes(b"state")
        arguments["progress"](SimpleNamespace(share=1.0, validation=0.5, walks_per_second=1.0))
        return network


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> FakeTraining:
    fake = FakeTraining(NeuralBSSRDF(NetworkSettings(features=8, width=16), (-1.0, -1.0, -1.0), 2.0))
    monkeypatch.setattr("prt_bake.trainer.train.train", fake)
    return fake


def test_longer_trainings_are_compared_on_pictures(tmp_path: Path, scenes: Path, training: FakeTraining) -> None:
    messages: list[str] = []
    training.network = load_model(SHIPPED / "spot.pt")
    report = PaperReport(tmp_path, scenes, SETTINGS, say=messages.append)
    (rows,) = report.run_times([LUCY], {"outdoor": SKY}).values()
    assert [call["minutes"] for call in training.calls] == [1.25, 2.5, 5.0, 10.0]
    assert [row.minutes for row in rows] == [1.25, 2.5, 5.0, 10.0]
    # All four are the shipped network: the same picture, and a constant power law.
    assert len({row.flip for row in rows}) == 1
    assert 0.0 < rows[0].flip_without_noise <= rows[0].flip < 0.5
    assert power_law(rows, "flip").slope == pytest.approx(0.0, abs=1e-9)
    assert json.loads((tmp_path / "times.json").read_text())["lucy, outdoor"]["trainings"][3]["flip"] == rows[3].flip
    assert np.asarray(Image.open(tmp_path / "times.png")).std() > 5.0
    messages.clear()
    assert report.run_times([LUCY], {"outdoor": SKY}) == {"lucy, outdoor": rows}
    assert messages == []


def quiet(*message: object) -> None:
    pass


def test_a_model_of_another_scene_is_not_used(tmp_path: Path, scenes: Path, training: FakeTraining) -> None:
    messages: list[str] = []
    artefacts = Artefacts(tmp_path, messages.append)
    (tmp_path / "other.toml").write_text((scenes / "spot.toml").read_text().replace("eta = 1.3", "eta = 1.4"))
    for name in ("spot.obj", "sigma_t.npy", "albedo.npy"):
        shutil.copy(scenes / name, tmp_path / name)
    other, given = read_scene(tmp_path / "other.toml"), scenes / "models/lucy.pt"
    scene_model(artefacts, "lucy", read_scene(scenes / "spot.toml"), given, 1.0, "cpu", quiet)
    assert not training.calls
    model = scene_model(artefacts, "other", other, given, 1.0, "cpu", quiet)
    assert len(training.calls) == 1
    assert "was trained on another scene" in messages[1]
    assert load_model(model.path).metadata["scene_hash"] == other.content_hash
    assert sorted(path.name for path in model.path.parent.iterdir()) == ["model.pt", "model.pt.made.json"]


def test_a_stopped_training_resumes(tmp_path: Path, scenes: Path, training: FakeTraining) -> None:
    scene, missing = read_scene(scenes / "spot.toml"), tmp_path / "none.pt"
    stop = [False]
    artefacts = Artefacts(tmp_path, quiet, lambda: stop[0] and bool(training.calls))

    def train_and_stop(minutes: float) -> None:
        stop[0] = True
        training.calls.clear()
        with pytest.raises((Stopped, KeyboardInterrupt)):
            scene_model(artefacts, "lucy", scene, missing, minutes, "cpu", quiet)
        stop[0] = False

    train_and_stop(1.0)
    train_and_stop(1.0)
    assert [call["resume"] for call in training.calls] == [True]
    train_and_stop(2.0)
    assert [call["resume"] for call in training.calls] == [False]
    scene_model(artefacts, "lucy", scene, missing, 2.0, "cpu", quiet)
    assert [call["resume"] for call in training.calls] == [False, True]
    scene_model(artefacts, "lucy", scene, missing, 2.0, "cpu", quiet)
    assert len(training.calls) == 2


def test_changed_settings_retrain_the_model(
    tmp_path: Path, scenes: Path, training: FakeTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, missing, messages = read_scene(scenes / "spot.toml"), tmp_path / "none.pt", list[str]()
    artefacts = Artefacts(tmp_path, messages.append)
    others = {
        "learning": ("prt_bake.trainer.train.LearningSettings", LearningSettings(spread=7)),
        "walks": ("prt_bake.trainer.samples.rows.StreamSettings", StreamSettings(exits=5)),
    }
    for group, (name, settings) in others.items():
        scene_model(artefacts, "lucy", scene, missing, 1.0, "cpu", quiet)
        with monkeypatch.context() as patched:
            patched.setattr(name, Mock(return_value=settings))
            scene_model(artefacts, "lucy", scene, missing, 1.0, "cpu", quiet)
        assert messages[-1] == f"lucy/model.pt: rebuilding, changed {group}"


def test_a_checkpoint_of_another_release_restarts_the_training(
    tmp_path: Path, scenes: Path, training: FakeTraining
) -> None:
    scene, missing, messages = read_scene(scenes / "spot.toml"), tmp_path / "none.pt", list[str]()
    stopping = Artefacts(tmp_path, quiet, lambda: bool(training.calls))
    with pytest.raises((Stopped, KeyboardInterrupt)):
        scene_model(stopping, "lucy", scene, missing, 1.0, "cpu", quiet)
    training.refuses_to_resume = True
    scene_model(Artefacts(tmp_path, messages.append), "lucy", scene, missing, 1.0, "cpu", quiet)
    assert [call["resume"] for call in training.calls] == [False, True, False]
    assert any("is of version 2, expected 3; the training restarts" in line for line in messages)


def test_a_model_error_of_a_new_training_is_raised(
    tmp_path: Path, scenes: Path, training: FakeTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(scene: Any, **arguments: Any) -> Any:
        training.calls.append(arguments)
        raise ModelError("broken")

    monkeypatch.setattr("prt_bake.trainer.train.train", broken)
    with pytest.raises(ModelError, match="broken"):
        scene_model(
            Artefacts(tmp_path, quiet),
            "lucy",
            read_scene(scenes / "spot.toml"),
            tmp_path / "none.pt",
            1.0,
            "cpu",
            quiet,
        )
    assert len(training.calls) == 1


def test_the_depth_ablation_is_relative_to_seven_layers_and_kept(
    tmp_path: Path, scenes: Path, training: FakeTraining
) -> None:
    scene, artefacts = read_scene(scenes / "spot.toml"), Artefacts(tmp_path, quiet)
    errors = ablation(artefacts, "lucy", scene, 1.0, "cpu", quiet)
    assert errors["7"] == 1.0
    assert errors["5*"] == errors["5"] == pytest.approx((7 / 5) ** 2)
    assert ablation(artefacts, "lucy", scene, 1.0, "cpu", quiet) == errors
    assert len(training.calls) == 10
    assert (tmp_path / "lucy/layers/5_without_skips.pt").is_file()


def test_the_depth_ablation_refuses_scenes_without_values_of_the_transport(prtbake: Run) -> None:
    outcome = prtbake("report", "paper", "--layers", "--scene", "dragon", "--scene", "drink", "--out", "new")
    assert outcome.code == 1
    assert "is smooth; Ŝ has no values there whose errors --layers could compare" in outcome.err
    assert not list(Path().glob("new/*"))


def test_an_unknown_error_is_unknown_in_the_depth_ablation(
    tmp_path: Path, scenes: Path, training: FakeTraining
) -> None:
    training.error = math.nan
    errors = ablation(Artefacts(tmp_path, quiet), "lucy", read_scene(scenes / "spot.toml"), 1.0, "cpu", quiet)
    assert all(math.isnan(error) for error in errors.values())


def test_the_command_refuses_unknown_scenes_and_skies(prtbake: Run) -> None:
    Path("broken.hdr").write_text("no picture")
    for arguments, sentence in (
        (["--scene", "teapot"], "'teapot' is not a scene of the paper"),
        (["--sky", "nowhere.hdr"], "nowhere.hdr: there is no such sky"),
        (["--sky", "broken.hdr"], "broken.hdr: is not Radiance"),
        (["--scenes", "."], "skies/outdoor.hdr: there is no such sky; expected the skies of the paper's scenes there"),
        (["--scenes", "nowhere"], "nowhere: there is no such folder; the paper's scenes are in the folder scenes of"),
    ):
        outcome = prtbake("report", "paper", "--out", "new", *arguments)
        assert outcome.code == 1
        assert sentence in outcome.err
        assert outcome.err.count("\n") == 1
        assert not list(Path().glob("new/*"))
    assert prtbake("report", "paper", "--size", "none").code == 2


def test_a_quick_report_says_that_its_figures_mean_nothing(prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prt_bake.paper.report.PaperReport.run", lambda *_arguments: None)
    sentence = "--quick tests the report; the figures that it prints mean nothing"
    assert sentence in prtbake("report", "paper", "--out", "quick", "--quick").err
    assert sentence not in prtbake("report", "paper", "--out", "new").err
