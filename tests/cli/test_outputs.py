"""Outputs that are inputs, or cannot be written, are refused before anything is read or computed."""

import errno
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from formats.atomic import replacing
from formats.journal import Journal
from prt_bake.cli.main import main
from prt_bake.export.mitsuba_xml import exported_files
from prt_bake.shipped import demonstration
from tests.cli.command_line import SCENE, Outcome, Run
from tests.formats.mesh.gltf_files import pack

NAMED = {
    "scene.toml": '[object]\nmesh = "mesh.gltf"\n[medium]\nsigma_t = "grid.npy"\n[[inside]]\nmesh = "core.ply"\n',
    "mesh.gltf": '{"buffers": [{"uri": "a%20b.bin"}], "images": [{"uri": "data:,"}, {"uri": "wood.png"}]}',
    "lights.toml": '[[sky]]\nfile = "dawn.exr"\n',
}
"""Files that name others. All other inputs are empty: a command that read one would fail with another message."""

LIGHTS = "--light lights.toml --light sky.png --light sun:0,1,0"
OF_LIGHTS = "lights.toml dawn.exr sky.png"
OF_SCENE = "scene.toml mesh.gltf grid.npy core.ply wood.png"
TRAIN = "train scene.toml --samples samples.h5 -o out.pt"

COMMANDS = {
    "bake": (
        "bake model.pt mesh.gltf --for-light sky.png -o out.h5 --report out.json",
        "out.h5 out.json",
        "model.pt mesh.gltf wood.png sky.png",
    ),
    "bake a scene": ("bake scene.toml mesh.ply -o out.h5", "out.h5", f"{OF_SCENE} mesh.ply"),
    "dry run": ("bake scene.toml mesh.ply -o out.h5 --dry-run", "out.h5", "scene.toml mesh.ply"),
    "sample": ("sample scene.toml -o out.h5 --count 1", "out.h5", OF_SCENE),
    "train": (
        TRAIN,
        "out.pt out.train.pt out.report.json out.report.html out.importance.pt",
        f"{OF_SCENE} samples.h5",
    ),
    "train alone": (f"{TRAIN} --no-report --no-importance", "out.pt out.train.pt", "scene.toml"),
    "importance": ("importance model.pt mesh.ply", "model.importance.pt", "model.pt mesh.ply"),
    "compress": ("compress asset.h5 -o out.h5", "out.h5", "asset.h5"),
    "compress to the usual name": ("compress asset.h5", "asset.compact.h5", "asset.h5"),
    "export": ("export asset.h5 -o out.glb --light sky.png", "out.glb", "asset.h5 sky.png"),
    "export as a texture": ("export asset.h5 -o out.exr", "out.exr out.json out.mesh.glb", "asset.h5"),
    "shade": (
        f"shade asset.h5 {LIGHTS} -o out.exr --reflection --roughness alpha.png --error-picture out.png",
        "out.exr out.png",
        f"asset.h5 alpha.png {OF_LIGHTS}",
    ),
    "numbered pictures": (
        f"shade asset.h5 {LIGHTS} -o out_%02d.png --turntable eye --frames 12",
        "out_00.png out_11.png",
        f"asset.h5 {OF_LIGHTS}",
    ),
    "render": (
        f"render model.pt mesh.ply {LIGHTS} -o out.exr --preview out.png --report out.json",
        "out.exr out.png out.json out.exr.render.npz",
        f"model.pt model.importance.pt mesh.ply {OF_LIGHTS}",
    ),
    "render a scene": (
        f"render scene.toml mesh.ply {LIGHTS} -o out.exr",
        "out.exr out.exr.render.npz",
        f"{OF_SCENE} mesh.ply {OF_LIGHTS}",
    ),
    "compare": (
        "compare image.png sky.png --mask mask.png --picture a.png --difference-map b.exr --flip-map c.png "
        "--hdr-flip-map d.png",
        "a.png b.exr c.png d.png",
        "image.png sky.png mask.png",
    ),
    "view": (
        f"view asset.h5 {LIGHTS} --compare image.exr --screenshot out.png",
        "out.png",
        f"asset.h5 image.exr {OF_LIGHTS}",
    ),
    "report bake": (
        "report bake model.pt mesh.ply --scene scene.toml --light sky.png --out out",
        "out/bake.md out/bake.json out/bake.png",
        f"model.pt mesh.ply sky.png {OF_SCENE}",
    ),
    "report training": (
        "report training model.pt scene.toml",
        "model.report.json model.report.html",
        f"model.pt {OF_SCENE}",
    ),
    "report paper": (
        "report paper --sky sky.png --out out",
        "out/tables.md out/sheet.png out/layers.json",
        "sky.png",
    ),
}
"""A command line, the files that it writes, and the files that it reads."""


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Return a function that runs a command line in a folder of its own."""

    def run(line: str) -> Outcome:
        return Outcome(main(line.split()), *capsys.readouterr())

    monkeypatch.chdir(tmp_path)
    return run


def write_inputs(names: str) -> list[Path]:
    """Write the files, the buffer of mesh.gltf among them if they name it, and return their paths."""
    paths = [Path(name) for name in names.split()]
    if Path("mesh.gltf") in paths:
        paths.append(Path("a b.bin"))
    for path in paths:
        path.write_text(NAMED.get(path.name, ""))
    return paths


def assert_refused(outcome: Outcome, output: str, sentence: str) -> None:
    assert (outcome.code, outcome.out) == (1, ""), outcome
    assert outcome.err.startswith(f"prtbake: {output}: {sentence}"), outcome.err
    assert len(outcome.err.splitlines()) == 1


@pytest.mark.parametrize("command", COMMANDS)
def test_no_output_is_an_input(run: Run, command: str) -> None:
    line, outputs, inputs = COMMANDS[command]
    names, sources = outputs.split(), write_inputs(inputs)
    for i in range(max(len(names), len(sources))):
        output, source = Path(names[i % len(names)]), sources[i % len(sources)]
        output.parent.mkdir(exist_ok=True)
        output.symlink_to(source.resolve())
        before = source.read_bytes()
        outcome = run(line)
        output.unlink()
        assert_refused(outcome, str(output), "is also the input ")
        assert source.read_bytes() == before


@pytest.mark.parametrize("command", COMMANDS)
def test_every_output_is_checked_before_the_inputs_are_read(run: Run, command: str) -> None:
    line, outputs, inputs = COMMANDS[command]
    write_inputs(inputs)
    for name in outputs.split():
        Path(name).mkdir(parents=True)
        assert_refused(run(line), name, "cannot be written: it is a folder; give the name of a file")
        Path(name).rmdir()


@pytest.mark.parametrize("command", [command for command, case in COMMANDS.items() if " -o " in case[0]])
def test_a_folder_that_is_missing_or_takes_no_file(run: Run, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    line, outputs, inputs = COMMANDS[command]
    write_inputs(inputs)
    output = outputs.split()[0]
    Path("file").write_text("")
    placed = line.replace(" -o out", " -o {}/out")
    assert_refused(run(placed.format("none")), f"none/{output}", "cannot be written: the folder ")
    assert_refused(run(placed.format("file")), f"file/{output}", "cannot be written: ")

    def full(dir: str) -> None:
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    assert_refused(run(line), output, "cannot be written: the disk quota is used up")


@pytest.mark.parametrize(
    "line",
    [
        "sample scene.toml -o /proc/out.h5 --count 1",
        "report bake model.pt mesh.ply --out /proc/out",
        "report paper --out /proc/out",
        "demo --out /proc/out",
    ],
)
def test_a_folder_that_refuses_files_although_its_permissions_allow_them(run: Run, line: str) -> None:
    write_inputs("scene.toml model.pt mesh.ply")
    assert_refused(run(line), "/proc/out.h5" if "out.h5" in line else "/proc/out", "cannot be written: ")


@pytest.mark.parametrize("link", [os.symlink, os.link])
@pytest.mark.parametrize("output", ["sky.png", "./sky.png", "other.png", "folder/../sky.png"])
def test_every_name_of_an_input_is_found(run: Run, output: str, link: Callable[[str, str], None]) -> None:
    Path("folder").mkdir()
    write_inputs("asset.h5 sky.png")
    link("sky.png", "other.png")
    sentence = "is also the input given as --light; choose another name for the output"
    assert_refused(run(f"shade asset.h5 --light sky.png -o {output}"), str(Path(output)), sentence)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    ("uri", "output"),
    [
        ("a%23b/skin.png", "a#b/skin.png"),
        ("a#b\\skin.png", "a#b/skin.png"),
        ("a%23b\\skin.png", "a#b/skin.png"),
        ("a%23b/caf%C3%A9.png", "a#b/cafe\u0301.png"),
        ("a%23b/cafe%CC%81.png", "a#b/caf\u00e9.png"),
    ],
)
def test_files_that_a_gltf_file_names_are_inputs_in_every_spelling(
    run: Run, uri: str, output: str, binary: bool
) -> None:
    text = json.dumps({"buffers": [{"uri": "a" * 5000}], "images": [{"uri": "data:,"}, {"uri": uri}]}).encode()
    mesh = Path("mesh.glb" if binary else "mesh.gltf")
    mesh.write_bytes(pack(text, b"") if binary else text)
    Path("scene.toml").write_text(f'[object]\nmesh = "{mesh}"\n')
    Path("a#b").mkdir()
    Path(output).write_text("an input")
    outcome = run(f"render scene.toml mesh.ply --light sky.png -o {output}")
    assert_refused(outcome, output, f"is also the input named by {mesh}; choose another name for the output")
    assert Path(output).read_text() == "an input"


def test_the_file_that_names_an_input_is_named(run: Run) -> None:
    write_inputs(f"{OF_LIGHTS} asset.h5")
    sentence = "is also the input named by lights.toml; choose another name for the output"
    assert_refused(run("shade asset.h5 --light lights.toml -o dawn.exr"), "dawn.exr", sentence)


@pytest.mark.parametrize(
    ("line", "path", "options"),
    [
        ("compare a.png b.png --picture c.png --flip-map ./c.png", "c.png", "--picture and as --flip-map"),
        ("render s.toml m.ply --light s.exr -o c.png --preview c.png", "c.png", "--output and as --preview"),
        ("shade a.h5 --light s.exr -o c.png --error-picture link.png", "link.png", "--output and as --error-picture"),
    ],
)
def test_no_two_outputs_are_the_same_file(run: Run, line: str, path: str, options: str) -> None:
    Path("link.png").symlink_to("c.png")
    assert_refused(run(line), path, f"would be written both as {options}")


def test_files_that_are_damaged_or_name_themselves_are_left_to_the_reader(run: Run) -> None:
    missing = "prtbake: none.h5: there is no such file"
    Path("a.toml").write_text('mesh = "a.toml"\n')
    Path("b.gltf").write_text('{"buffers": [{"uri": "b.gltf"}, {}, {"uri": "\\u0000"}]}')
    for name, content in (("c.toml", b"= \xff"), ("d.gltf", b"[1, 2"), ("e.gltf", b'{"buffers": 3}')):
        Path(name).write_bytes(content)
        assert run(f"shade none.h5 --roughness {name} --reflection --light sun:0,1,0 -o x.png").err.startswith(missing)
    Path("f.gltf").write_text('{"buffers": [{"uri": "g.glb"}]}')
    Path("g.glb").write_text('{"images": [{"uri": "f.gltf"}]}')
    for name in ("a.toml", "b.gltf", "f.gltf"):
        assert run(f"shade none.h5 --roughness {name} --reflection --light sun:0,1,0 -o x.png").err.startswith(missing)


def test_an_export_leaves_the_files_of_its_scene(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "part_0.ply").write_bytes((folder / "sphere.ply").read_bytes())
    (tmp_path / "scene.toml").write_text(SCENE.replace("sphere", "part_0"))
    outcome = prtbake("export", tmp_path / "scene.toml", "-o", tmp_path)
    assert_refused(outcome, str(tmp_path / "part_0.ply"), f"is also the input named by {tmp_path}/scene.toml")
    assert (tmp_path / "part_0.ply").read_bytes() == (folder / "sphere.ply").read_bytes()
    assert prtbake("export", tmp_path / "scene.toml", "-o", tmp_path / "new").code == 0


def test_the_demonstration_leaves_its_inputs(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    Path("spot.png").write_text("")
    monkeypatch.setattr(demonstration, "SKY", tmp_path / "spot.png")
    assert_refused(run("demo --out ."), "spot.png", "is also the input given as the shipped object")
    assert_refused(run("demo --out none/.."), "none/../spot.png", "is also the input")


@pytest.mark.parametrize(
    "line",
    ["shade asset.h5 --light sky.exr --size 8x6 -o OLD.exr", "compare sky.exr sky.exr --difference-map OLD.png"],
)
def test_a_full_disk_leaves_the_older_output(
    prtbake: Run, tmp_path: Path, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"old{line[-4:]}"
    (tmp_path / name).write_text("an older output")

    def full(file: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    outcome = prtbake(*line.replace("OLD", str(tmp_path / "old")).split())
    assert_refused(outcome, str(tmp_path / name), "cannot be written: the disk is full")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "an older output"


def test_a_disk_that_may_be_too_small_is_named_before_the_bake(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bake = ["bake", "model.pt", "sphere.ply", "--rings", 1, "--sectors", 2, "--samples", 18, "-o"]
    assert "of its disk" not in prtbake(*bake, tmp_path / "a.h5").err
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    outcome = prtbake(*bake, tmp_path / "b.h5")
    assert outcome.code == 0
    assert re.search(r"b\.h5: may need up to \d.*MB of its disk while it is written, where 0\.0 MB are", outcome.err)


def test_two_writers_of_one_file_leave_one_of_both(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with replacing(path) as first:
        first.write_text("first")
        with replacing(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_second_bake_of_an_asset_is_refused(prtbake: Run, tmp_path: Path) -> None:
    output = tmp_path / "a.h5"
    with Journal(output, {}, resume=False):
        outcome = prtbake("bake", "model.pt", "sphere.ply", "-o", output)
    assert_refused(outcome, str(output), "another process is writing it")


def test_every_file_of_an_export_is_known(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    from formats.scene import read_scene

    assert prtbake("export", "scene.toml", "-o", tmp_path).code == 0
    assert set(tmp_path.iterdir()) <= set(exported_files(read_scene(folder / "scene.toml"), tmp_path))
