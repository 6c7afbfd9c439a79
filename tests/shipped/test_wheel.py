"""The wheel, without the repository: what it holds, and that it runs where nothing can be written but the output."""

import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from prt_bake.shipped.demonstration import FILES
from tests import ROOT

pytestmark = pytest.mark.statistics

PACKAGES = ("formats", "bakers", "prt_bake")
PAGE = ROOT / "prt_bake" / "export" / "page"
"""Of the page, what `make site` reads is left out."""
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture(scope="module")
def wheel(place: Path) -> Path:
    """The wheel, built from a copy of the sources, so that an earlier build leaves nothing in it."""
    for name in PACKAGES:
        shutil.copytree(ROOT / name, place / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, place / "source")
    (place / "source/prt_bake/shipped/spot.train.pt").write_bytes(b"written there by mistake")
    built = ("wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", place / "wheel", place / "source")
    subprocess.run([*PIP, *built], check=True)
    (found,) = (place / "wheel").iterdir()
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, place: Path) -> Iterator[Path]:
    """A read-only folder of packages with the wheel alone; everything else is that of this environment."""
    target = place / "packages"
    subprocess.run([*PIP, "install", "--no-deps", "--no-index", "--no-compile", "--target", target, wheel], check=True)
    for folder in [path for path in target.rglob("*") if path.is_dir()]:
        (folder / "__pycache__").write_bytes(b"")  # not even root can write a cache there
    everything = [target, *target.rglob("*")]
    for path in everything:
        path.chmod(path.stat().st_mode & 0o555)
    yield target
    for path in everything:
        path.chmod(path.stat().st_mode | 0o200)


def test_the_wheel_holds_the_packages_and_the_shipped_files_alone(wheel: Path) -> None:
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = (path for name in PACKAGES for path in (ROOT / name).rglob("*") if "__pycache__" not in path.parts)
    carried = {path for pattern in ("*.html", "*.js", "*.css", "vendor/**/*") for path in PAGE.glob(pattern)}
    assert names == {str(path.relative_to(ROOT)) for path in files if path.is_file() and PAGE not in path.parents} | {
        str(path.relative_to(ROOT)) for path in carried if path.is_file()
    }


def test_the_demo_runs_from_a_wheel_without_a_home(installed: Path, place: Path) -> None:
    work = place / "work"
    work.mkdir()
    (work / "cache").write_bytes(b"")  # without HOME the cache is in the folder of the password file's home
    environment = {"PYTHONPATH": str(installed), "XDG_CACHE_HOME": str(work / "cache"), "OMP_NUM_THREADS": "1"}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-W", "error", "-m", "prt_bake", *words]
        return subprocess.run(line, cwd=work, env=environment, capture_output=True, text=True, check=False)

    shown = run("--verbose", "example", "spot")
    assert shown.returncode == 0, shown.stderr
    demo = run("demo", "--out", "demo")
    assert demo.returncode == 0, demo.stderr
    assert all((work / "demo" / name).is_file() for name in FILES)
    assert "prtbake: compiling kernels; this takes about a minute in every run" in demo.stderr
    assert "Warning" not in demo.stderr
    assert not [path for path in installed.rglob("__pycache__") if path.is_dir()]
