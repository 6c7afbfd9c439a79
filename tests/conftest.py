"""What the tests of the commands share: a folder of small sound files, and a way to run a command there."""

import gc
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_line import SCENE, Outcome, Run

from formats.image import write_image
from formats.mesh import build_mesh, write_mesh
from prt_bake.cli import progress
from prt_bake.cli.main import main

WARM = Path(__file__).with_name("warm.py")
COMPILING = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_configure(config: pytest.Config) -> None:
    """Where several processes share the tests, one more compiles the path tracer's kernels, which takes minutes.

    The others wait for it only where they need one of these.
    """
    # Shells start what runs in the background with Ctrl-C ignored, and some tests send themselves one.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput") and getattr(config.option, "numprocesses", None):
        # Threads of one process that wait for work by spinning would take the cores from the other processes.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        config.stash[COMPILING] = subprocess.Popen([sys.executable, WARM])


def pytest_collection_finish() -> None:
    """What modules and tests have made by now stays to the end: the garbage collector need not go through it again."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Raises RuntimeError where the kernels could not be compiled."""
    if COMPILING in config.stash and (code := config.stash[COMPILING].wait()) != 0:
        raise RuntimeError(f"{WARM} failed with {code}: its message is above")


@pytest.fixture(scope="session")
def compiled_kernels() -> None:
    """The path tracer's kernels are kept, for processes that a test starts and gives a limited time."""
    from warm import main

    main()


@pytest.fixture
def prtbake(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path) -> Run:
    """Run a command in the shared folder and return its exit code and what it printed."""

    def run(*arguments: object) -> Outcome:
        code = main([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    monkeypatch.chdir(folder)
    # What a command says of how far it is hangs on how slow the machine is.
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", math.inf)
    return run


@pytest.fixture(scope="session")
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
