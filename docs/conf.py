"""Settings of the documentation site: `make docs` builds it into `docs/build/html`, without a network connection.

Pages are MyST Markdown. Two parts are made at every build: the reference of all commands, from the command line itself,
and the lessons, which are the notebooks with their stored outputs.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent

project = "prtbake"
author = "the prtbake authors"
copyright = author
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["build", "old", "**.ipynb_checkpoints"]
html_theme = "furo"
html_title = "prtbake"
html_show_sphinx = False

myst_heading_anchors = 3  # links to headings, as on GitHub
nb_execution_mode = "off"
nitpicky = True
nitpick_ignore_regex = [("py:.*", r".*")]  # types of other libraries have no pages here

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings state shapes and units, which types do not
napoleon_use_rtype = False


def write_commands() -> None:
    """Write the page of all commands and options from their `--help`."""
    page = HERE / "reference" / "commands.md"
    arguments = ["prt_bake.cli.main", "utils", "docs", "--name", "prtbake", "--title", "Commands"]
    subprocess.run([sys.executable, "-m", "typer", *arguments, "--output", str(page)], check=True, capture_output=True)


def copy_lessons() -> None:
    """Copy the notebooks, which Sphinx only reads inside its own folder."""
    lessons = HERE / "lessons"
    shutil.rmtree(lessons, ignore_errors=True)
    lessons.mkdir()
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        shutil.copy(notebook, lessons)


def as_restructured_text(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Mark code in docstrings, which are plain text with `names` and indented formulae, as Sphinx expects it."""
    text = re.sub(r"(?<![:`])`([^`\n]+)`(?!`)", r"``\1``", "\n".join(lines))
    lines[:] = re.sub(r":(\n\n    (?!>>>))", r"::\1", text).split("\n")


def setup(app: Sphinx) -> None:
    """Make the generated pages, and read docstrings."""
    write_commands()
    copy_lessons()
    app.connect("autodoc-process-docstring", as_restructured_text)
