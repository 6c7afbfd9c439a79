"""Writes the reference of all commands, from the command line itself."""

import re
from collections.abc import Iterator
from typing import Any

import typer
from typer.main import get_command

from prt_bake.cli.main import app

_OPENING = """# Commands

Every command and option of `prtbake`, as printed by `prtbake COMMAND --help`.

* Most commands end with the next one to type, and say why something failed and what to do.
* Models, samples and assets that exist are replaced with `--force` only.
* Exit codes are 0, 1 if it failed, 2 for wrong usage, and 130 after Ctrl-C.
* `prtbake -v COMMAND …` prints what a report of a defect needs: versions, times, and where messages come from.
* `prtbake --install-completion` completes names and options in bash, zsh and fish.
* In Python the [same functions](python.md) have names of their own.
"""
_EXTRA = re.compile(r"\s*\[((?:default: |required|-?\d|x[<>])[^\[\]]*)\]$")
_KINDS = {
    r"<(\w+) range>": r"<\1>",
    r" <list\[Path\]>": "…",
    "<path>": "",
    "<str>": "TEXT",
    "<int>|<integer>": "N",
    "<float>": "X",
    r"\[(\w+)\] TEXT": r"[\1]",
}
_LONG = 24
"""Characters of a list of choices that is written beside the option."""
_UNBOUNDED = re.compile(r"x<=\d{7,}(\.0)?$")


def commands_page() -> str:
    """The page in Markdown: a table of all commands, then one section each, with a table of its options."""
    context = _context(get_command(app), "prtbake", None)
    groups: dict[str, list[Any]] = {}
    for name in context.command.list_commands(context):
        child = _context(context.command.get_command(context, name), name, context)
        groups.setdefault(child.command.rich_help_panel or "Commands", []).append(child)
    parts = [_OPENING, "| command | what it does |", "|---|---|"]
    for contexts in groups.values():
        parts += [f"| [`{each.command_path}`](#{_anchor(each)}) | {_first_sentence(each)} |" for each in contexts]
    for title, contexts in groups.items():
        parts += ["", f"## {title}"]
        for each in contexts:
            parts += _section(each)
    return "\n".join(parts) + "\n"


def _context(command: Any, name: str, parent: Any) -> Any:
    return typer.Context(command, info_name=name, parent=parent)


def _anchor(context: Any) -> str:
    return str(context.command_path).replace(" ", "-")


def _first_sentence(context: Any) -> str:
    return _prose(context.command.help.split("\n\n")[0])


def _section(context: Any) -> Iterator[str]:
    """A command, then its own commands."""
    command = context.command
    usage = " ".join(re.sub("[{}]", "", piece) for piece in command.collect_usage_pieces(context))
    yield from ("", f"### `{context.command_path}`", "", _prose(command.help), "")
    yield from ("```text", f"{context.command_path} {usage}", "```", "")
    names = command.list_commands(context) if hasattr(command, "list_commands") else []
    for heading, kind in (("argument", "argument"), ("option", "option")):
        rows = [each for each in command.get_params(context) if each.param_type_name == kind and each.name != "help"]
        if rows and not names:
            yield from (f"| {heading} | meaning | default |", "|---|---|---|")
            yield from (_row(*each.get_help_record(context)) for each in rows)
            yield ""
    for name in names:
        yield from _section(_context(command.get_command(context, name), name, context))


def _row(name: str, text: str) -> str:
    """One row: names and kind of value, meaning with its range, default."""
    extra = _EXTRA.search(text)
    notes = extra.group(1).split("; ") if extra else []
    meaning, default = _prose(_EXTRA.sub("", text)), ""
    for note in notes:
        if note == "required":
            default = note
        elif note.startswith("default: "):
            default = f"`{note.removeprefix('default: ')}`"
        elif not _UNBOUNDED.search(note):
            meaning += f" *({_range(note)})*"
    for kind, word in _KINDS.items():
        name = re.sub(kind, word, name)
    if (choices := re.search(r"<(\w[\w-]*(?:\|[\w-]+){2,})>", name)) and len(choices[1]) > _LONG:
        name = name.replace(choices[0], "NAME")
        meaning += f" *({', '.join(choices[1].split('|'))})*"
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in (f"`{name.strip()}`", meaning, default)) + " |"


def _range(note: str) -> str:
    """A range of values, such as "1<=x<=1024" or "x>=1", in words."""
    ends = [end.removesuffix(".0") for end in re.split(r"<=?|>=?", note)]
    return f"{ends[0]} to {ends[2]}" if len(ends) == 3 else f"{ends[1]} or {'more' if '>' in note else 'less'}"


def _prose(text: str) -> str:
    """Help as Markdown, with options in code font."""
    parts = text.split("`")
    for i in range(0, len(parts), 2):
        parts[i] = parts[i].replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")
        parts[i] = re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", parts[i])
    return "`".join(parts)
