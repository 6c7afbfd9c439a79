"""Shared fixtures: a folder of small valid files, a function that runs a command there, and coarse grids."""

import gc
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import settings

from formats.image import write_image
from formats.mesh import build_mesh, write_mesh
from prt_bake.cli.main import main
from prt_bake.cli.shared import progress
from prt_bake.jit import notice
from tests import ROOT
from tests.cli.command_line import SCENE, Outcome, Run

settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")

COMPILING = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_configure(config: pytest.Config) -> None:
    """With several test processes, one more compiles the path tracer's kernels; others wait only for those."""
    # Shells start background processes with Ctrl-C ignored, but some tests send it to themselves.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput") and getattr(config.option, "numprocesses", None):
        # Idle threads that spin would take the cores from the other processes.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        config.stash[COMPILING] = subprocess.Popen([sys.executable, "-m", "tests.jit.warm"], cwd=ROOT)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect tests without garbage collection, which takes a fifth of the time and frees nothing."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """Exclude all objects created so far from garbage collection; they live until the end."""
    gc.freeze()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Raise RuntimeError if the compilation of the kernels failed."""
    if COMPILING in config.stash and (code := config.stash[COMPILING].wait()) != 0:
        raise RuntimeError(f"tests.jit.warm failed with {code}: its message is above")


@pytest.fixture(scope="session")
def compiled_kernels() -> None:
    """Compile the path tracer's kernels, for tests that give a process of their own a limited time."""
    from tests.jit.warm import main

    main()


@pytest.fixture
def prtbake(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path) -> Run:
    """Return a function that runs a command in the shared folder and returns its exit code and output."""

    def run(*arguments: object) -> Outcome:
        code = main([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    monkeypatch.chdir(folder)
    # Progress lines depend on the speed of the machine.
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", math.inf)
    # Whether kernels are compiled depends on earlier runs.
    monkeypatch.setattr(notice, "said", True)
    return run


@pytest.fixture
def coarse_interior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of interiors of at most 48³ points, an eighth of the time of 96³, and a tenth of the samples of textures.

    For tests that do not depend on their fineness.
    """
    from prt_bake.trainer import interior, material

    monkeypatch.setattr(interior, "_MOST_POINTS", 48**3)
    monkeypatch.setattr(material, "_SURFACE_SAMPLES", 20_000)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, a mesh, a scene, a sky and an asset, all small and valid."""
    from prt_bake.baking.lobes import search
    from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, save_model

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
    with pytest.MonkeyPatch.context() as patch:
        # Pictures prepare a sky for all sharpnesses of lobes: up to 6 in an eighth of the time of the network's own 48.
        patch.setattr(search, "MOST_SHARPNESS", 6.0)
        assert main(command.split()) == 0
    return path
