"""The trained models of the paper's scenes match their scenes and reports, and are small."""

import json

import pytest

from formats.scene import read_scene
from prt_bake.network.bssrdf import load_model
from prt_bake.paper.scenes import SCENES, PaperScene
from tests import ROOT

SCENES_FOLDER = ROOT / "scenes"
MODELS = SCENES_FOLDER / "models"


@pytest.mark.parametrize("paper", SCENES, ids=lambda paper: paper.name)
def test_a_model_was_trained_on_its_scene(paper: PaperScene) -> None:
    path = MODELS / f"{paper.name}.pt"
    scene = read_scene(SCENES_FOLDER / paper.files[-1])
    metadata = load_model(path).metadata
    assert metadata["scene_hash"] == scene.content_hash
    assert path.stat().st_size <= 1416 * 1024


@pytest.mark.parametrize("paper", SCENES, ids=lambda paper: paper.name)
def test_a_report_belongs_to_its_model(paper: PaperScene) -> None:
    report = json.loads((MODELS / f"{paper.name}.report.json").read_text(encoding="utf-8"))
    training = load_model(MODELS / f"{paper.name}.pt").metadata["training"]
    reported = report["model"]
    assert (reported["steps"], reported["walks"]) == (training["steps"], training["walks"])
    assert reported["scene"] in (MODELS / "README.md").read_text(encoding="utf-8")
    assert report["criteria"]


def test_the_models_are_small() -> None:
    sizes = {path.name: path.stat().st_size for path in MODELS.iterdir()}
    assert sum(sizes.values()) < 8_000_000, sizes
