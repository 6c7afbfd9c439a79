"""An error that is a difference of noise and noise is unknown, not 0."""

from pathlib import Path

import pytest

from formats.asset import read_asset
from prt_bake.network.bssrdf import load_model
from tests.cli.command_line import SCENE, Run


@pytest.mark.usefixtures("coarse_interior")
def test_a_reference_that_is_only_noise_gives_no_error(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    (folder / "dim.toml").write_text(SCENE.replace("albedo = 0.9", "albedo = 1e-4"))
    model = tmp_path / "m.pt"
    options = ["--steps", 2, "--synchronous", "--no-report", "--no-importance"]
    trained = prtbake("train", "dim.toml", "-o", model, *options)
    assert trained.code == 0, trained.err
    assert trained.err.endswith(f"next: prtbake bake {model} sphere.ply -o {tmp_path / 'm.h5'}\n")
    assert "of the coefficients unknown (the noise of the reference, " in trained.out
    assert load_model(model).metadata["training"]["relative_rmse"]["coefficients"] is None
    few = ["--rings", 1, "--sectors", 1, "--samples", 16]
    baked = prtbake("bake", model, "sphere.ply", "-o", tmp_path / "a.h5", *few)
    assert baked.code == 0, baked.err
    assert "error of the coefficients unknown: the network's error is unknown, the bake is off by " in baked.out


@pytest.mark.parametrize("more", [[], ["--error", 0.2], ["--for-light", "sky.hdr"]])
def test_a_path_traced_bake_that_no_path_lit_says_so(
    prtbake: Run, folder: Path, tmp_path: Path, more: list[object]
) -> None:
    (folder / "dark.toml").write_text(SCENE.replace("albedo = 0.9", "albedo = 1e-9"))
    few = ["--rings", 1, "--sectors", 2, "--samples", 16]
    baked = prtbake("bake", "dark.toml", "sphere.ply", "-o", tmp_path / "a.h5", *few, *more)
    assert baked.code == 0, baked.err
    assert "estimated relative RMSE of the path tracing unknown\n" in baked.out
    assert "no path carried light: the object is black, or its error is unknown" in baked.out
    figures = read_asset(tmp_path / "a.h5").provenance["estimated_relative_rmse"]
    assert figures == {"total": None, "percentile_95_over_vertices": None}
    assert ("the requested error of 20.00% was not reached" in baked.out) == ("--error" in more)
    if "--for-light" in more:
        return
    shaded = prtbake("shade", tmp_path / "a.h5", "--light", "sun:0,1,0", "--size", "8x8", "-o", tmp_path / "a.exr")
    assert shaded.code == 0, shaded.err
    assert (
        "a.exr: error unknown (path traced, bake unknown, views unknown, vertices unknown, noise 0.0%, suns unknown)\n"
        in shaded.out
    )
