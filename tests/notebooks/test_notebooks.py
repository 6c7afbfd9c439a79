"""The notebooks are stored with their outputs, run without errors or warnings, and leave no files."""

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellTimeoutError

import prt_bake as prt
from tests import ROOT

pytestmark = pytest.mark.statistics

PATHS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SECONDS_PER_CELL = 300
"""Timeout of a cell; a training on busy cores takes minutes."""


@pytest.fixture(params=PATHS, ids=[path.stem for path in PATHS])
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


def code_of(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def shows(cell: Any) -> bool:
    return re.search(r"^(?:plt\.show|show)\(", cell.source, re.MULTILINE) is not None


def has_picture(cell: Any) -> bool:
    return any("image/png" in output.get("data", {}) for output in cell.outputs)


def test_all_notebooks_exist() -> None:
    assert [path.stem for path in PATHS] == ["1_harmonics", "2_relight", "3_error_against_time", "4_own_object"]


def test_a_notebook_is_stored_with_its_outputs(path: Path) -> None:
    """Run `python -m tests.notebooks.store` after a change."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = code_of(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert [cell.source for cell in cells if shows(cell) and not has_picture(cell)] == []
    kinds = {output.get("name", output.output_type) for cell in cells for output in cell.outputs}
    assert kinds <= {"stdout", "display_data", "execute_result"}
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    assert [dict(cell.metadata) for cell in notebook.cells if cell.metadata] == []


def test_stored_outputs_are_small_and_name_no_folder() -> None:
    texts = [path.read_text(encoding="utf-8") for path in PATHS]
    assert sum(map(len, texts)) < 2e6
    assert [path.stem for path, text in zip(PATHS, texts, strict=True) if "/home/" in text or "/tmp/" in text] == []


def test_notebooks_use_public_names_alone(path: Path) -> None:
    code = "\n".join(cell.source for cell in code_of(nbformat.read(path, as_version=4)))
    assert re.findall(r"^(?:from|import) (?:prt_bake|bakers|formats)\b.*", code, re.MULTILINE) == [
        "import prt_bake as prt"
    ]
    assert set(re.findall(r"\bprt\.(\w+)", code)) <= set(prt.__all__)


def test_cells_are_small_and_the_last_one_names_the_next_notebook(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert [cell.source for cell in code_of(notebook) if len(cell.source.splitlines()) > 25] == []
    assert notebook.cells[0].source.startswith(f"# {path.stem[0]} · ")
    assert notebook.cells[-1].source.startswith("**Next**: ")
    assert sum(cell.source.count("\nassert ") for cell in code_of(notebook)) >= 5


def test_linked_files_exist(path: Path) -> None:
    prose = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown")
    links = [path.parent / name for name in re.findall(r"\]\(([^)]+)\)", prose)]
    names = [ROOT / name for name in re.findall(r"\b(?:docs/[\w/]+|README)\.md\b", prose)]
    assert links + names
    assert [str(target) for target in links + names if not target.exists()] == []


@pytest.mark.usefixtures("compiled_kernels")
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its assertions hold and its plots are drawn, without warnings and without files left behind."""
    try:
        notebook = executed(path, tmp_path / "first", monkeypatch)
    except CellTimeoutError:  # on a busy machine Jupyter may lose the reply of a cell
        notebook = executed(path, tmp_path / "second", monkeypatch)

    for cell in code_of(notebook):
        assert cell.execution_count is not None
        warnings = [output.text for output in cell.outputs if output.get("name") == "stderr"]
        assert warnings == []
        assert shows(cell) == has_picture(cell)


def executed(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The notebook with its outputs, run in a folder of its own, which it leaves empty."""
    working, temporary, settings = (folder / name for name in ("working", "temporary", "settings"))
    for each in (working, temporary, settings):
        each.mkdir(parents=True)
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    # Folders of the Jupyter kernel and of torch.
    for variable in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "TORCHINDUCTOR_CACHE_DIR"):
        monkeypatch.setenv(variable, str(settings))
    # The kernel's default backend draws into the notebook.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = nbformat.read(path, as_version=4)
    in_folder = {"metadata": {"path": str(working)}}
    NotebookClient(notebook, timeout=SECONDS_PER_CELL, kernel_name="python3", resources=in_folder).execute()
    assert list(working.iterdir()) + list(temporary.iterdir()) == []
    return notebook
