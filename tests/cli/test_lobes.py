"""`prtbake lobes`, and the lobes of `prtbake bake`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import check_asset, read_asset, write_asset
from prt_bake.baking.lobes import search
from prt_bake.lobes.rounding import change
from tests.conftest import Run


def test_a_bake_says_what_lobes_gain(prtbake: Run, tmp_path: Path) -> None:
    bake = ["bake", "model.pt", "sphere.ply", "--rings", 8, "--sectors", 16, "--samples", 18]
    outcome = prtbake(*bake, "-o", tmp_path / "with.h5")
    assert outcome.code == 0
    assert "of the transport lies beyond the harmonics" in outcome.out
    asset = read_asset(tmp_path / "with.h5")
    assert asset.lobes is not None
    assert check_asset(tmp_path / "with.h5") == []
    none = prtbake(*bake, "--lobes", 0, "-o", tmp_path / "without.h5")
    assert "lobes: none, not requested" in none.out
    assert read_asset(tmp_path / "without.h5").lobes is None


def test_lobes_are_added_beside_the_asset(
    prtbake: Run, tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search, "MOST_SHARPNESS", 6.0)  # as in the shared asset
    baked = read_asset(folder / "asset.h5")
    write_asset(replace(baked, lobes=None), tmp_path / "asset.h5")
    outcome = prtbake("lobes", "model.pt", tmp_path / "asset.h5")
    assert outcome.code == 0
    assert f"{tmp_path / 'asset.lobes.h5'}: lobes: " in outcome.out
    added = read_asset(tmp_path / "asset.lobes.h5")
    assert added.lobes is not None
    assert baked.lobes is not None
    assert added.lobes.powers.shape == baked.lobes.powers.shape
    np.testing.assert_array_equal(added.coefficients, baked.coefficients)
    assert added.provenance["lobes"]["source"] == "model.pt"
    assert "lobes" in prtbake("info", tmp_path / "asset.lobes.h5").out
    assert "replace" not in outcome.out
    again = prtbake("lobes", "model.pt", tmp_path / "asset.lobes.h5", "-o", tmp_path / "again.h5")
    assert f"; they replace the {added.lobes.count} that the asset had" in again.out


def test_a_path_traced_bake_takes_the_lobes_of_a_network(prtbake: Run, tmp_path: Path) -> None:
    traced = ["bake", "scene.toml", "sphere.ply", "--rings", 2, "--sectors", 4, "--samples", 64]
    assert prtbake(*traced, "-o", tmp_path / "traced.h5").code == 0
    assert prtbake("lobes", "model.pt", tmp_path / "traced.h5", "-o", tmp_path / "lobed.h5").code == 0
    traced_asset, lobed = read_asset(tmp_path / "traced.h5"), read_asset(tmp_path / "lobed.h5")
    assert traced_asset.lobes is None
    assert lobed.lobes is not None
    np.testing.assert_array_equal(lobed.coefficients, traced_asset.coefficients)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["scene.toml", "asset.h5"], "expected a model (MODEL), found a scene; train one on it first"),
        (["model.pt", "sphere.ply"], "expected an asset (ASSET), found a mesh"),
        (["model.pt", "asset.h5", "-o", "asset.h5"], "is also the input given as ASSET"),
    ],
)
def test_refusals(prtbake: Run, arguments: list[str], sentence: str, tmp_path: Path) -> None:
    output = [] if "-o" in arguments else ["-o", tmp_path / "out.h5"]
    outcome = prtbake("lobes", *arguments, *output)
    assert outcome.code != 0
    assert sentence in outcome.err
    assert not (tmp_path / "out.h5").exists()


def test_a_dry_run_states_the_cost_of_lobes(prtbake: Run) -> None:
    outcome = prtbake("bake", "model.pt", "sphere.ply", "--rings", 4, "--sectors", 8, "--dry-run")
    assert '"lobes_in_a_view"' in outcome.out
    assert '"bytes"' in outcome.out
    hurried = prtbake("bake", "model.pt", "sphere.ply", "--error", 0.2, "--minutes", 1e-4, "--dry-run")
    assert "more than 50% of the time limit" in hurried.out


def test_pictures_show_lobes_unless_suns_are_plain(prtbake: Run, tmp_path: Path) -> None:
    light = ["--light", "sun:0.3,1,0.2:3,3,3:0.5", "--size", "32x24"]
    for name, options, said in (
        ("lobes", [], "lobes shown"),
        ("plain", ["--suns", "plain"], "no lobes with --suns plain"),
    ):
        outcome = prtbake("shade", "asset.h5", *light, *options, "-o", tmp_path / f"{name}.exr")
        assert outcome.code == 0
        assert said in outcome.out
    lobes, plain = (prt.read_image(tmp_path / f"{name}.exr") for name in ("lobes", "plain"))
    assert np.abs(lobes - plain).max() > 0.01 * plain.max()


def test_compression_keeps_lobes_or_leaves_them_out(prtbake: Run, tmp_path: Path, folder: Path) -> None:
    baked = read_asset(folder / "asset.h5")
    assert baked.lobes is not None
    for option, kept in ((["--lobes"], True), (["--no-lobes"], False)):
        out = tmp_path / f"{kept}.h5"
        assert prtbake("compress", "asset.h5", "--error", 0.1, *option, "-o", out).code == 0
        lobes = read_asset(out).lobes
        assert (lobes is not None) == kept
        assert bool(read_asset(out).provenance["lobes"]["lobes_in_a_view"]) == kept
        if lobes is not None:
            np.testing.assert_allclose(lobes.axes, baked.lobes.axes, atol=2e-3)


def test_compression_rounds_lobes_within_twice_its_error(prtbake: Run, tmp_path: Path) -> None:
    bake = ["bake", "model.pt", "sphere.ply", "--rings", 8, "--sectors", 32, "--samples", 18]
    assert prtbake(*bake, "-o", tmp_path / "asset.h5").code == 0
    baked = read_asset(tmp_path / "asset.h5")
    assert baked.lobes is not None
    bins = baked.coefficients.shape[1]
    squares = np.square(baked.coefficients[baked.valid], dtype=np.float64).sum() * baked.lobes.axes.shape[1] / bins
    for error in (0.02, 0.2):
        outcome = prtbake("compress", tmp_path / "asset.h5", "--error", error, "-o", tmp_path / "a.h5", "--force")
        assert outcome.code == 0, outcome.err
        compact = read_asset(tmp_path / "a.h5")
        assert compact.lobes is not None
        assert check_asset(tmp_path / "a.h5") == []
        changed = change(baked.lobes, compact.lobes) / np.sqrt(squares)
        assert 0.2 * error < changed <= 2.0 * error
        stated = compact.provenance["compression"]["lobes_error"]
        assert stated == pytest.approx(changed, rel=0.05)
        assert f"rounding the lobes adds {stated:.3%}" in outcome.out
        assert f"{(tmp_path / 'a.h5').stat().st_size:,} bytes, 1/" in outcome.out
    without = ["compress", tmp_path / "asset.h5", "--error", 0.2, "--no-lobes", "-o", tmp_path / "without.h5"]
    assert prtbake(*without).code == 0
    assert read_asset(tmp_path / "without.h5").provenance["lobes"]["lobes_in_a_view"] == 0
