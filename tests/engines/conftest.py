"""Shared fixtures: programs of the npm packages, Chromium, and a small asset of the shipped object."""

import importlib.resources
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

from prt_bake.cli.main import main
from tests import ROOT

HERE = Path(__file__).parent
RunNode = Callable[..., Any]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test below this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker("engines")


def missing(what: str) -> NoReturn:
    """Skip a test for want of a program; in CI, which installs them, it fails."""
    if os.environ.get("CI"):
        pytest.fail(what)
    pytest.skip(what)


def program(name: str, package: str) -> str:
    """Return the path of a program; without it the test is skipped, and says which package has it."""
    found = shutil.which(name)
    if found is None:
        missing(f"{name} was not found: install the package {package} (Debian: apt-get install {package})")
    return found


def node(script: str, *arguments: object, timeout: float = 300) -> Any:
    """Run a script of this folder, with arguments, and return what it prints as JSON."""
    command = ["node", str(HERE / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="session")
def node_packages() -> Path:
    """The folder of the npm packages."""
    program("node", "nodejs")
    folder = HERE / "node_modules"
    if not (folder / ".package-lock.json").is_file():
        missing("the npm packages of tests/engines are not installed: run 'make test-engines'")
    return folder


@pytest.fixture(scope="session")
def chromium(node_packages: Path) -> Iterator[str]:
    """The path of Chromium, $CHROMIUM or /usr/bin/chromium, which `browser.mjs` starts."""
    with pytest.MonkeyPatch.context() as patch:
        path = program(os.environ.get("CHROMIUM", "chromium"), "chromium")
        patch.setenv("CHROMIUM", path)
        yield path


@pytest.fixture(scope="session")
def run_node(node_packages: Path) -> RunNode:
    """`node`, where the npm packages are."""
    return node


@pytest.fixture(scope="session")
def blender() -> Path:
    """The Python of the environment that has Blender as a module, `bpy`."""
    python = ROOT / ".venv/blender/bin/python"
    if not (ROOT / ".venv/blender/installed").is_file():
        pytest.skip("Blender is not installed: run 'make test-blender' (1 GB)")
    return python


@pytest.fixture(scope="session")
def spot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with spot.obj, spot.pt, sky.hdr and spot.h5, an asset of 4 × 8 view bins without lobes."""
    folder = tmp_path_factory.mktemp("spot")
    shipped = importlib.resources.files("prt_bake.shipped")
    for name in ("spot.obj", "spot.pt", "sky.hdr"):
        (folder / name).write_bytes((shipped / name).read_bytes())
    options = "--rings 4 --sectors 8 --samples 18 --lobes 0 --keep all"
    assert main(f"bake {folder}/spot.pt {folder}/spot.obj -o {folder}/spot.h5 {options}".split()) == 0
    return folder
