"""Commands on a model or a scene without a mesh take that of the source's scene."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from formats.errors import QueryError
from formats.image import read_image
from formats.scene import read_scene
from prt_bake.baking.sources import own_mesh
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, save_model
from tests.cli.command_line import Run


def save(path: Path, **metadata: str) -> None:
    save_model(NeuralBSSRDF(NetworkSettings(features=8, width=16), (-1, -1, -1), 2.0, metadata=metadata), path)


@pytest.fixture
def moved(folder: Path, tmp_path: Path) -> Path:
    for name in ("scene.toml", "sphere.ply"):
        shutil.copy(folder / name, tmp_path)
    save(tmp_path / "a.pt", scene="scene.toml", scene_hash=read_scene(tmp_path / "scene.toml").content_hash)
    return tmp_path


def test_the_mesh_of_a_scene_is_baked(prtbake: Run, tmp_path: Path) -> None:
    few = ["--rings", 1, "--sectors", 4, "--samples", 2]
    outcome = prtbake("bake", "scene.toml", *few, "-o", tmp_path / "a.h5")
    assert outcome.code == 0
    assert "prtbake: bakes on the mesh sphere.ply" in outcome.err
    assert (tmp_path / "a.h5").exists()
    (tmp_path / "mesh.h5").symlink_to(Path("sphere.ply").absolute())
    over = prtbake("bake", "scene.toml", *few, "-o", tmp_path / "mesh.h5", "--force")
    assert over.code == 1
    assert "mesh.h5: is also the input" in over.err


def test_the_mesh_of_a_scene_is_rendered(prtbake: Run, tmp_path: Path) -> None:
    few = ["--light", "sky.exr", "--size", "8x6", "--spp", 2]
    pictures = [tmp_path / "a.exr", tmp_path / "b.exr"]
    assert prtbake("render", "scene.toml", "sphere.ply", *few, "-o", pictures[0]).code == 0
    assert prtbake("render", "scene.toml", *few, "-o", pictures[1]).code == 0
    a, b = map(read_image, pictures)
    assert np.array_equal(a, b)
    (tmp_path / "mesh.exr").symlink_to(Path("sphere.ply").absolute())
    over = prtbake("render", "scene.toml", *few, "-o", tmp_path / "mesh.exr")
    assert over.code == 1
    assert "mesh.exr: is also the input" in over.err


def test_the_mesh_of_a_model_is_rendered_and_learnt(prtbake: Run, moved: Path) -> None:
    few = ["--light", "sky.exr", "--size", "8x6", "--spp", 2]
    assert prtbake("render", moved / "a.pt", *few, "-o", moved / "a.exr").code == 0
    (moved / "sphere.ply").unlink()
    assert f"{moved / 'sphere.ply'}: " in prtbake("importance", moved / "a.pt").err


def test_a_model_finds_its_scene(moved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert own_mesh(moved / "a.pt") == moved / "sphere.ply"
    # In the current folder too.
    (moved / "models").mkdir()
    shutil.move(moved / "a.pt", moved / "models")
    monkeypatch.chdir(moved)
    assert own_mesh("models/a.pt").resolve() == moved / "sphere.ply"


def test_a_scene_that_is_missing_or_changed_is_not_taken(moved: Path) -> None:
    scene = moved / "scene.toml"
    scene.write_text(scene.read_text().replace("sigma_t = ", "sigma_t = 1"))
    with pytest.raises(QueryError, match=r"its scene .*scene\.toml has changed since the training; give the mesh"):
        own_mesh(moved / "a.pt")
    scene.unlink()
    with pytest.raises(QueryError, match=r"the model's scene scene\.toml is not beside it; give the mesh after"):
        own_mesh(moved / "a.pt")
    save(moved / "plain.pt")
    with pytest.raises(QueryError, match="the model does not know its scene's mesh; give the mesh"):
        own_mesh(moved / "plain.pt")
    with pytest.raises(QueryError, match="a function does not know its mesh; give the mesh"):
        own_mesh(moved / "plain.pt", "incident, position, outgoing; angles=unit")
