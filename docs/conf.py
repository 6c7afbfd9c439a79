"""Settings of the documentation site: `make docs` builds it into `docs/build/html`, without a network connection.

Pages are MyST Markdown. Three parts are made at every build: the reference of all commands, from the command line
itself; the lessons, which are the notebooks with their stored outputs; the gallery's live page.
"""

import re
import shutil
import sys
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))  # for the modules beside this file

project = "prtbake"
author = "the prtbake authors"
copyright = author
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["build", "**.ipynb_checkpoints"]
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
add_module_names = False
toc_object_entries_show_parents = "hide"

html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
copybutton_selector = "div:not(.highlight-text) > div.highlight > pre"


def write_commands() -> None:
    """Write the page of all commands and options, unless it is as it should be, so that it is not read again."""
    from commands_page import commands_page

    page, text = HERE / "reference" / "commands.md", commands_page()
    if not page.is_file() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")


def copy_lessons() -> None:
    """Copy the notebooks, which Sphinx only reads inside its own folder."""
    lessons = HERE / "lessons"
    shutil.rmtree(lessons, ignore_errors=True)
    lessons.mkdir()
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        shutil.copy(notebook, lessons)


def link_lessons(app: Sphinx, page: str, text: list[str]) -> None:
    """Turn links to the notebooks, which hold where the sources are read, into links to their copies."""
    text[0] = re.sub(r"\.\./notebooks/(\w+\.ipynb)", r"lessons/\1", text[0])


def setup(app: Sphinx) -> None:
    """Make the generated pages, read docstrings, and add the gallery's live page."""
    app.connect("source-read", link_lessons)
    write_commands()
    copy_lessons()
    import docstrings
    import live_page

    docstrings.connect(app)
    live_page.connect(app)
