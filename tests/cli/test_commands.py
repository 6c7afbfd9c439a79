"""The commands of `prtbake`, run as a user types them."""

import json
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from formats.asset import read_asset
from formats.image import read_image, write_image
from formats.mesh import read_mesh
from prt_bake import load_model
from prt_bake.baking import bake
from prt_bake.rendering.loop import SHOWS_REFLECTION
from prt_bake.rendering.network import SHOWS as SHOWS_NETWORK
from prt_bake.rendering.scene import SHOWS, SHOWS_ROUGH
from prt_bake.shipped import demonstration
from tests.cli.command_line import Run


def test_help_lists_every_command_and_loads_no_slow_library() -> None:
    ran = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "prt_bake.cli", "--help"], capture_output=True, text=True, check=True
    )
    commands = {"demo", "train", "bake", "light", "shade", "render", "compare", "export", "info", "check", "sample"}
    assert commands <= set(ran.stdout.split())
    loaded = {line.rsplit("|", 1)[-1].strip() for line in ran.stderr.splitlines()}
    assert "typer" in loaded
    assert not loaded & {
        "torch",
        "numba",
        "numpy",
        "h5py",
        "scipy",
        "trimesh",
        "pyvista",
        "pydantic",
        "embreex",
        "OpenEXR",
    }


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["light"],
        ["light", "sky.exr", "--degree", "-1"],
        ["light", "sky.exr", "--rotate", "nan"],
        ["bake", "--what"],
        ["train", "scene.toml", "-o", "m.pt", "--device", "abacus"],
    ],
)
def test_wrong_usage_is_exit_code_2(prtbake: Run, arguments: list[str]) -> None:
    assert prtbake(*arguments).code == 2


@pytest.mark.parametrize("size", ["12", "0x4", "axb", "4x4x4"])
def test_an_invalid_size_is_wrong_usage(prtbake: Run, size: str) -> None:
    assert prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", "x.png", "--size", size).code == 2


def test_light_of_a_constant_sky(prtbake: Run) -> None:
    outcome = prtbake("light", "sky.exr", "--json")
    coefficients = np.array(json.loads(outcome.out)["coefficients"])
    assert coefficients.shape == (9, 3)
    np.testing.assert_allclose(coefficients[0], np.sqrt(4 * np.pi), rtol=1e-12)
    assert np.abs(coefficients[1:]).max() < 1e-12
    table = prtbake("light", "sky.hdr").out.splitlines()
    assert len(table) == 10
    assert table[1].split()[:3] == ["0", "0", "3.5449077"]


def test_light_repairs_pixels_on_request(prtbake: Run, tmp_path: Path) -> None:
    image = np.ones((8, 16, 3), np.float32)
    image[2, 3, 1] = np.nan
    write_image(tmp_path / "nan.exr", image)
    refused = prtbake("light", tmp_path / "nan.exr")
    assert refused.code == 1
    assert "row 2, column 3" in refused.err
    mended = prtbake("light", tmp_path / "nan.exr", "--mend")
    assert mended.code == 0
    assert "1 NaN" in mended.err


def test_bake_writes_an_asset_and_a_report(prtbake: Run, tmp_path: Path) -> None:
    output, report = tmp_path / "a.h5", tmp_path / "r.json"
    options = ["--rings", "2", "--sectors", "4", "--samples", "18", "--storage", "float32", "--seed", "3"]
    outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", output, *options, "--report", report)
    assert outcome.code == 0
    assert "42 of 42 vertices" in outcome.out
    asset = read_asset(output)
    assert asset.coefficients.shape == (42, 8, 9, 3)
    assert asset.up == "z"
    assert asset.complete
    assert asset.provenance["seed"] == 3
    assert asset.provenance["command"].startswith("prtbake bake model.pt sphere.ply")
    reported = json.loads(report.read_text())
    assert reported["evaluations"] == 42 * 8 * 18
    assert reported["estimated_relative_rmse"]["total"] > 0


def test_a_scene_is_path_traced(prtbake: Run, tmp_path: Path) -> None:
    options = ["--rings", "1", "--sectors", "2", "--degree", "0", "--samples", "64"]
    assert prtbake("bake", "scene.toml", "sphere.ply", "-o", tmp_path / "a.h5", *options).code == 0
    coefficients = np.asarray(read_asset(tmp_path / "a.h5").coefficients, np.float64)
    furnace = coefficients[..., 0, :] * np.sqrt(4 * np.pi)
    assert 0.2 < furnace.mean() < 1.0


@pytest.mark.parametrize("suffix", [".pt", ".onnx"])
def test_a_function_of_another_program_is_baked_by_its_convention(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    import torch

    class Constant(torch.nn.Module):
        def forward(self, rows: torch.Tensor) -> torch.Tensor:
            return torch.ones_like(rows[:, :3]) * 0.25

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if suffix == ".onnx":
            axes = {"dynamic_axes": {"x": {0: "n"}}, "input_names": ["x"]}
            torch.onnx.export(Constant(), (torch.zeros(2, 7),), tmp_path / "other.onnx", dynamo=False, **axes)
        else:
            torch.jit.save(torch.jit.trace(Constant(), torch.zeros(2, 7)), tmp_path / "other.pt")
    other = tmp_path / f"other{suffix}"
    options = ["-o", tmp_path / "a.h5", "--rings", 1, "--sectors", 2, "--convention", "incident, position, outgoing"]
    assert prtbake("bake", other, "sphere.ply", *options).code == 0
    coefficients = np.asarray(read_asset(tmp_path / "a.h5").coefficients, np.float64)
    np.testing.assert_allclose(coefficients[:, :, 0], 0.25 * np.sqrt(4 * np.pi), rtol=1e-3)
    assert np.abs(coefficients[:, :, 1:]).max() < 1e-3
    outcome = prtbake("lobes", other, tmp_path / "a.h5", *options[-2:])
    assert outcome.code == 0
    assert (tmp_path / "a.lobes.h5").is_file()
    if suffix == ".onnx":
        checked = prtbake("check", other)
        assert checked.code == 0
        assert "next: prtbake bake" in checked.err
        assert "--convention 'incident, position, outgoing'" in checked.err
    undescribed = prtbake("bake", other, "sphere.ply", "-o", tmp_path / "b.h5")
    assert undescribed.code == 1
    assert "describe its 7 inputs there with --convention" in undescribed.err


def test_a_dry_run_writes_nothing(prtbake: Run, tmp_path: Path) -> None:
    outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", "--samples", 18, "--dry-run")
    assert json.loads(outcome.out)["evaluations"] == 42 * 1024 * 18
    assert list(tmp_path.iterdir()) == []
    assert outcome.err.startswith("prtbake: predicts the bake from pilots and some of its blocks")
    few = ("--rings", 2, "--sectors", 8)
    without = prtbake("bake", "model.pt", "sphere.ply", "--samples", 18, "--dry-run", *few)
    assert json.loads(without.out)["evaluations"] == 42 * 16 * 18


def test_a_bake_without_an_output_is_wrong_usage(prtbake: Run) -> None:
    outcome = prtbake("bake", "model.pt", "sphere.ply")
    assert outcome.code == 2
    assert "Missing option '--output' / '-o'" in outcome.err


def test_the_plan_on_a_terminal(folder: Path) -> None:
    from prt_bake.cli.shared.plan import plan_lines

    plan = bake.plan(
        load_model(folder / "model.pt"), read_mesh(folder / "sphere.ply"), samples=18, leave_out=["unseen"]
    )
    lines = list(plan_lines(plan))
    assert lines[0] == "42 vertices × 1,024 view bins, 9 SH coefficients"
    assert "774,144 evaluations, 18.0 per bin" in lines
    assert lines[3] == "bakes with 18 directions per view bin"
    assert lines[4].startswith("about ")
    assert any(line.startswith("kept: unseen: 0 of 42 vertices") for line in lines)


def test_a_bake_without_options_says_its_default(prtbake: Run, tmp_path: Path) -> None:
    bins = ["--rings", 1, "--sectors", 4, "--lobes", 0]
    baked = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", *bins)
    assert "bakes to 2 % error, the default; --error, --minutes or --samples choose another" in baked.err
    assert (
        "prtbake: bakes for 0.02 minutes\n"
        in prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "b.h5", *bins, "--minutes", 0.02).err
    )


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("--error", 0, "0 is not between 0 and 1"),
        ("--error", 1, "1 is not between 0 and 1"),
        ("--error", "nan", "nan is not between 0 and 1"),
        ("--minutes", 0, "0 is not above 0"),
        ("--samples", 0, "greater than or equal to 1"),
    ],
)
def test_numbers_out_of_range_are_wrong_usage(prtbake: Run, option: str, value: object, sentence: str) -> None:
    outcome = prtbake("bake", "nothing.pt", "nothing.ply", "-o", "a.h5", option, value)
    assert outcome.code == 2
    assert sentence in outcome.err


def test_a_missing_scheduler_is_reported_in_one_sentence(prtbake: Run, tmp_path: Path) -> None:
    import dask
    import distributed  # noqa: F401 - its own settings are there before one of them is changed

    address = "tcp://127.0.0.1:9"
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", "--scheduler", address)
    assert outcome.code == 1
    assert f"scheduler {address}: no scheduler of dask.distributed answers there" in outcome.err
    assert "Traceback" not in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_resuming_without_a_checkpoint_starts_from_the_beginning(prtbake: Run, tmp_path: Path) -> None:
    options = ["--rings", 1, "--sectors", 2, "--samples", 18, "--resume"]
    outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", *options)
    assert outcome.code == 0
    assert "a.h5.journal: there is no checkpoint to resume from; the bake starts from the beginning" in outcome.err


def test_the_report_states_whether_the_error_was_reached(prtbake: Run, tmp_path: Path) -> None:
    options = ["--rings", 1, "--sectors", 2, "--report", tmp_path / "r.json"]
    for error, minutes, reached in ((0.5, [], True), (1e-5, ["--minutes", 0.05], False)):
        outcome = prtbake(
            "bake", "model.pt", "sphere.ply", "-o", tmp_path / f"{reached}.h5", "--error", error, *minutes, *options
        )
        assert outcome.code == 0, outcome.err
        assert json.loads((tmp_path / "r.json").read_text())["error_reached"] is reached
        assert ("was not reached" in outcome.out) is not reached


def test_render_and_compare_with_itself(prtbake: Run, tmp_path: Path) -> None:
    output = tmp_path / "reference.exr"
    options = ["-o", output, "--size", "16x12", "--spp", 4]
    outcome = prtbake("render", "scene.toml", "sphere.ply", "--light", "sky.exr", *options)
    assert outcome.code == 0
    compared = prtbake("compare", output, output, "--json")
    figures = json.loads(compared.out)
    assert figures["mse"] == 0
    assert figures["flip"] == pytest.approx(0, abs=1e-6)
    assert figures["ssim"] == pytest.approx(1)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--exposure", 1], "--exposure: has no effect on .exr, which"),
        (["--exposure", 1, "--preview", "p.hdr"], "--exposure: has no effect on .exr and .hdr, which"),
        (["--orthographic", "--fov", 50], "has no field of view"),
        (["--every", 2], "--every: has no effect without --preview"),
        (["--normals", "face"], "--normals: applies to the reflection; add --reflection"),
        (["--view", "left", "--eye", "0,0,5"], "--view: --eye places the camera; omit one of them"),
        # The exposure applies to the preview, so that only the field of view is wrong.
        (["--exposure", 1, "--preview", "p.png", "--extent", 3, "--fov", 50], "has no field of view"),
    ],
)
def test_ineffective_options_of_render_are_wrong_usage(prtbake: Run, options: list[object], sentence: str) -> None:
    small = ("-o", "a.exr", "--size", "16x12", "--spp", 2)
    outcome = prtbake("render", "scene.toml", "sphere.ply", "--light", "sky.exr", *small, *options)
    assert outcome.code == 2
    assert sentence in outcome.err


def test_a_report_of_a_bake_takes_a_view_or_an_eye(prtbake: Run, tmp_path: Path) -> None:
    both = ["--view", "front", "--eye", "0,0,5", "--out", tmp_path / "report"]
    outcome = prtbake("report", "bake", "model.pt", "sphere.ply", *both)
    assert outcome.code == 2
    assert "--view: --eye places the camera; omit one of them" in outcome.err


def test_info_prints_one_figure_per_line(prtbake: Run) -> None:
    lines = prtbake("info", demonstration.MODEL, "--all").out.splitlines()
    figures = dict(line.split("  ", 1) for line in lines)
    assert float(figures["training: relative_rmse: coefficients"]) < 0.2
    assert max(map(len, lines)) < 160
    assert not any("{" in line for line in lines)


def test_compare_names_files_of_different_size(prtbake: Run, tmp_path: Path) -> None:
    for name, width in (("a.exr", 20), ("b.exr", 24)):
        write_image(tmp_path / name, np.ones((16, width, 3), np.float32))
    outcome = prtbake("compare", tmp_path / "a.exr", tmp_path / "b.exr")
    assert outcome.code == 1
    assert f"a.exr: is 20x16, but {tmp_path / 'b.exr'} is 24x16" in outcome.err.replace("\n", "")


@pytest.mark.parametrize(
    ("model", "scene", "message"),
    [
        (SHOWS_NETWORK, SHOWS["all"], "b.exr holds unscattered light, a.exr does not: "),
        (SHOWS_NETWORK + SHOWS_REFLECTION, SHOWS["scattered"], "a.exr holds light reflected at the surface, b.exr"),
        (SHOWS_NETWORK, SHOWS["scattered"], ""),
        (SHOWS_NETWORK + SHOWS_REFLECTION, SHOWS_ROUGH + SHOWS_REFLECTION, ""),
        (None, SHOWS["all"], ""),
    ],
)
def test_compare_reports_light_that_only_one_picture_holds(
    prtbake: Run, tmp_path: Path, model: str | None, scene: str, message: str
) -> None:
    for name, shows in (("a.exr", model), ("b.exr", scene)):
        texts = {} if shows is None else {"prtbake.shows": shows}
        write_image(tmp_path / name, np.ones((16, 20, 3), np.float32), attributes=texts)
    outcome = prtbake("compare", tmp_path / "a.exr", tmp_path / "b.exr")
    assert outcome.code == 0
    printed = outcome.err.replace("\n", "").replace(f"{tmp_path}/", "")
    assert message in printed if message else "holds" not in printed


@pytest.mark.statistics
def test_demo_bakes_relights_and_measures_the_shipped_object(
    prtbake: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = folder / "reference.json"
    size = ["-o", "reference.exr", "--size", "16x16", "--spp", 8, "--report", report]
    assert prtbake("render", "scene.toml", "sphere.ply", "--light", "sky.exr", *size).code == 0
    shipped = {"MODEL": "model.pt", "MESH": "sphere.ply", "SKY": "sky.exr", "REFERENCE": "reference.exr"}
    for name, file in {**shipped, "REFERENCE_REPORT": report.name}.items():
        monkeypatch.setattr(demonstration, name, folder / file)
    outcome = prtbake("demo", "--out", tmp_path / "new" / "demo", "--workers", 1)
    assert outcome.code == 0, outcome.err
    (successor,) = outcome.err.splitlines()
    assert successor.startswith("next: prtbake ")
    assert str(tmp_path / "new" / "demo" / "spot.h5") in successor
    made = ["comparison.png", "error.png", "report.json", "spot.exr", "spot.h5", "spot.png"]
    assert sorted(path.name for path in (tmp_path / "new" / "demo").iterdir()) == made
    assert [word for word in ["MSE", "SSIM", "FLIP", "noise", *made] if word not in outcome.out] == []
    assert read_image(tmp_path / "new" / "demo" / "spot.exr").shape == (16, 16, 3)
    figures = json.loads((tmp_path / "new" / "demo" / "report.json").read_text())
    assert figures["bake"]["complete"]
    assert figures["object"]["mse"] > 0


@pytest.mark.parametrize(
    ("file", "kind"),
    [
        *(("sphere.ply", "mesh"), ("sky.exr", "picture"), ("scene.toml", "scene")),
        *(("model.pt", "model"), ("asset.h5", "asset")),
    ],
)
def test_info_and_check_of_every_kind(prtbake: Run, file: str, kind: str) -> None:
    assert json.loads(prtbake("info", file, "--json").out)["kind"] == kind
    screen = prtbake("info", file)
    assert screen.out.startswith("kind ")
    assert kind in screen.out.splitlines()[0]
    assert len(screen.out.splitlines()) + len(screen.err.splitlines()) <= 25
    checked = prtbake("check", file)
    assert (checked.code, checked.out) == (0, f"{file}: sound\n")
    assert screen.err == f"prtbake: every figure: prtbake info {file} --all\n{checked.err}"
    assert checked.err.startswith("next: prtbake ") if kind != "picture" else not checked.err


def test_a_path_traced_bake_reports_the_limits_of_its_figures(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    thin = (folder / "scene.toml").read_text().replace("4.0", "0.5")
    (folder / "thin.toml").write_text(thin)
    few = ["--rings", 2, "--sectors", 2, "--samples", 16]
    baked = prtbake("bake", "thin.toml", "sphere.ply", "-o", tmp_path / "a.h5", *few)
    assert baked.code == 0, baked.err
    first, *remarks = baked.out.splitlines()
    assert "42 of 42 vertices" in first
    assert "estimated relative RMSE of the path tracing" in first
    assert "of the view on average, is not in the coefficients" in remarks[0]
    assert remarks[1] == ("100.0% of the bins have too few paths for a reliable error estimate; increase --samples")
    assert prtbake("check", tmp_path / "a.h5").code == 0
    alone = prtbake("bake", "thin.toml", "sphere.ply", "-o", tmp_path / "b.h5", *few, "--workers", 1)
    assert alone.code == 0
    first, second = (read_asset(tmp_path / name).coefficients for name in ("a.h5", "b.h5"))
    np.testing.assert_array_equal(first, second)


def test_check_names_every_fault(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "open.ply").write_bytes((folder / "open.ply").read_bytes())
    checked = prtbake("check", tmp_path / "open.ply")
    assert checked.code == 1
    assert "4 edges" in checked.out
    assert "1 fault" in checked.err


def test_check_remarks_on_a_part_that_sticks_out(prtbake: Run, folder: Path) -> None:
    twin = '[[inside]]\nname = "twin"\nmesh = "moved.obj"\n[inside.medium]\nmaterial = "whole milk"\n'
    rows = [f"v {x} {y} {z}" for x, y, z in ((0, 0, 0), (2, 0, 0), (0, 0.5, 0), (0, 0, 0.5))]
    (folder / "moved.obj").write_text("\n".join([*rows, "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]))
    (folder / "twins.toml").write_text((folder / "scene.toml").read_text() + twin)
    checked = prtbake("check", "twins.toml")
    assert checked.code == 0
    assert checked.out.startswith("remark: twins.toml: 'twin' sticks out of 'object' by 0.29 of its diagonal (1 of 4 ")
    assert checked.out.endswith("twins.toml: sound\n")
    description = json.loads(prtbake("info", "twins.toml", "--json").out)
    assert (description["parts"], description["twin: in"]) == (2, "object")
    assert description["twin: material"] == "whole milk, measured with eta 1.3; the scene uses eta 1"
