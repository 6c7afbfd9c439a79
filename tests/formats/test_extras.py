"""Missing optional packages are named with a command that installs them, before any work."""

import sys
from pathlib import Path

import pytest

from formats.errors import PrtbakeError
from formats.extras import EVALUATE, missing_sentence, require
from tests.cli.command_line import Run

LINES = {
    "demo --out demo": "demo",
    "compare sky.exr sky.exr": "compare",
    "report bake model.pt sphere.ply --out out": "report bake",
    "report bases model.pt sphere.ply --light sky.exr --out out": "report bases",
    "report training model.pt scene.toml": "report training",
    "report paper --out out": "report paper",
}


def test_nothing_is_missing_here() -> None:
    assert missing_sentence(*EVALUATE) == ""
    require("demo", *EVALUATE)


def test_missing_packages_are_named_as_pip_names_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage", None)
    assert missing_sentence("numpy", "skimage") == "scikit-image is not installed; pip install scikit-image"
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    sentence = "matplotlib, scikit-image are not installed; pip install matplotlib scikit-image"
    assert missing_sentence(*EVALUATE) == sentence
    with pytest.raises(PrtbakeError, match="report: matplotlib is not installed; pip install matplotlib"):
        require("report", "matplotlib")


@pytest.mark.parametrize("line", LINES)
def test_commands_say_it_before_any_work(
    prtbake: Run, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory, line: str
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    sentence = "flip-evaluator is not installed; pip install flip-evaluator"
    assert prtbake(*line.split()) == (1, "", f"prtbake: {LINES[line]}: {sentence}\n")
    assert not Path("out").exists()


def test_plots_need_matplotlib(prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    shaded = prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", "a.exr", "--error-picture", "b.png")
    assert shaded.err == "prtbake: --error-picture: matplotlib is not installed; pip install matplotlib\n"
    assert "compare: matplotlib is not" in prtbake("compare", "sky.exr", "sky.exr", "--flip-map", "b.png").err
    assert prtbake("compare", "sky.exr", "sky.exr").code == 0


def test_a_training_says_at_its_start_that_there_will_be_no_report(
    prtbake: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise PrtbakeError("the training would begin here")

    monkeypatch.setattr("prt_bake.trainer.train.train", stop)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    sentence = "there will be no report: matplotlib is not installed; pip install matplotlib; `prtbake report training`"
    line = ("train", "scene.toml", "-o", tmp_path / "m.pt", "--device", "cpu")
    assert prtbake(*line).err.startswith(f"prtbake: {sentence}")
    assert "no report" not in prtbake(*line, "--no-report").err
