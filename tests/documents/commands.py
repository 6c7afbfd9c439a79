"""The Markdown pages of the repository: their blocks of code, their commands, and the names in code font.

Fenced blocks in `sh` and `python` are run. A line `<!-- not run: reason -->` above a block excludes it, and a line
`<!-- run: command -->` is a command that the page does not show.
"""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests import ROOT

PAGES = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "scenes/**/README.md", "notebooks/*.md", "tests/bench/*.md")
NOT_PAGES = ("docs/build/", "docs/lessons/", "docs/reference/commands.md")
"""Pages that a build makes."""
_FENCE = re.compile(r" *(`{3,})(\S*)")
_NOT_RUN = re.compile(r" *<!-- not run: (.+) -->$")
_HIDDEN = re.compile(r" *<!-- run: (.+) -->$")
_OPERATORS = ";&|()<>"
_VARIABLE = re.compile(r"\$\([^()]*\)|\$\{\w+\}|\$\w+")


class Block(NamedTuple):
    """A block of code. `line` is the page's line, from 1, before the first line of `code`."""

    line: int
    language: str
    code: str
    reason: str | None = None
    """Why it is not run."""

    @property
    def runs(self) -> bool:
        return self.language in ("sh", "python") and self.reason is None


def pages(root: Path = ROOT) -> list[Path]:
    """Every page that is written by hand."""
    found = sorted({path for pattern in PAGES for path in root.glob(pattern)})
    return [path for path in found if not path.relative_to(root).as_posix().startswith(NOT_PAGES)]


def name(page: Path) -> str:
    """The page's name in messages."""
    return page.relative_to(ROOT).as_posix() if page.is_relative_to(ROOT) else str(page)


def blocks(text: str) -> list[Block]:
    """The fenced blocks and hidden commands of a page, in order.

    Raises ValueError if a `not run` line has no block, or a fence no end.
    """
    found, lines, reason = list[Block](), iter(enumerate(text.splitlines(), start=1)), None
    for number, line in lines:
        if excluded := _NOT_RUN.match(line):
            reason = excluded[1]
        elif hidden := _HIDDEN.match(line):
            found.append(Block(number - 1, "sh", hidden[1]))
        elif fence := _FENCE.match(line):
            code = list(_until(fence[1], number, lines))
            found.append(Block(number, fence[2], _without_indent(code, line), reason))
            reason = None
        elif reason is not None and line.strip():
            raise ValueError(f"line {number}: expected a block below `not run: {reason}`, found {line!r}")
    if reason is not None:
        raise ValueError(f"expected a block below `not run: {reason}`, found the end of the page")
    return found


def _until(fence: str, opened: int, lines: Iterator[tuple[int, str]]) -> Iterator[str]:
    for _, line in lines:
        if line.strip().startswith(fence) and set(line.strip()) == {"`"}:
            return
        yield line
    raise ValueError(f"line {opened}: the block has no end")


def _without_indent(code: list[str], opening: str) -> str:
    indent = len(opening) - len(opening.lstrip())
    return "\n".join(line[min(indent, len(line) - len(line.lstrip())) :] for line in code)


def simple_commands(code: str) -> list[list[str]]:
    """The words of each simple command of a shell script: of each side of `&&`, `|` and `;`.

    Variables and `$(…)` become 1; redirections, comments and assignments are left out.
    """
    found = list[list[str]]()
    for line in code.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(_VARIABLE.sub("1", line), posix=True, punctuation_chars=_OPERATORS)
        lexer.whitespace_split = True
        words, redirected = list[str](), False
        for word in [*lexer, ";"]:
            if redirected:
                redirected = False
            elif not set(word) <= set(_OPERATORS):
                words.append(word)
            elif {"<", ">"} & set(word):
                redirected = True
            else:
                found.append(_without_assignments(words))
                words = []
    return [words for words in found if words]


def _without_assignments(words: list[str]) -> list[str]:
    first = next((i for i, word in enumerate(words) if not re.match(r"\w+=", word)), len(words))
    return words[first:]


def in_code_font(text: str) -> list[str]:
    """The contents of the spans in code font, outside of blocks."""
    prose, inside = list[str](), ""
    for line in text.splitlines():
        fence = _FENCE.match(line)
        if fence and not inside:
            inside = fence[1]
        elif inside and line.strip() == inside:
            inside = ""
        elif not inside:
            prose.append(line)
    return [span.strip() for _, span in re.findall(r"(?<!`)(`+)(?!`)(.+?)(?<!`)\1(?!`)", "\n".join(prose))]


def prtbake_arguments(words: list[str]) -> list[str] | None:
    """The arguments of `prtbake` in a simple command, which another program may start; None if it is another one."""
    for i, word in enumerate(words):
        if word.rpartition("/")[2] == "prtbake":
            return words[i + 1 :]
        if words[i : i + 2] == ["-m", "prt_bake"]:
            return words[i + 2 :]
    return None
