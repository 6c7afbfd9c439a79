"""The list of messages, and what they have in common."""

import ast

from tests import ROOT
from tests.messages import messages

DOCUMENTS = ("docs/", "README")
SOURCE = """
def read(path):
    if not path.exists():
        raise StorageError(f"{path}: there is no such file; " + "check the name")
    warn(f"{path}: {count(path):,} rows were skipped")
    faults.append("the header has no end")
    yield f"{name!r} is not known here"
    names.append("short")
    raise fault
    raise TypeError(f"{kind}")
"""


def test_errors_warnings_and_parts_of_messages_are_listed() -> None:
    assert list(messages(SOURCE)) == [
        (4, "StorageError", "{path}: there is no such file; check the name"),
        (5, "warn", "{path}: {count(path)} rows were skipped"),
        (6, "append", "the header has no end"),
        (7, "part", "{name} is not known here"),
        (10, "TypeError", "{kind}"),
    ]


def test_errors_about_files_begin_with_the_file_or_the_argument() -> None:
    found = []
    for path in sorted((ROOT / "formats").rglob("*.py")):
        for line, kind, text in messages(path.read_text(encoding="utf-8")):
            if kind.endswith("Error") and kind != "ValueError" and not text.startswith(("{", "light {", "mesh: ")):
                found.append((path.name, line, text))
    assert found == []


def test_no_text_names_a_document_that_an_installed_package_lacks() -> None:
    found = []
    for path in (path for folder in ("formats", "bakers", "prt_bake") for path in (ROOT / folder).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if path == ROOT / "prt_bake" / "olat" / "description.py":
            continue  # it writes a README.md
        if not any(name in source for name in DOCUMENTS):
            continue
        tree = ast.parse(source)
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        constants = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in docstrings)
        found += [(path.name, node.lineno) for node in constants if any(name in str(node.value) for name in DOCUMENTS)]
    assert found == []
