"""Sentences about a mesh in memory begin with its file on the command line."""

import warnings
from pathlib import Path

import pytest

from formats.errors import PrtbakeError, QueryError, StorageError, warn
from formats.mesh import write_mesh
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
