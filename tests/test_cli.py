"""The commands, as a user types them."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh

from formats.asset import read_asset
from formats.image import read_image, write_image
from formats.mesh import build_mesh, write_mesh
from prt_bake import demonstration
from prt_bake.cli.main import main

SCENE = """
[object]
mesh = "sphere.ply"
unit = "cm"
[interface]
eta = 1.0
[medium]
sigma_t = 4.0
albedo = 0.9
"""


class Outcome(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Outcome]
Write = Callable[[Path, Path], object]
"""write(folder of sound files, path of the bad one)."""


@pytest.fixture
def prtbake(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path) -> Run:
    """Run a command in the shared folder and return its exit code and what it printed."""

    def run(*arguments: object) -> Outcome:
        code = main([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    monkeypatch.chdir(folder)
    return run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, a mesh, a scene, a sky and an asset, all small and sound."""
    from prt_bake.network import NetworkSettings, NeuralBSSRDF, save_model

    path = tmp_path_factory.mktemp("cli")
    sphere = trimesh.creation.icosphere(subdivisions=1)
    write_mesh(build_mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces)), path / "sphere.ply")
    write_mesh(build_mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces)[:-2]), path / "open.ply")
    (path / "scene.toml").write_text(SCENE)
    settings = NetworkSettings(features=8, width=16, feature_mean=0.0, feature_spread=0.25)
    metadata = {"up": "z", "unit": "cm", "eta": 1.0}
    save_model(NeuralBSSRDF(settings, (-1.0, -1.0, -1.0), 2.0, metadata=metadata), path / "model.pt")
    write_image(path / "sky.exr", np.ones((8, 16, 3), np.float32))
    write_image(path / "sky.hdr", np.ones((8, 16, 3), np.float32))
    command = f"bake {path}/model.pt {path}/sphere.ply -o {path}/asset.h5 --rings 2 --sectors 4 --samples 18"
    assert main(command.split()) == 0
    return path


def test_help_is_quick_and_lists_every_command() -> None:
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        ran = subprocess.run(
            [sys.executable, "-m", "prt_bake.cli", "--help"], capture_output=True, text=True, check=True
        )
        seconds.append(time.perf_counter() - began)
    promised = {"demo", "train", "bake", "light", "shade", "render", "compare", "info", "check"}
    assert promised <= set(ran.stdout.split())
    assert min(seconds) < 0.3


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
def test_a_size_that_is_none_is_wrong_usage(prtbake: Run, size: str) -> None:
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


def test_light_mends_when_asked_and_says_what_it_did(prtbake: Run, tmp_path: Path) -> None:
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


def test_a_scene_is_baked_by_random_walks(prtbake: Run, tmp_path: Path) -> None:
    options = ["--rings", "1", "--sectors", "2", "--degree", "0", "--samples", "64"]
    assert prtbake("bake", "scene.toml", "sphere.ply", "-o", tmp_path / "a.h5", *options).code == 0
    coefficients = np.asarray(read_asset(tmp_path / "a.h5").coefficients, np.float64)
    furnace = coefficients[..., 0, :] * np.sqrt(4 * np.pi)
    assert 0.2 < furnace.mean() < 1.0


def test_a_dry_run_writes_nothing(prtbake: Run, tmp_path: Path) -> None:
    outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", "--samples", 18, "--dry-run")
    assert json.loads(outcome.out)["evaluations"] == 42 * 1024 * 18
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_shade_makes_a_picture(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    output = tmp_path / f"picture{suffix}"
    outcome = prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", output, "--size", "40x30", "--rotate", 30)
    assert outcome.code == 0
    assert "clamped" in outcome.out
    image = read_image(output)
    assert image.shape == (30, 40, 3)
    assert np.isfinite(image).all()
    np.testing.assert_allclose(image[0, 0], 1.0, atol=1e-3)


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


def test_demo_bakes_relights_and_measures_what_is_shipped(
    prtbake: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = folder / "reference.json"
    size = ["-o", "reference.exr", "--size", "16x16", "--spp", 8, "--report", report]
    assert prtbake("render", "scene.toml", "sphere.ply", "--light", "sky.exr", *size).code == 0
    shipped = {"MODEL": "model.pt", "MESH": "sphere.ply", "SKY": "sky.exr", "REFERENCE": "reference.exr"}
    for name, file in {**shipped, "REFERENCE_REPORT": report.name}.items():
        monkeypatch.setattr(demonstration, name, folder / file)
    outcome = prtbake("demo", "--out", tmp_path / "new" / "demo", "--workers", 1)
    assert (outcome.code, outcome.err) == (0, "")
    made = ["comparison.png", "error.png", "report.json", "spot.exr", "spot.h5", "spot.png"]
    assert sorted(path.name for path in (tmp_path / "new" / "demo").iterdir()) == made
    assert [word for word in ["MSE", "SSIM", "FLIP", "noise", *made] if word not in outcome.out] == []
    assert read_image(tmp_path / "new" / "demo" / "spot.exr").shape == (16, 16, 3)
    figures = json.loads((tmp_path / "new" / "demo" / "report.json").read_text())
    assert figures["bake"]["complete"]
    assert figures["object"]["mse"] > 0


def test_train_refuses_a_smooth_scene_at_once(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "smooth.toml"
    _scene(SCENE.replace("eta = 1.0", "eta = 1.3\nroughness = 0.0"))(folder, path)
    _assert_one_sentence(prtbake("train", path, "-o", tmp_path / "m.pt", "--steps", 1), path)
    assert not (tmp_path / "m.pt").exists()


@pytest.mark.parametrize(
    ("file", "kind"),
    [("sphere.ply", "mesh"), ("sky.exr", "sky"), ("scene.toml", "scene"), ("model.pt", "model"), ("asset.h5", "asset")],
)
def test_info_and_check_of_every_kind(prtbake: Run, file: str, kind: str) -> None:
    assert json.loads(prtbake("info", file, "--json").out)["kind"] == kind
    assert kind in prtbake("info", file).out
    checked = prtbake("check", file)
    assert (checked.code, checked.out, checked.err) == (0, f"{file}: sound\n", "")


def test_check_names_every_fault(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    wound = (folder / "open.ply").read_bytes()
    (tmp_path / "open.ply").write_bytes(wound)
    checked = prtbake("check", tmp_path / "open.ply")
    assert checked.code == 1
    assert "4 edges" in checked.out
    assert "1 fault" in checked.err


def _scene(text: str) -> Write:
    return lambda folder, path: path.write_text(text.replace('mesh = "', f'mesh = "{folder}/'))


def _text(folder: Path, path: Path) -> None:
    path.write_text("this is a shopping list: milk, bread, eggs\n" * 20)


def _truncated(name: str) -> Write:
    def write(folder: Path, path: Path) -> None:
        whole = (folder / name).read_bytes()
        path.write_bytes(whole[: len(whole) // 2])

    return write


def _empty(folder: Path, path: Path) -> None:
    path.write_bytes(b"")


def _nan_vertices(folder: Path, path: Path) -> None:
    rows = "nan 0 0\n0 1 0\n0 0 1\n1 1 1"
    properties = "property float x\nproperty float y\nproperty float z"
    faces = "3 0 1 2\n3 0 3 1\n3 0 2 3\n3 1 3 2"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{properties}\nelement face 4\n"
        f"property list uchar int vertex_indices\nend_header\n{rows}\n{faces}\n"
    )


def _flat_faces(folder: Path, path: Path) -> None:
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\nf 1 2 2\n")


def _image_with(value: float) -> Write:
    def write(folder: Path, path: Path) -> None:
        image = np.ones((8, 16, 3), np.float32)
        image[4, 5] = value
        write_image(path, image)

    return write


class _Payload:
    def __reduce__(self) -> tuple[object, ...]:
        return os.system, ("touch hostile_code_ran",)


def _hostile(folder: Path, path: Path) -> None:
    import torch

    torch.save(_Payload(), path)


def _nothing(folder: Path, path: Path) -> None:
    pass


def _folder(folder: Path, path: Path) -> None:
    path.mkdir()


BAD: dict[str, tuple[str, Write]] = {
    "unknown key": ("scene.toml", _scene(SCENE + "sigma = 3\n")),
    "value out of range": ("scene.toml", _scene(SCENE.replace("0.9", "1.9"))),
    "open mesh": ("scene.toml", _scene(SCENE.replace("sphere", "open"))),
    "not TOML": ("scene.toml", _text),
    "NaN vertices": ("mesh.ply", _nan_vertices),
    "faces without area": ("mesh.obj", _flat_faces),
    "truncated mesh": ("mesh.ply", _truncated("sphere.ply")),
    "not a mesh": ("mesh.ply", _text),
    "not a glTF": ("mesh.glb", _text),
    "NaN pixel": ("sky.exr", _image_with(np.nan)),
    "infinite pixel": ("sky.exr", _image_with(np.inf)),
    "negative pixel": ("sky.exr", _image_with(-1.0)),
    "truncated sky": ("sky.exr", _truncated("sky.exr")),
    "truncated hdr": ("sky.hdr", _truncated("sky.hdr")),
    "not an exr": ("sky.exr", _text),
    "not an hdr": ("sky.hdr", _text),
    "truncated model": ("model.pt", _truncated("model.pt")),
    "not a model": ("model.pt", _text),
    "hostile model": ("model.pt", _hostile),
    "not a safetensors": ("model.safetensors", _text),
    "truncated asset": ("asset.h5", _truncated("asset.h5")),
    "not an asset": ("asset.h5", _text),
    **{
        f"empty {suffix}": (f"empty{suffix}", _empty)
        for suffix in (".toml", ".ply", ".obj", ".exr", ".hdr", ".pt", ".h5")
    },
    **{f"missing {suffix}": (f"none{suffix}", _nothing) for suffix in (".toml", ".ply", ".exr", ".hdr", ".pt", ".h5")},
    **{f"folder {suffix}": (f"dir{suffix}", _folder) for suffix in (".toml", ".ply", ".exr", ".hdr", ".pt", ".h5")},
}

COMMAND_OF_SUFFIX = {
    ".toml": ["bake", "BAD", "sphere.ply", "-o", "OLD"],
    ".ply": ["bake", "model.pt", "BAD", "-o", "OLD"],
    ".obj": ["bake", "model.pt", "BAD", "-o", "OLD"],
    ".glb": ["bake", "model.pt", "BAD", "-o", "OLD"],
    ".exr": ["shade", "asset.h5", "--light", "BAD", "-o", "OLD"],
    ".hdr": ["shade", "asset.h5", "--light", "BAD", "-o", "OLD"],
    ".pt": ["bake", "BAD", "sphere.ply", "-o", "OLD"],
    ".safetensors": ["bake", "BAD", "sphere.ply", "-o", "OLD"],
    ".h5": ["shade", "BAD", "--light", "sky.exr", "-o", "OLD"],
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_older_output_stays(
    prtbake: Run, folder: Path, tmp_path: Path, case: str
) -> None:
    name, write = BAD[case]
    bad, command = tmp_path / name, COMMAND_OF_SUFFIX[Path(name).suffix]
    write(folder, bad)
    old = tmp_path / ("old.h5" if command[0] == "bake" else "old.png")
    old.write_bytes(b"an older output")
    places = {"BAD": bad, "OLD": old}
    _assert_one_sentence(prtbake(*(places.get(word, word) for word in command)), bad)
    assert old.read_bytes() == b"an older output"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({name, old.name} if bad.exists() else {old.name})
    assert not (folder / "hostile_code_ran").exists()
    checked = prtbake("check", bad)
    assert checked.code == 1
    assert len(checked.err.splitlines()) == 1


def _assert_one_sentence(outcome: Outcome, file: Path) -> None:
    assert outcome.code == 1
    assert len(outcome.err.splitlines()) == 1, outcome.err
    assert outcome.err.startswith("prtbake: ")
    assert "Traceback" not in outcome.err
    assert file.name in outcome.err


@pytest.mark.parametrize("output", ["missing/a.h5", "a.txt", "folder.h5"])
def test_an_unusable_output_is_refused_before_the_work(prtbake: Run, tmp_path: Path, output: str) -> None:
    (tmp_path / "folder.h5").mkdir()
    path = tmp_path / output
    _assert_one_sentence(prtbake("bake", "nothing.pt", "sphere.ply", "-o", path), path)


def test_a_full_disk_is_one_sentence_and_older_output_stays(folder: Path, tmp_path: Path) -> None:
    """A limit on the size of files stands in for a full disk: writing fails in the same place."""
    output = tmp_path / "old.h5"
    output.write_bytes(b"an older output")
    program = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536));"
        "from prt_bake.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    command = ["bake", "model.pt", "sphere.ply", "-o", str(output), "--samples", "18", "--storage", "float32"]
    ran = subprocess.run(
        [sys.executable, "-c", program, *command], cwd=folder, capture_output=True, text=True, check=False
    )
    _assert_one_sentence(Outcome(ran.returncode, ran.stdout, ran.stderr), output)
    assert [path.name for path in tmp_path.iterdir()] == ["old.h5"]
    assert output.read_bytes() == b"an older output"


def _start_long_bake(folder: Path, output: Path) -> subprocess.Popen[str]:
    """Start a bake that takes minutes, and return once it has begun to write."""
    command = [sys.executable, "-m", "prt_bake.cli", "bake", "model.pt", "sphere.ply", "-o", str(output)]
    options = ["--samples", "1024"]
    process = subprocess.Popen(
        [*command, *options], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while not list(output.parent.glob(".*.part")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    return process


def test_ctrl_c_leaves_a_valid_partial_asset(folder: Path, tmp_path: Path, prtbake: Run) -> None:
    process = _start_long_bake(folder, tmp_path / "a.h5")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "Traceback" not in err
    assert "stopped" in err.splitlines()[-1]
    asset = read_asset(tmp_path / "a.h5")
    assert not asset.complete
    assert np.count_nonzero(asset.valid) == asset.provenance["vertices_baked"] < 42
    assert prtbake("check", tmp_path / "a.h5").code == 0


def test_a_bake_killed_in_the_middle_leaves_the_older_asset(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"an older output")
    process = _start_long_bake(folder, tmp_path / "a.h5")
    process.kill()
    process.communicate(timeout=60)
    assert (tmp_path / "a.h5").read_bytes() == b"an older output"
