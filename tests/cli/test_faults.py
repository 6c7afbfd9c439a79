"""Errors: one sentence, exit code 1, and unchanged older outputs."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from formats.asset import read_asset
from formats.image import write_image
from prt_bake.cli.__main__ import run
from prt_bake.cli.shared import signals
from tests.cli.command_line import SCENE, Outcome, Run

Write = Callable[[Path, Path], object]
"""write(folder of valid files, path of the bad file)."""


def _scene(text: str) -> Write:
    return lambda folder, path: path.write_text(text.replace('mesh = "', f'mesh = "{folder}/'))


def _text(folder: Path, path: Path) -> None:
    path.write_text("this is a shopping list: milk, bread, eggs\n" * 20)


def _truncated(name: str) -> Write:
    def write(folder: Path, path: Path) -> None:
        content = (folder / name).read_bytes()
        path.write_bytes(content[: len(content) // 2])

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
    """The last face closes the gap between the first, along the edge 1 2, and two that meet in its middle."""
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 0.5 0 0\n"
    path.write_text(vertices + "f 1 3 2\nf 1 5 4\nf 5 2 4\nf 1 4 3\nf 2 3 4\nf 1 2 5\n")


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
    "not an STL": ("mesh.stl", _text),
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
    "not an onnx": ("function.onnx", _text),
    "not a safetensors": ("model.safetensors", _text),
    "truncated asset": ("asset.h5", _truncated("asset.h5")),
    "not an asset": ("asset.h5", _text),
    **{
        f"empty {suffix}": (f"empty{suffix}", _empty)
        for suffix in (".toml", ".ply", ".obj", ".stl", ".exr", ".hdr", ".pt", ".h5")
    },
    **{f"missing {suffix}": (f"none{suffix}", _nothing) for suffix in (".toml", ".ply", ".exr", ".hdr", ".pt", ".h5")},
    **{f"folder {suffix}": (f"dir{suffix}", _folder) for suffix in (".toml", ".ply", ".exr", ".hdr", ".pt", ".h5")},
}

COMMAND_OF_SUFFIX = {
    ".toml": ["bake", "BAD", "sphere.ply", "-o", "OLD", "--force"],
    ".ply": ["bake", "model.pt", "BAD", "-o", "OLD", "--force"],
    ".obj": ["bake", "model.pt", "BAD", "-o", "OLD", "--force"],
    ".stl": ["bake", "model.pt", "BAD", "-o", "OLD", "--force"],
    ".glb": ["bake", "model.pt", "BAD", "-o", "OLD", "--force"],
    ".exr": ["shade", "asset.h5", "--light", "BAD", "-o", "OLD"],
    ".hdr": ["shade", "asset.h5", "--light", "BAD", "-o", "OLD"],
    ".pt": ["bake", "BAD", "sphere.ply", "-o", "OLD", "--force"],
    ".onnx": ["bake", "BAD", "sphere.ply", "-o", "OLD", "--force", "--convention", "incident, position, outgoing"],
    ".safetensors": ["bake", "BAD", "sphere.ply", "-o", "OLD", "--force"],
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


def test_a_full_disk_is_one_sentence_and_older_output_stays(prtbake: Run, tmp_path: Path) -> None:
    """A limit on file sizes simulates a full disk: writing fails at the same place."""
    resource = pytest.importorskip("resource")
    output = tmp_path / "old.h5"
    output.write_bytes(b"an older output")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, limits[1]))
    try:
        options = ["--samples", 18, "--lobes", 0, "--storage", "float32", "--force"]
        outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", output, *options)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    _assert_one_sentence(outcome, output)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.h5"]
    assert output.read_bytes() == b"an older output"


def test_ctrl_c_leaves_a_valid_partial_asset(tmp_path: Path, prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C at any place of a bake that takes minutes, after its first vertices."""
    keys = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT))

    def progress(done: int, *_: object) -> None:
        if done > 0 and keys.ident is None:
            keys.start()

    monkeypatch.setattr("prt_bake.cli.bake.bake_progress", lambda *_: progress)
    outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", tmp_path / "a.h5", "--samples", 1024, "--lobes", 0)
    keys.cancel()
    assert outcome.code == 130
    assert "stopped" in outcome.err.splitlines()[-1]
    asset = read_asset(tmp_path / "a.h5")
    assert not asset.complete
    assert np.count_nonzero(asset.valid) == asset.provenance["vertices_baked"] < 42
    assert prtbake("check", tmp_path / "a.h5").code == 0


def test_ctrl_c_before_the_first_vertex_of_a_bake_ends_it_at_once(
    folder: Path, tmp_path: Path, prtbake: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def planning(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the plan goes on after Ctrl-C")

    monkeypatch.setattr("prt_bake.baking.bake.plan_lobes_of_bake", planning)
    outcome = prtbake("bake", folder / "model.pt", folder / "sphere.ply", "-o", tmp_path / "a.h5", "--samples", 16)
    assert (outcome.code, outcome.err.splitlines()[-1]) == (130, "prtbake: stopped by Ctrl-C before it was finished")
    assert list(tmp_path.iterdir()) == []


def test_a_killed_bake_leaves_the_older_asset(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"an older output")
    program = (
        "import sys; from prt_bake.cli import main; from prt_bake.cli.shared import progress; "
        "progress.PLAIN_INTERVAL = 0.0; sys.exit(main.main(sys.argv[1:]))"
    )
    options = ["-o", tmp_path / "a.h5", "--samples", "1024", "--lobes", "0", "--force"]
    command = [sys.executable, "-c", program, "bake", "model.pt", "sphere.ply", *options]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert "bake: " in process.stderr.readline()
    process.kill()
    process.communicate(timeout=600)
    assert (tmp_path / "a.h5").read_bytes() == b"an older output"


def test_sample_refuses_a_smooth_scene_at_once(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "smooth.toml"
    _scene(SCENE.replace("eta = 1.0", "eta = 1.3\nroughness = 0.0"))(folder, path)
    _assert_one_sentence(prtbake("sample", path, "-o", tmp_path / "s.h5", "--count", 1), path)
    assert not (tmp_path / "s.h5").exists()


def test_a_threading_layer_that_cannot_be_loaded_is_one_sentence(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "prt_bake.cli", "render", "scene.toml", "sphere.ply", "--light", "sky.exr"]
    ran = subprocess.run(
        [*command, "-o", tmp_path / "a.png", "--size", "8x8", "--spp", "2"],
        cwd=folder,
        env=os.environ | {"NUMBA_THREADING_LAYER": "nonsense"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, ran.stderr.splitlines()[-1].split(",")[0]) == (
        1,
        "prtbake: NUMBA_THREADING_LAYER is nonsense",
    )
    assert "Traceback" not in ran.stderr


@pytest.fixture
def run_command(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., object]]:
    """Run a command line as the console script does, and return its exit code."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def run_it(*arguments: object) -> object:
        monkeypatch.setattr(sys, "argv", ["prtbake", *map(str, arguments)])
        with pytest.raises(SystemExit) as ending:
            run()
        return ending.value.code

    yield run_it
    signals.forget()
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ["a.glb", "a.exr", "site"])
def test_an_export_that_is_terminated_leaves_nothing(
    folder: Path,
    tmp_path: Path,
    run_command: Callable[..., object],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    def terminated(*_: object) -> None:
        if any((tmp_path / "out").iterdir()):
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("formats.atomic._flush", terminated)
    monkeypatch.setattr("shutil.copyfile", terminated)
    (tmp_path / "out").mkdir()
    (tmp_path / "page/vendor").mkdir(parents=True)
    (tmp_path / "page/vendor/VERSIONS").write_text("")
    monkeypatch.setattr("prt_bake.export.site.PAGE", tmp_path / "page")
    assert run_command("export", folder / "asset.h5", "-o", tmp_path / "out" / name) == 143
    assert list((tmp_path / "out").iterdir()) == []
    assert capsys.readouterr().err.splitlines()[-1] == "prtbake: stopped by SIGTERM before it was finished"


def test_an_error_after_ctrl_c_is_the_sentence_of_ctrl_c(
    run_command: Callable[..., object], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Some imports turn an interrupt into another error."""

    def broken() -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("a broken import") from None
        return 0

    monkeypatch.setattr("prt_bake.cli.main.main", broken)
    assert run_command() == 130
    assert capsys.readouterr().err == "prtbake: stopped by Ctrl-C before it was finished\n"
