"""`prtbake train --baseline nerfactor-known`: its light, what it refuses, and what it says when it is stopped."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prt_bake.baselines import coarse_light, nerfactor_pictures
from prt_bake.baselines.picture_fit import PictureSettings
from prt_bake.lights.lighting import read_lighting
from prt_bake.network.bssrdf import load_model
from prt_bake.trainer.training_data import PathTracedData
from tests.cli.command_line import Run
from tests.trainer.small_training import make_scene

FEW = PictureSettings(views=2, size=8, spp=2, held_out_queries=16, held_out_walks=16)
SUN = "sun:0,1,0:3,2,1:1"
QUICK = ("--steps", 2, "--no-report", "--no-importance")


@pytest.fixture(autouse=True)
def small(prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small scene in the working directory, and few pictures."""
    monkeypatch.setattr(nerfactor_pictures, "PictureSettings", lambda: FEW)
    make_scene(tmp_path, eta=1.3, roughness=0.4)
    monkeypatch.chdir(tmp_path)


def test_it_learns_under_the_light_that_is_given(prtbake: Run) -> None:
    trained = prtbake("train", "scene.toml", "-o", "m.pt", "--baseline", "nerfactor-known", "--light", SUN, *QUICK)
    assert trained.code == 0, trained.err
    light = np.array(load_model("m.pt").metadata["training"]["light"])
    np.testing.assert_allclose(light, coarse_light(read_lighting(SUN)), rtol=1e-5)


def test_options_without_effect_are_refused(prtbake: Run) -> None:
    for arguments, message in (
        (("--light", SUN), "--light: is for --baseline nerfactor-known and nerfactor-unknown; omit it"),
        (("--light", SUN, "--baseline", "nerfactor"), "--light: is for --baseline nerfactor-known"),
        (("--preset", "paper", "--baseline", "nerfactor-known"), "--preset: is for the network; omit it"),
    ):
        refused = prtbake("train", "scene.toml", "-o", "m.pt", *arguments, *QUICK)
        assert refused.code == 2
        assert message in refused.err
    assert not Path("m.pt").exists()


def test_a_light_that_cannot_be_read_is_named(prtbake: Run) -> None:
    refused = prtbake("train", "scene.toml", "-o", "m.pt", "--baseline", "nerfactor-known", "--light", "no.hdr", *QUICK)
    assert refused.code == 1
    assert refused.err.splitlines()[-1].startswith("prtbake: no.hdr: ")


def test_ctrl_c_does_not_promise_to_resume(prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PathTracedData, "errors", interrupted)
    train = ("train", "scene.toml", "-o", "m.pt", "--baseline", "nerfactor-unknown")
    stopped = prtbake(*train, *QUICK)
    assert stopped.code == 1
    assert "--resume" not in stopped.err
    assert (
        "the model is written, and a training from pictures cannot be resumed: run it again, with --force"
        in stopped.err
    )
    assert prtbake(*train, *QUICK, "--force").code == 1
    assert load_model("m.pt").metadata["training"]["stopped"]
