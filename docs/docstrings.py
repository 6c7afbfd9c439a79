"""Shows docstrings, which are plain text with `names` and indented formulae, as Sphinx expects it."""

import dataclasses
import re
from collections.abc import Iterator

from sphinx.application import Sphinx

_BUILT_BY_USERS = ("Camera", "Lighting", "Mesh")
_SECTION = re.compile(r"^(Args|Attributes):$")


def connect(app: Sphinx) -> None:
    """Read docstrings and signatures with the functions below."""
    app.connect("autodoc-process-docstring", _as_restructured_text, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", _short_signature)


def _as_restructured_text(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Mark code, and show arguments and attributes as tables."""
    lines[:] = _code_marked("\n".join(_with_tables(lines))).split("\n")


def _short_signature(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str, returns: str
) -> tuple[str, str] | None:
    """Records that functions return are shown without the arguments of their constructor, functions by their name."""
    if what == "class" and dataclasses.is_dataclass(obj) and name.split(".")[-1] not in _BUILT_BY_USERS:
        return "", ""
    return (re.sub(r"<(?:built-in )?function (\w+)[^>]*>", r"\1", signature), returns) if signature else None


def _code_marked(text: str) -> str:
    """Code font for `names`; blocks for indented formulae after a blank line."""
    text = re.sub(r"(?<![:`])`([^`\n]+)`(?!`)(?=([\w²³]?))", lambda m: f"``{m[1]}``" + ("\\ " if m[2] else ""), text)
    text = re.sub(r"(?<!:)\*\*(?=[a-z]|$)", r"\\*\\*", text)
    return re.sub(r":(\n\n    (?!>>>))", r"::\1", text)


def _with_tables(lines: list[str]) -> Iterator[str]:
    """Turn the entries `name: text` of a section Args or Attributes into the rows of a table."""
    rows: list[list[str]] | None = None
    for line in [*lines, ""]:
        entry = re.match(r"^    ([\w*, ]+): (.*)$", line)
        if rows is not None and entry:
            rows.append([entry.group(1), entry.group(2)])
        elif rows and line.startswith("     "):
            rows[-1].append(line.strip())
        elif _SECTION.match(line):
            rows = []
        else:
            if rows:
                yield from _table(rows)
            rows = None
            yield line


def _table(rows: list[list[str]]) -> Iterator[str]:
    yield from ("", ".. list-table::", "   :class: arguments", "   :widths: auto", "")
    for names, *text in rows:
        yield "   * - " + ", ".join(f"``{name.strip()}``" for name in names.split(","))
        yield "     - " + " ".join(text)
    yield ""
