"""A training that is stopped keeps its model, measures nothing, and can be resumed."""

import dataclasses
from pathlib import Path

import pytest

from prt_bake.network.bssrdf import load_model
from prt_bake.network.file_names import state_path
from prt_bake.trainer.training_data import PathTracedData
from tests.trainer.small_training import LEARNING, make_scene, train_small

FEW = dataclasses.replace(LEARNING, held_out_queries=16, held_out_walks=16)


def test_a_stopped_run_measures_nothing_and_resumes(tmp_path: Path) -> None:
    scene, output, asked = make_scene(tmp_path), tmp_path / "m.pt", iter(range(100))
    network = train_small(scene, 12, output=output, learning=FEW, stop=lambda: next(asked) == 5)
    training = network.metadata["training"]
    assert (training["steps"], training["stopped"]) == (5, True)
    assert "relative_rmse" not in training
    assert load_model(output).metadata["training"] == training
    parts: list[str] = []
    resumed = train_small(
        scene, 12, output=output, learning=FEW, resume=True, part=lambda name, share: parts.append(name)
    )
    assert resumed.metadata["training"]["steps"] == 12
    assert resumed.metadata["training"]["stopped"] is False
    assert resumed.metadata["training"]["relative_rmse"]["coefficients"] > 0.0
    assert list(dict.fromkeys(parts)) == ["validation queries", "learning", "final errors"]


def test_an_interrupt_before_the_first_step_leaves_no_files(tmp_path: Path) -> None:
    scene, output = make_scene(tmp_path), tmp_path / "m.pt"
    with pytest.raises(KeyboardInterrupt):
        train_small(scene, 12, output=output, learning=FEW, stop=lambda: True)
    assert not output.exists()
    assert not state_path(output).exists()


def test_an_interrupt_of_the_final_errors_keeps_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PathTracedData, "errors", interrupted)
    network = train_small(make_scene(tmp_path), 3, output=tmp_path / "m.pt", learning=FEW)
    assert network.metadata["training"]["stopped"] is True
    assert load_model(tmp_path / "m.pt").metadata["training"]["steps"] == 3
