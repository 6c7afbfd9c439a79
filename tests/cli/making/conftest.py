"""Commands that stand in for those that `make` runs, in an empty folder with a mesh and a scene."""

from types import SimpleNamespace

import pytest
import trimesh

from formats.mesh import build_mesh, write_mesh
from prt_bake.cli.main import main as prtbake
from prt_bake.cli.making import steps
from tests.cli.making.stand_ins import StandIns


@pytest.fixture(scope="session")
def asset(folder):
    return folder / "asset.h5"


@pytest.fixture
def stand_ins(asset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ball = trimesh.creation.icosphere(subdivisions=1)
    write_mesh(build_mesh(ball.vertices, ball.faces), tmp_path / "ball.obj")
    assert prtbake(["init", "ball.obj", "--material", "wax", "--size", "5cm", "-o", "wax.toml"]) == 0
    commands = StandIns(asset)
    monkeypatch.setattr(steps, "time", SimpleNamespace(monotonic=lambda: commands.now))
    monkeypatch.setattr(steps, "_frame_seconds", lambda asset, lights: commands.frame)
    monkeypatch.setattr(steps, "_quality", lambda model: "the network is 9.0 % off")
    return commands
