"""Every public name of `prt_bake` has an example in its docstring, and the example works beside the shipped files.

The example of `PrtbakeError` stands for all errors.
"""

import doctest
import shutil
from pathlib import Path

import pytest

import prt_bake as prt
from tests import ROOT

SHIPPED = ROOT / "prt_bake" / "shipped"


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped files, and a coarse asset of them."""
    folder = tmp_path_factory.mktemp("shipped")
    for name in ("spot.toml", "spot.obj", "spot.pt", "sky.hdr", "sigma_t.npy", "albedo.npy"):
        shutil.copy(SHIPPED / name, folder)
    model, mesh = prt.load_model(folder / "spot.pt"), prt.read_mesh(folder / "spot.obj")
    prt.bake(model, mesh, rings=1, sectors=4, samples=18, out=folder / "spot.h5")
    return folder


NAMES = [name for name in prt.__all__ if name == "PrtbakeError" or not name.endswith(("Error", "Warning"))]
SLOW = dict.fromkeys(("add_lobes", "train"), pytest.mark.statistics)


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW.get(name, ())) for name in NAMES])
def test_the_example_in_the_docstring_works(name: str, shipped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = getattr(prt, name).__doc__ or ""
    examples = doctest.DocTestParser().get_doctest(text, {"prt": prt}, name, None, None)
    assert examples.examples, f"{name} has no example in its docstring"
    assert "+SKIP" not in text
    monkeypatch.chdir(shipped)
    report: list[str] = []
    doctest.DocTestRunner().run(examples, out=report.append)
    assert not report, "".join(report)
