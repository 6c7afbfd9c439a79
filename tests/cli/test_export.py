import dataclasses
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import read_asset
from prt_bake.export.engine_errors import errors_by_degree
from tests.cli.command_line import Run
from tests.export.assets import smooth_asset
from tests.export.glb_reader import read_glb
from tests.export.test_onto import textured


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    prt.write_asset(smooth_asset(), tmp_path / "smooth.h5")
    return tmp_path / "smooth.h5"


def test_a_glb_states_its_error_and_what_is_not_in_it(prtbake: Run, asset: Path, tmp_path: Path) -> None:
    outcome = prtbake("export", asset, "-o", tmp_path / "x.glb")
    assert outcome.code == 0
    stated = read_glb(tmp_path / "x.glb").extras["error"]
    assert f"coefficients {stated['coefficients']:.2%}" in outcome.out
    assert f"at worst {stated['radiance_worst']:.2%}" in outcome.out
    assert "not in the file: light reflected at the surface" in outcome.out
    assert f"{(tmp_path / 'x.glb').stat().st_size:,} bytes" in outcome.out


def test_onto_keeps_the_file_that_was_baked(prtbake: Run, tmp_path: Path) -> None:
    user = textured().write(tmp_path / "user.glb")
    prt.write_asset(smooth_asset(prt.read_mesh(user)), tmp_path / "user.h5")
    assert prtbake("export", tmp_path / "user.h5", "-o", tmp_path / "x.glb", "--onto", user).code == 0
    document = read_glb(tmp_path / "x.glb").document
    assert [material.get("name") for material in document["materials"]] == [None, "plain"]
    assert document["meshes"][0]["extras"]["prtbake"]["local_to_object"][0] != 1.0
    outcome = prtbake("export", tmp_path / "user.h5", "-o", user, "--onto", user)
    assert outcome.code == 1
    assert "user.glb: is also the input given as --onto" in outcome.err


def test_the_error_chooses_the_degree(prtbake: Run, asset: Path, tmp_path: Path) -> None:
    assert prtbake("export", asset, "-o", tmp_path / "x.glb", "--error", 0.1).code == 0
    loose = read_glb(tmp_path / "x.glb").extras
    assert prtbake("export", asset, "-o", tmp_path / "x.glb", "--error", 0.03).code == 0
    tight = read_glb(tmp_path / "x.glb").extras
    assert loose["view_degree"] < tight["view_degree"]
    assert tight["error"]["coefficients"] <= 0.03 < loose["error"]["coefficients"] <= 0.1
    outcome = prtbake("export", asset, "-o", tmp_path / "y.glb", "--error", 1e-5)
    assert outcome.code == 1
    assert "harmonics of the view of degree 8 leave" in outcome.err
    assert not (tmp_path / "y.glb").exists()


def test_the_error_holds_for_rounded_numbers(prtbake: Run, asset: Path, tmp_path: Path) -> None:
    """The least degree within it before they are rounded is not enough, and the next one is taken."""
    exact = errors_by_degree(read_asset(asset))
    within = 1.0001 * float(exact[3])
    for options, degree in (((), 3), (("--quantize", "int8"), 4)):
        assert prtbake("export", asset, "-o", tmp_path / "x.glb", "--error", within, *options).code == 0
        stated = read_glb(tmp_path / "x.glb").extras
        assert stated["view_degree"] == degree
        assert stated["error"]["coefficients"] <= within
    outcome = prtbake("export", asset, "-o", tmp_path / "y.glb", "--error", 1.0001 * min(exact), "--quantize", "int8")
    assert outcome.code == 1
    assert "rounded numbers leave" in outcome.err


@pytest.mark.parametrize("name", ["x.glb", "x.exr"])
def test_only_an_earlier_export_is_replaced(prtbake: Run, asset: Path, tmp_path: Path, name: str) -> None:
    """A modelled mesh, or a texture, may have the name of the asset."""
    others = ["x.glb"] if name == "x.glb" else ["x.exr", "x.json", "x.mesh.glb"]
    for other in others:
        textured().write(tmp_path / other) if other.endswith(".glb") else (tmp_path / other).write_text('{"mine": 1}')
        before = (tmp_path / other).read_bytes()
        outcome = prtbake("export", asset, "-o", tmp_path / name)
        assert outcome.code == 1
        assert f"{other}: already exists, and is no export of prtbake; choose another name" in outcome.err
        assert (tmp_path / other).read_bytes() == before
        (tmp_path / other).unlink()
    for _ in range(2):
        assert prtbake("export", asset, "-o", tmp_path / name).code == 0


def test_lights_are_folded_in_together(prtbake: Run, asset: Path, tmp_path: Path) -> None:
    lights = ("--light", "sky.hdr", "--light", "sun:0,1,0:3,2,1")
    assert prtbake("export", asset, "-o", tmp_path / "x.glb", "--quantize", "int8", *lights).code == 0
    extras = read_glb(tmp_path / "x.glb").extras
    assert (extras["quantity"], extras["quantize"], extras["light"]["name"]) == (
        "radiance",
        "int8",
        "sky.hdr + sun:0,1,0:3,2,1",
    )
    sky = prt.project_environment(prt.read_environment("sky.hdr"))
    sun = prt.sh.evaluate([0.0, 1.0, 0.0], 2)[:, None] * [3.0, 2.0, 1.0]
    np.testing.assert_allclose(extras["light"]["coefficients"], sky + sun, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("-o x.ply --to glb", "expected a name that ends in .glb; give -o x.glb"),
        ("smooth.h5 -o x.glb", "is made of one SOURCE, found 2"),
        ("-o x --to mitsuba", "--to mitsuba does not take this kind of file, asset; expected --to glb or exr or site"),
    ],
)
def test_what_cannot_be_written_is_refused(
    prtbake: Run, asset: Path, monkeypatch: pytest.MonkeyPatch, options: str, sentence: str
) -> None:
    monkeypatch.chdir(asset.parent)
    outcome = prtbake("export", "smooth.h5", *options.split())
    assert outcome.code == 1
    assert sentence in outcome.err


def test_a_scene_does_not_become_a_folder_named_glb(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    outcome = prtbake("export", folder / "scene.toml", "-o", tmp_path / "x.glb")
    assert outcome.code == 1
    assert "--to glb does not take this kind of file, scene; expected --to mitsuba" in outcome.err
    assert not (tmp_path / "x.glb").exists()


def test_a_high_error_names_the_degree_if_a_higher_one_is_left(prtbake: Run, asset: Path, tmp_path: Path) -> None:
    remedy = "a higher --degree, up to 8, lowers the error of the coefficients"
    assert remedy in prtbake("export", asset, "-o", tmp_path / "x.glb", "--degree", 1).err
    rough = smooth_asset()
    noise = np.random.default_rng(0).normal(size=rough.coefficients.shape).astype(np.float32)
    prt.write_asset(dataclasses.replace(rough, coefficients=noise), tmp_path / "rough.h5")
    outcome = prtbake("export", tmp_path / "rough.h5", "-o", tmp_path / "x.glb", "--degree", 8)
    assert outcome.code == 0
    assert remedy not in outcome.err


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("smooth.h5 -o x.glb --force", "--force: has no effect on --to glb"),
        ("smooth.h5 -o x --degree 3", "--degree: has no effect on --to site"),
        ("scene.toml -o x --light sky.hdr", "--light: has no effect on --to mitsuba"),
        ("smooth.h5 -o x.glb --error 2", "2 is not between 0 and 1"),
        ("smooth.h5 -o x.glb --degree 9", "less than or equal to 8"),
    ],
)
def test_options_without_an_effect_are_refused(
    prtbake: Run, asset: Path, folder: Path, line: str, sentence: str
) -> None:
    names = {"smooth.h5": asset, "scene.toml": folder / "scene.toml"}
    outcome = prtbake("export", *(names.get(word, word) for word in line.split()))
    assert outcome.code == 2
    assert sentence in " ".join(outcome.err.split())
