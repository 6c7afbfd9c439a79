"""A file of another kind than expected is refused with the command that it is for."""

from pathlib import Path

import pytest

from tests.cli.command_line import Run

NEW = {"lights.toml": '[[sky]]\nfile = "sky.exr"\n', "a.train.pt": "", "a.importance.pt": "", "odd.toml": "x = 1\n"}


@pytest.fixture
def kinds(folder: Path, tmp_path: Path, prtbake: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a command in a folder with a file of every kind."""
    for name in ("model.pt", "asset.h5", "sphere.ply", "scene.toml", "sky.exr"):
        (tmp_path / name).symlink_to(folder / name)
    for name, text in NEW.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return prtbake


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (
            "shade model.pt --light sky.exr -o a.png",
            "model.pt: expected an asset (ASSET), found a model; bake it first: prtbake bake model.pt MESH -o model.h5",
        ),
        ("view scene.toml --screenshot a.png", "found a scene; train a model on it first: prtbake train scene.toml"),
        (
            "shade sphere.ply --light sky.exr -o a.png",
            "found a mesh; begin with a scene of it: prtbake init sphere.ply",
        ),
        ("shade asset.h5 --light scene.toml -o a.png", "expected a picture or a lights file (--light), found a scene"),
        (
            "bake asset.h5 sphere.ply -o a.h5",
            "expected a model or a scene (SOURCE), found an asset; it is baked already",
        ),
        ("bake sphere.ply model.pt -o a.h5", "found a mesh; the mesh comes second"),
        (
            "bake model.pt scene.toml -o a.h5",
            "expected a mesh (MESH), found a scene; give the mesh that the scene names",
        ),
        (
            "bake a.train.pt sphere.ply -o a.h5",
            "found the checkpoint of a training; prtbake train --resume reads it; its model is a.pt",
        ),
        (
            "bake a.importance.pt sphere.ply -o a.h5",
            "found an importance module; `prtbake render` finds it beside its model, a.pt",
        ),
        ("lobes sphere.ply asset.h5 -o a.h5", "expected a model (MODEL), found a mesh; train one: prtbake train SCENE"),
        ("compare sky.exr model.pt", "expected a picture (REFERENCE), found a model; a picture is a .exr, .hdr, "),
        ("light model.pt", "found a model; only pictures, lights files and lights such as sun:0,1,0 can be lights"),
        ("train scene.toml --samples model.pt -o b.pt", "found a model; make some: prtbake sample SCENE.toml "),
        ("train sphere.ply -o b.pt", "expected a scene (SCENE), found a mesh; begin with a scene of it"),
        ("train lights.toml -o b.pt", "found a lights file; light an asset with it: prtbake shade ASSET --light "),
        ("train scene.toml --samples asset.h5 -o b.pt", "expected training samples (--samples), found an asset"),
        ("sample model.pt --count 1 -o a.h5", "expected a scene (SCENE), found a model; it is trained already"),
        ("render model.pt asset.h5 --light sky.exr -o a.png", "expected a mesh (MESH), found an asset"),
        ("lobes scene.toml asset.h5 -o a.h5", "expected a model (MODEL), found a scene; train one on it first"),
        ("compress model.pt -o a.h5", "expected an asset (ASSET), found a model"),
        ("importance asset.h5 sphere.ply", "expected a model (MODEL), found an asset; give the model that it was "),
        ("compare asset.h5 sky.exr", "make a picture of it first: prtbake shade asset.h5"),
        ("light sphere.ply", "expected a picture or a lights file (ENVIRONMENT), found a mesh"),
        ("export model.pt -o a", "expected an asset or a scene (SOURCE), found a model; bake it first"),
        ("export sphere.ply -o a.glb", "expected an asset or a scene (SOURCE), found a mesh"),
        ("init scene.toml --material jade -o b.toml", "expected a mesh (MESH), found a scene"),
        (
            "init sky.exr --material jade -o b.toml",
            "found a picture; a picture can be the light: prtbake shade ASSET --light sky.exr -o PICTURE.png",
        ),
        ("make model.pt -o a", "expected a scene or a mesh (SCENE), found a model; it is trained already"),
        ("report training scene.toml model.pt", "expected a model (MODEL), found a scene"),
        ("report bake asset.h5 sphere.ply", "expected a model or a scene (SOURCE), found an asset"),
        ("report bases model.pt sphere.ply --light scene.toml", "expected a picture (--light), found a scene"),
    ],
)
def test_the_kind_and_the_right_command_are_named(kinds: Run, line: str, sentence: str) -> None:
    outcome = kinds(*line.split())
    assert outcome.code == 1
    assert sentence in outcome.err
    assert len(outcome.err.splitlines()) == 1


def test_a_file_whose_kind_is_not_evident_is_left_to_the_reader(kinds: Run) -> None:
    assert "unknown key" in kinds("train", "odd.toml", "-o", "b.pt").err
    assert "expected a picture" not in kinds("light", "sun:0,1,0").err


def test_commands_are_written_as_a_shell_takes_them(kinds: Run) -> None:
    Path("my model.pt").symlink_to(Path("model.pt").resolve())
    outcome = kinds("shade", "my model.pt", "--light", "sky.exr", "-o", "a.png")
    assert "prtbake bake 'my model.pt' MESH -o 'my model.h5'" in outcome.err
