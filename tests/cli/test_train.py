"""`prtbake train` within a time: what it says and writes, and what Ctrl-C leaves."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from prt_bake.network.bssrdf import NeuralBSSRDF, load_model
from prt_bake.network.settings import NetworkSettings
from prt_bake.trainer import budget, train
from prt_bake.trainer.report import report
from prt_bake.trainer.training_data import PathTracedData
from tests.cli.command_line import Run
from tests.trainer.small_training import LEARNING

FEW = replace(LEARNING, held_out_queries=16, held_out_walks=16)
CONTINUED = replace(FEW, rate=0.001)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small network."""
    small = NetworkSettings(features=8, width=16, layers=2, skips=(), directions="cartesian")
    monkeypatch.setattr("prt_bake.network.settings.PRESETS", {"measured": small})
    monkeypatch.setattr(train, "PRESETS", {"measured": small})
    monkeypatch.setattr(train, "learning_for", lambda _data, started: CONTINUED if started else FEW)


def test_minutes_end_with_a_sentence_on_quality_and_parts_without_time_are_left_out(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budget, "_LATE", 1e9)
    model = tmp_path / "my m.pt"
    trained = prtbake("train", "scene.toml", "-o", model, "--minutes", 0.02)
    assert trained.code == 0, trained.err
    again = f"to write it later, run `prtbake report training '{model}' scene.toml`"
    assert f"no report: no time is left for it; {again}" in trained.err
    again = f"to fit it later, run `prtbake importance '{model}' sphere.ply`"
    assert f"no importance module: no time is left for it; {again}" in trained.err
    assert {path.name for path in tmp_path.iterdir()} == {"my m.pt", "my m.train.pt"}
    error = load_model(model).metadata["training"]["relative_rmse"]["coefficients"]
    assert f"m.pt: the network is {100 * error:.1f} % off (" in trained.out
    assert "ten minutes more would bring about" in trained.out


def test_ctrl_c_in_the_final_errors_keeps_the_model(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PathTracedData, "errors", interrupted)
    trained = prtbake("train", "scene.toml", "-o", tmp_path / "m.pt", "--steps", 2)
    assert trained.code == 1
    measuring = f"prtbake report training {tmp_path / 'm.pt'} scene.toml"
    assert f"its errors are not measured; `{measuring}` measures them" in trained.out
    assert "the training was stopped; the model is written, and --resume continues it" in trained.err
    assert isinstance(load_model(tmp_path / "m.pt"), NeuralBSSRDF)


def test_ctrl_c_in_the_report_leaves_out_the_rest(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)

    monkeypatch.setattr(report, "assess", interrupted)
    trained = prtbake("train", "scene.toml", "-o", tmp_path / "m.pt", "--steps", 2)
    assert trained.code == 130
    assert "no report: stopped; to write it later, run `prtbake report training " in trained.err
    assert "the model is complete, and what should follow it was stopped" in trained.err
    assert {path.name for path in tmp_path.iterdir()} == {"m.pt", "m.train.pt"}


def test_a_training_starts_from_an_earlier_model(prtbake: Run, tmp_path: Path) -> None:
    first, second = tmp_path / "first.pt", tmp_path / "second.pt"
    fast = ("--steps", 2, "--no-report", "--no-importance")
    assert prtbake("train", "scene.toml", "-o", first, *fast, "--seed", 3).code == 0
    trained = prtbake("train", "scene.toml", "-o", second, *fast, "--from", first)
    assert trained.code == 0, trained.err
    assert "% off" in trained.out
    assert "extrapolated" not in trained.out
    model = load_model(second)
    assert (model.metadata["started_from"], model.settings.seed) == ("scene.toml, 2 steps", 3)
    assert model.metadata["training"]["learning"]["rate"] == CONTINUED.rate
    assert "started from               scene.toml, 2 steps" in prtbake("info", second).out


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (("--from", "model.pt", "--preset", "paper"), "omit --preset"),
        (("--from", "model.pt", "--baseline", "neumip"), "omit --baseline"),
        (("--from", "scene.toml"), "expected a model (--from), found a scene"),
        (("--from", "model.pt"), "the network to start from has features 8"),
        (("--only-low-bands",), "name it with --from"),
    ],
)
def test_what_a_training_cannot_start_from(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], fault: str
) -> None:
    wide = NetworkSettings(features=12, width=16, layers=2, skips=(), directions="cartesian")
    monkeypatch.setattr(train, "PRESETS", {"measured": wide})
    refused = prtbake("train", "scene.toml", "-o", tmp_path / "m.pt", "--steps", 1, *arguments)
    assert refused.code != 0
    assert fault in " ".join(refused.err.split())
    assert not (tmp_path / "m.pt").exists()
