"""Every benchmark starts: its imports exist and its settings are valid. The README lists all of them."""

import re
import runpy
import sys
from pathlib import Path

import pytest

from formats.mesh import refuse_inside_out
from tests.bench import pruning

BENCH = Path(__file__).parent
MODULES = [path for path in sorted(BENCH.glob("*.py")) if not path.name.startswith("test_")]
SCRIPTS = [path for path in MODULES if "__main__" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("script", SCRIPTS, ids=[path.stem for path in SCRIPTS])
def test_prints_its_help(script: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
    assert script.name in capsys.readouterr().out


def test_the_readme_lists_every_benchmark() -> None:
    table = (BENCH / "README.md").read_text(encoding="utf-8")
    assert [path.stem for path in SCRIPTS if f"`{path.stem}`" not in table] == []


def test_the_linked_results_show_the_benchmark() -> None:
    table = (BENCH / "README.md").read_text(encoding="utf-8")
    linked = re.findall(r"^\| `(\w+)`.*\]\((.+)\) \|$", table, re.MULTILINE)
    assert len(linked) > 20
    pages = {page: (BENCH / page).read_text(encoding="utf-8") for _, page in linked}
    assert [name for name, page in linked if f"tests.bench.{name}" not in pages[page]] == []


@pytest.mark.filterwarnings("ignore::formats.errors.InputWarning")
def test_pruning_measures_meshes_that_a_bake_accepts() -> None:
    for scene in pruning.scenes(0.01).values():
        refuse_inside_out(scene.mesh)
