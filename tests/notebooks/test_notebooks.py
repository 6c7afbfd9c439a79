"""The notebooks: stored without output, and each runs by itself, to its own laws, leaving nothing behind."""

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from tests import ROOT

PATHS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SECONDS_A_CELL = 1800
"""After which a cell is taken to hang; one in which kernels are compiled on busy cores takes minutes."""


@pytest.fixture(params=PATHS, ids=[path.stem for path in PATHS])
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


def code_of(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_they_are_all_there() -> None:
    assert [path.stem for path in PATHS] == ["1_harmonics", "2_relight", "3_error_against_time", "4_own_object"]


def test_it_is_stored_without_output(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    stored = [cell for cell in code_of(notebook) if cell.outputs or cell.execution_count is not None]
    assert [cell.source for cell in stored] == []
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    assert [dict(cell.metadata) for cell in notebook.cells if cell.metadata] == []


def test_its_cells_are_small_and_it_says_what_comes_next(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert [cell.source for cell in code_of(notebook) if len(cell.source.splitlines()) > 25] == []
    assert notebook.cells[0].source.startswith(f"# {path.stem[0]} · ")
    assert notebook.cells[-1].source.startswith("**Next**: ")
    assert sum(cell.source.count("\nassert ") for cell in code_of(notebook)) >= 5


def test_what_it_points_to_is_there(path: Path) -> None:
    prose = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown")
    linked = [path.parent / name for name in re.findall(r"\]\(([^)]+)\)", prose)]
    named = [ROOT / name for name in re.findall(r"\b(?:docs/\w+|README)\.md\b", prose)]
    assert linked + named
    assert [str(target) for target in linked + named if not target.exists()] == []


@pytest.mark.usefixtures("compiled_kernels")
def test_it_runs_to_its_own_laws(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder; what it asserts holds, its plots are drawn, and nothing is warned of or left behind."""
    begun_in, temporary, own = (tmp_path / name for name in ("begun", "temporary", "own"))
    for folder in (begun_in, temporary, own):
        folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    # What the kernel and torch keep for themselves.
    for variable in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "TORCHINDUCTOR_CACHE_DIR"):
        monkeypatch.setenv(variable, str(own))
    # The kernel's own backend draws without a window, into the notebook.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = nbformat.read(path, as_version=4)
    in_folder = {"metadata": {"path": str(begun_in)}}
    NotebookClient(notebook, timeout=SECONDS_A_CELL, kernel_name="python3", resources=in_folder).execute()

    for cell in code_of(notebook):
        assert cell.execution_count is not None
        warned = [output.text for output in cell.outputs if output.get("name") == "stderr"]
        assert warned == []
        shows = re.search(r"^(?:plt\.show|show)\(", cell.source, re.MULTILINE) is not None
        assert shows == any("image/png" in output.get("data", {}) for output in cell.outputs)
    assert list(begun_in.iterdir()) + list(temporary.iterdir()) == []
