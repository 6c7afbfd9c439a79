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


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small network."""
    small = NetworkSettings(features=8, width=16, layers=2, skips=(), directions="cartesian")
    monkeypatch.setattr("prt_bake.network.settings.PRESETS", {"measured": small})
    monkeypatch.setattr(train, "learning_for", lambda _data: FEW)


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
