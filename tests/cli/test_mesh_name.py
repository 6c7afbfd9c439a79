"""The argument MESH: sentences about it begin with its file, and a scene has no other one."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from formats.errors import PrtbakeError, QueryError, StorageError, warn
from formats.mesh import build_mesh, read_mesh, write_mesh
from prt_bake.cli.shared.mesh_name import naming_mesh
from prt_bake.shipped.demonstration import SHIPPED
from tests.cli.command_line import Run
from tests.shapes import ball


@naming_mesh
def command(mesh: Path, error: PrtbakeError | None = None) -> None:
    warn("mesh: its normals are zero")
    warn("sky.exr: two layers")
    if error:
        raise error


def test_warnings_name_the_file_of_the_mesh() -> None:
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        command(mesh=Path("a b.obj"))
    assert [str(warning.message) for warning in shown] == ["a b.obj: its normals are zero", "sky.exr: two layers"]


@pytest.mark.filterwarnings("ignore")
def test_errors_name_the_file_of_the_mesh_and_keep_their_kind() -> None:
    with pytest.raises(QueryError, match=r"^a\.obj: is empty$"):
        command(mesh=Path("a.obj"), error=QueryError("mesh: is empty"))
    other = StorageError("b.h5: the mesh: is missing")
    with pytest.raises(StorageError) as raised:
        command(mesh=Path("a.obj"), error=other)
    assert raised.value is other


@pytest.mark.parametrize(
    "words", ["bake MODEL MESH -o a.h5", "render MODEL MESH --light sky.exr -o a.exr", "report bake MODEL MESH --out a"]
)
def test_commands_name_the_mesh_that_is_not_the_models(prtbake: Run, tmp_path: Path, words: str) -> None:
    mesh = tmp_path / "ball.ply"
    write_mesh(ball(1), mesh)
    places = {"MODEL": SHIPPED / "spot.pt", "MESH": mesh}
    outcome = prtbake(*(places.get(word, word) for word in words.split()))
    assert outcome.code == 1
    assert f"prtbake: {mesh}: " in outcome.err
    assert " mesh: " not in outcome.err


def test_a_scene_is_rendered_with_its_own_mesh_alone(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    """Another object, a part of it and a scaled one are refused; another order of vertices, and rounding, are not."""
    mesh, options = read_mesh(folder / "sphere.ply"), ["--light", "sky.exr", "--size", "8x6", "--spp", 2]
    order = np.random.default_rng(1).permutation(len(mesh.positions))
    rounded = mesh.positions[order].astype(np.float32).astype(np.float64)
    write_mesh(build_mesh(rounded, np.argsort(order)[mesh.faces]), tmp_path / "same.obj")
    assert prtbake("render", "scene.toml", tmp_path / "same.obj", *options, "-o", tmp_path / "a.exr").code == 0
    more = np.concatenate([mesh.positions, [[0.0, 3.0, 0.0]]])
    further = np.concatenate([mesh.faces, [[0, 1, len(mesh.positions)]]])
    for name, other in {
        "half": build_mesh(0.5 * mesh.positions, mesh.faces),
        "more": build_mesh(more, further),
        "less": build_mesh(mesh.positions, mesh.faces[len(mesh.faces) // 2 :]),
    }.items():
        write_mesh(other, tmp_path / f"{name}.ply")
        refused = prtbake("render", "scene.toml", tmp_path / f"{name}.ply", *options, "-o", tmp_path / "b.exr")
        assert refused.code == 1
        assert f"{name}.ply: expected the object of scene.toml, found another one: " in refused.err
        assert "a scene is rendered with its own mesh, so give sphere.ply" in refused.err
    assert not (tmp_path / "b.exr").exists()
