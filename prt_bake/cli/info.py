"""`prtbake info`: prints the contents of a file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from prt_bake.cli.shared.next_step import command, say_next_of_file
from prt_bake.cli.shared.options import AsJson
from prt_bake.cli.shared.progress import say

_LONGEST_LIST = 100
"""Characters; longer lists are printed as their length."""


def info(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Mesh, picture, scene, lights, model, importance module, ONNX function, asset or samples.",
        ),
    ],
    all_figures: Annotated[bool, typer.Option("--all", help="Print every figure and setting in the file.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print what a file is, its object, its size and its error."""
    from formats.json_report import as_text
    from prt_bake.inspection.files import describe
    from prt_bake.inspection.overview import overview

    description = describe(file)
    if as_json:
        print(as_text(description))
        return
    lines = dict(_lines(description)) if all_figures else overview(description)
    width = max(map(len, lines))
    for name, value in lines.items():
        print(f"{name:<{width}}  {value}")
    if not all_figures:
        say(f"every figure: {command('prtbake', 'info', file, '--all')}")
    say_next_of_file(description["kind"], file)


def _lines(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield (name, text) per line; nested tables are flattened to "outer: inner"."""
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _lines(value, f"{prefix}{name}: ")
        elif isinstance(value, list | tuple) and len(str(value)) > _LONGEST_LIST:
            yield f"{prefix}{name}", f"{len(value)} entries, see --json"
        else:
            yield f"{prefix}{name}", str(value)
