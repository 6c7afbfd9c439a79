"""What is checked on pages without running them. Each check returns a sentence for every fault."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import typer
import typer.main
from typer.exceptions import TyperException

import prt_bake
from prt_bake.cli.main import app
from tests import ROOT
from tests.documents.commands import Block, blocks, in_code_font, prtbake_arguments, simple_commands

LONGEST_LINE = 150
_FOLDERS = "prt_bake|bakers|formats|tests|scenes|notebooks|docs"
_FILE = re.compile(rf"(?:{_FOLDERS})/[\w./-]*")
_MODULE = re.compile(r"-m ((?:prt_bake|bakers|formats|tests|scenes)(?:\.\w+)+)")
_NAME = r"\b(?!README|LICENSE|CONTRIBUTING|CITATION)[A-Z_]{3,}\b"
_PLACEHOLDER = re.compile(rf"[…*<>{{}}]|{_NAME}|\bstanford_|/build\b|docs/lessons")
_LINK = re.compile(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"")


@cache
def _prtbake() -> Any:
    return typer.main.get_command(app)


def command_faults(text: str) -> list[str]:
    """Commands of shell blocks, run or not, and of code font that cannot be: `prtbake`, `make`, `python -m`."""
    found = list[str]()
    for block in blocks(text):
        if block.language == "sh":
            found += [f"line {block.line + 1}: {fault}" for fault in _shell_faults(block)]
    for span in in_code_font(text):
        words = span.split()
        if words[0] == "prtbake":
            found += [f"`{span}`: {fault}" for fault in _named_options(words[1:])]
        elif words[0] == "make" and len(words) > 1:
            found += [f"`{span}`: {fault}" for fault in _target_faults(words)]
        elif words[0].startswith("--") and words[0] not in _all_options():
            found.append(f"`{span}`: no command has this option")
    return found + [f"{module}: there is no such module" for module in _MODULE.findall(text) if not _is_module(module)]


def _shell_faults(block: Block) -> Iterator[str]:
    try:
        commands = simple_commands(block.code)
    except ValueError as fault:
        yield f"the shell cannot read it: {fault}"
        return
    for words in commands:
        arguments = prtbake_arguments(words)
        if arguments is not None:
            yield from _parsing_fault(arguments)
        elif words[0] == "make":
            yield from _target_faults(words)


def _parsing_fault(arguments: list[str]) -> Iterator[str]:
    """Parse the arguments of `prtbake` as the command line does, without running the command."""
    if "--install-completion" in arguments:  # parsing it would install it
        return
    command, names, rest = _subcommand([word for word in arguments if word not in ("-v", "--verbose")])
    if hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        yield f"there is no command {rest[0]}"
        return
    try:
        command.make_context(" ".join(names), list(rest))
    except typer.Exit:  # of --help and --version
        pass
    except TyperException as error:  # wrong usage
        if type(error).__name__ != "NoArgsIsHelpError":
            yield f"{' '.join(['prtbake', *arguments])}: {getattr(error, 'message', error)}"


def _subcommand(words: list[str]) -> tuple[Any, list[str], list[str]]:
    """The command, its names from `prtbake` on, and the words after them."""
    command, names, rest = _prtbake(), ["prtbake"], list(words)
    while rest and rest[0] in getattr(command, "commands", {}):
        command = command.commands[rest[0]]
        names.append(rest.pop(0))
    return command, names, rest


def _named_options(words: list[str]) -> Iterator[str]:
    command, _, rest = _subcommand(words)
    if rest and hasattr(command, "commands") and re.fullmatch(r"[a-z][a-z-]*", rest[0]):
        yield f"there is no command {rest[0]}"
    elif not hasattr(command, "commands"):
        options = _options(command)
        yield from (
            f"has no option {word}"
            for word in re.findall(r"(?<!\S)\[?(--[a-z-]+)", " ".join(rest))
            if word not in options
        )


def _options(command: Any) -> set[str]:
    own = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return own | {"--help", "--version", "--verbose", "--install-completion", "--show-completion"}


@cache
def _all_options() -> set[str]:
    commands, found = [_prtbake()], set[str]()
    while commands:
        command = commands.pop()
        found |= _options(command)
        commands += getattr(command, "commands", {}).values()
    benchmarks = [path.read_text(encoding="utf-8") for path in (ROOT / "tests" / "bench").glob("*.py")]
    return found | set(re.findall(r'add_argument\("(--[a-z-]+)"', "\n".join(benchmarks)))


def _target_faults(words: list[str]) -> Iterator[str]:
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for word in words[1:]:
        if re.fullmatch(r"[a-z][a-z-]*", word) and word not in targets:
            yield f"the Makefile has no target {word}"


def _is_module(dotted: str) -> bool:
    path = ROOT / dotted.replace(".", "/")
    return dotted.rpartition(".")[2].isupper() or path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()


def python_faults(text: str) -> list[str]:
    """Python blocks that are not Python, or use names that `prt_bake` does not have."""
    found = list[str]()
    for block in blocks(text):
        if block.language == "python":
            try:
                tree = ast.parse("\n" * block.line + block.code)
            except SyntaxError as error:
                found.append(f"line {error.lineno}: {error.msg}")
                continue
            found += [
                f"line {node.lineno}: there is no prt.{node.attr}"
                for node in ast.walk(tree)
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "prt"
                if not hasattr(prt_bake, node.attr)
            ]
    return found


def file_faults(text: str) -> list[str]:
    """Files and folders of the repository in code font that do not exist."""
    named = [name for span in in_code_font(text) if not _PLACEHOLDER.search(span) for name in _FILE.findall(span)]
    return [f"`{name}`: there is no such file" for name in named if not (ROOT / name.rstrip(".")).exists()]


def link_faults(page: Path) -> list[str]:
    """Links of a page to files and headings that do not exist. Those of the web are not checked."""
    found = list[str]()
    for link in (first or second for first, second in _LINK.findall(_prose(page))):
        if re.match(r"https?:|mailto:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists():
            found.append(f"({link}): there is no such file")
        elif anchor and target.suffix == ".md" and anchor not in _anchors(_prose(target)):
            found.append(f"({link}): the page has no such heading")
    return found


def _prose(page: Path) -> str:
    """The text of a page without its blocks."""
    return re.sub(r"^ *(`{3,}).*?^ *\1 *$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def _anchors(text: str) -> set[str]:
    """The names that GitHub gives to the headings of a page."""
    found = set[str]()
    for heading in re.findall(r"^#{1,6} +(.+?) *#*$", text, re.MULTILINE):
        shown = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
        found.add(
            name if name not in found else next(f"{name}-{i}" for i in range(1, 99) if f"{name}-{i}" not in found)
        )
    return found


def long_lines(text: str) -> list[str]:
    """Lines that are too long, except rows of tables and lines that are one link or one span."""
    return [
        f"line {number}: {len(line)} characters; expected at most {LONGEST_LINE}"
        for number, line in enumerate(text.splitlines(), start=1)
        if len(line) > LONGEST_LINE and not line.lstrip().startswith("|")
    ]
