"""The comparison with baselines from end to end, on a few pixels."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from formats.atomic import sha256
from formats.errors import QueryError
from formats.image import read_image
from prt_bake.lights.environment import read_environment
from prt_bake.lights.lighting import Lighting
from prt_bake.paper.artefacts import Artefact, Artefacts, Stopped
from prt_bake.paper.baselines import report as module
from prt_bake.paper.baselines.contenders import CONTENDERS, EQUAL, Comparison
from prt_bake.paper.baselines.report import BaselineReport
from prt_bake.paper.scenes import SCENES, BakeSettings
from prt_bake.paper.settings import ReportSettings
from tests import ROOT
from tests.paper.shipped_scene import write_scenes

pytestmark = pytest.mark.statistics

SKY = ROOT / "scenes/skies/outdoor.hdr"
SETTINGS = ReportSettings(size=32, spp=32, reference_spp=16, train_minutes=0.03)
SPOT = replace(SCENES[0], files=("spot.toml",), bake=BakeSettings(0, 1, 4, 16))
"""The shipped object under the name of one of the paper's scenes."""
SHORT = tuple(each for each in CONTENDERS if each.name in ("nerfactor", EQUAL, "net"))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scenes(tmp_path_factory.mktemp("scenes"), "grape")


def run(
    out: Path, scenes: Path, messages: list[str], settings: ReportSettings = SETTINGS, stopped: bool = False
) -> Comparison:
    found: list[Comparison] = []
    artefacts = Artefacts(out, messages.append, lambda: stopped)
    report = BaselineReport(artefacts, scenes, settings, True, lambda what, share, text: None)
    report.run([SPOT], {"outdoor": SKY}, found.append)
    return found[0]


def test_a_scene_is_compared_once(tmp_path: Path, scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("prt_bake.paper.baselines.report.CONTENDERS", "prt_bake.paper.baselines.table.CONTENDERS"):
        monkeypatch.setattr(name, SHORT)
    messages: list[str] = []
    first = run(tmp_path, scenes, messages)
    assert [entry.contender for entry in first.entries] == [contender.name for contender in SHORT]
    shipped, best = first.entry("net"), first.entry("nerfactor")
    assert shipped is not None
    assert best is not None
    # The shipped network, trained for long, is far ahead of a BRDF in every figure.
    assert shipped.figures["mse"].high < 0.5 * best.figures["mse"].low
    assert shipped.figures["flip"].value < best.figures["flip"].low
    assert first.factor(first.entries[1], "mse") == 1.0
    assert 0.3 < first.ceiling["transport"]["value"] < 0.8
    assert first.ceiling["transport"]["value"] < 1.2 * best.training["relative_rmse"]["transport"]

    page = (tmp_path / "baselines.md").read_text(encoding="utf-8")
    assert all(f"| {contender.title} |" in page for contender in SHORT)
    assert json.loads((tmp_path / "baselines.json").read_text(encoding="utf-8"))["results"][0]["scene"] == "grape"
    assert np.asarray(Image.open(tmp_path / "baselines.png")).std() > 5.0

    messages.clear()
    assert run(tmp_path, scenes, messages) == first
    assert not messages
    # Another seed draws another reference and trains other models; the shipped network stays.
    other = run(tmp_path, scenes, messages, replace(SETTINGS, seed=3))
    assert not any("model.pt: " in sentence for sentence in messages)
    assert other.entries[0].training != first.entries[0].training
    assert other.noise != first.noise


def test_a_model_that_refuses_the_scene_leaves_its_row_out(
    tmp_path: Path, scenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("prt_bake.paper.baselines.report.CONTENDERS", "prt_bake.paper.baselines.table.CONTENDERS"):
        monkeypatch.setattr(name, tuple(each for each in CONTENDERS if each.name in ("neumip", "net")))
    trained = module.train_once

    def refusing(*arguments: object, baseline: str | None = None, **options: object) -> object:
        if baseline is not None:
            raise QueryError("it has no values")
        return trained(*arguments, **options)

    monkeypatch.setattr(module, "train_once", refusing)
    found = run(tmp_path, scenes, [])
    assert found.entry("neumip") is None
    assert found.entries[0].missing == "it has no values"
    assert "- NeuMIP is left out: it has no values" in (tmp_path / "baselines.md").read_text(encoding="utf-8")
    assert not (tmp_path / "grape/outdoor/baselines/neumip.exr").exists()
    assert read_image(tmp_path / "grape/outdoor/net_mis.exr").shape == (32, 32, 3)


def test_the_light_of_each_row(tmp_path: Path, scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("nerfactor-unknown", "nerfactor-512", "nerfactor-own-sky", "net")
    for name in ("prt_bake.paper.baselines.report.CONTENDERS", "prt_bake.paper.baselines.table.CONTENDERS"):
        monkeypatch.setattr(name, tuple(each for each in CONTENDERS if each.name in names))
    learned_under: dict[str, Lighting | None] = {}
    shipped = scenes / "models/grape.pt"

    def shipped_network(artefacts: Artefacts, file: str, *_: object, light: Lighting | None, **__: object) -> Artefact:
        learned_under[file] = light
        return Artefact(shipped, sha256(shipped), {"megabytes": 0.1})

    monkeypatch.setattr(module, "train_once", shipped_network)
    run(tmp_path, scenes, [])
    lights = {file: None if light is None else light.skies[0].image for file, light in learned_under.items()}
    assert lights.pop("grape/baselines/nerfactor-unknown.pt") is None
    np.testing.assert_array_equal(lights.pop("grape/outdoor/baselines/nerfactor-known.pt"), read_environment(SKY))
    assert not lights
    # One network, with the same random numbers: only the light of 16×32 pixels differs, and its energy does not.
    whole, own, coarse = (
        read_image(tmp_path / f"grape/outdoor/baselines/{name}.exr")
        for name in ("nerfactor-unknown", "nerfactor-own-sky", "nerfactor-512")
    )
    np.testing.assert_array_equal(whole, own)
    assert np.abs(coarse - whole).mean() / whole.mean() > 1e-3
    assert coarse.mean() == pytest.approx(whole.mean(), rel=0.2)


def test_a_stop_is_passed_on(tmp_path: Path, scenes: Path) -> None:
    with pytest.raises(Stopped):
        run(tmp_path, scenes, [], stopped=True)
    assert not (tmp_path / "baselines.md").exists()
