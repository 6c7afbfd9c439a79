"""`prtbake train --baseline`, and the commands that take what it writes."""

import io
import shutil
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest

from formats.mesh import write_mesh
from prt_bake.baselines import neumip_training
from prt_bake.cli.main import main
from prt_bake.network.bssrdf import load_model
from tests.baselines.shapes import ball_of_charts
from tests.cli.command_line import Run
from tests.trainer.small_training import SCENE


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with a ball and a NeuMIP of it after two steps, and what the command said."""
    folder, said = tmp_path_factory.mktemp("trained"), io.StringIO()
    write_mesh(ball_of_charts(), folder / "ball.obj")
    (folder / "ball.toml").write_text(SCENE.format(eta=1.0, roughness=0.0).replace("ball.ply", "ball.obj"))
    few = replace(neumip_training.LEARNING, batch=64, held_out_queries=16, held_out_walks=16)
    command = "train ball.toml -o m.pt --baseline neumip --steps 2 --no-report --no-importance"
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(said):
        patch.chdir(folder)
        patch.setattr(neumip_training, "LEARNING", few)
        assert main(command.split()) == 0
    return folder, said.getvalue()


@pytest.fixture
def trained(prtbake: Run, training: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the model beside a copy of its scene, in the working directory."""
    shutil.copytree(training[0], tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "m.pt"


def test_it_says_what_it_wrote_and_what_is_next(training: tuple[Path, str]) -> None:
    assert "m.pt: 2 steps" in training[1]
    assert "next: prtbake bake m.pt ball.obj -o m.h5" in training[1]


def test_its_model_is_described_checked_baked_and_rendered(prtbake: Run, trained: Path) -> None:
    assert load_model(trained).kind == "neumip"
    described = prtbake("info", trained, "--all")
    assert described.code == 0, described.err
    assert "neumip" in described.out
    assert prtbake("check", trained).code == 0
    coarse = ("--rings", 1, "--sectors", 4, "--samples", 18)
    baked = prtbake("bake", trained, "ball.obj", "-o", "m.h5", *coarse)
    assert baked.code == 0, baked.err
    shaded = prtbake("shade", "m.h5", "--light", "sun:0,1,0", "-o", "m.png", "--size", "16x16")
    assert shaded.code == 0, shaded.err
    rendered = prtbake(
        "render", trained, "ball.obj", "--light", "sun:0,1,0", "-o", "r.png", "--size", "8x8", "--spp", 2
    )
    assert rendered.code == 0, rendered.err


def test_an_unknown_baseline_names_those_that_exist(prtbake: Run, trained: Path) -> None:
    run = prtbake("train", "ball.toml", "-o", "n.pt", "--baseline", "neumop", "--steps", 2)
    assert run.code == 1
    assert "baseline: expected one of neumip, neumip-pyramid, neumip-log" in run.err
    assert "found 'neumop'" in run.err


@pytest.mark.usefixtures("coarse_interior")
def test_another_kind_of_model_is_not_resumed(prtbake: Run, trained: Path) -> None:
    run = prtbake("train", "ball.toml", "-o", "m.pt", "--resume", "--steps", 4)
    assert run.code == 1
    assert "m.train.pt: the run trains a model of another kind; request the same --baseline" in run.err
