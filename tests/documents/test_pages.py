"""Every page: its commands and names exist, its links lead somewhere, its lines are short."""

from pathlib import Path

import pytest

from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.report.picture import FLIP
from prt_bake.trainer.report.quality import LEVELS
from prt_bake.trainer.report.summary import COEFFICIENTS, COEFFICIENTS_PLAIN, WHITE_SKY
from prt_bake.trainer.samples.rows import StreamSettings
from tests import ROOT
from tests.documents.checks import command_faults, file_faults, link_faults, long_lines, python_faults
from tests.documents.commands import name, pages
from tests.documents.run import run_page

PACKAGES = ("formats", "bakers", "prt_bake")
PAGES = {name(page): page for page in pages()}
RECORD = ("docs/changelog.md",)
"""Pages that tell of the past, whose names may be gone."""
LIVING = {page: path for page, path in PAGES.items() if page not in RECORD}
LINKED = {page: path for page, path in PAGES.items() if not page.startswith("docs/")}
"""Sphinx checks the links of the site."""
SHOWN_FIRST = ["README.md", "docs/start/first_result.md", "docs/start/mesh_from_modeller.md"]
"""Pages whose commands the tests run; `make docs-commands` runs those of all pages."""


@pytest.mark.parametrize("page", LIVING)
def test_commands_exist(page: str) -> None:
    assert command_faults(LIVING[page].read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", LIVING)
def test_python_is_valid(page: str) -> None:
    assert python_faults(LIVING[page].read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", LIVING)
def test_named_files_exist(page: str) -> None:
    assert file_faults(LIVING[page].read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", LINKED)
def test_links_lead_somewhere(page: str) -> None:
    assert link_faults(LINKED[page]) == []


@pytest.mark.parametrize("page", PAGES)
def test_lines_are_short(page: str) -> None:
    assert long_lines(PAGES[page].read_text(encoding="utf-8")) == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_the_site_has_every_page() -> None:
    contents = (ROOT / "docs/index.md").read_text(encoding="utf-8").split()
    site = [
        path.relative_to(ROOT / "docs").with_suffix("").as_posix()
        for path in map(Path, PAGES.values())
        if (ROOT / "docs") in path.parents
    ]
    assert [page for page in site if page not in contents] == ["index"]


def test_the_page_of_the_network_has_the_settings_of_a_training() -> None:
    text = " ".join((ROOT / "docs/explanation/network.md").read_text(encoding="utf-8").split())
    learning, stream = LearningSettings(), StreamSettings()
    assert f"{learning.spread} uniform directions, the second from exits" in text
    assert f"the first {learning.coarse_steps} steps use a third of the rays" in text
    assert f"{stream.least_exits} to {stream.exits} paths per query" in text
    assert f"by {stream.kept} rays" in text
    assert f"Batches stay at {learning.batch} queries" in text


def test_the_page_of_trainings_has_the_bounds_of_their_criteria() -> None:
    text = (ROOT / "docs/how_to/training.md").read_text(encoding="utf-8")
    assert f"| {100 * COEFFICIENTS:g} %; {100 * COEFFICIENTS_PLAIN:g} % for a homogeneous" in text
    assert f"over views | {100 * WHITE_SKY:g} % |" in text
    assert f"from behind | {FLIP:g} |" in text
    for bound, words in LEVELS[:-1]:
        assert f"| {100 * bound:g} % | {words.removeprefix('good for ')} |" in text


@pytest.mark.statistics
@pytest.mark.parametrize("page", SHOWN_FIRST)
def test_commands_run(page: str) -> None:
    assert run_page(PAGES[page]).failures == []


def test_the_map_of_the_code_has_every_room() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    mapped = text.partition("## Map of the code")[2].partition("\n## ")[0]
    rooms = (path.parent for name in PACKAGES for path in (ROOT / name).rglob("__init__.py"))
    assert [str(room.relative_to(ROOT)) for room in rooms if f"{room.name}/" not in mapped] == []
