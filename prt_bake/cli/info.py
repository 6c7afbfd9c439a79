"""`prtbake info`: what a file holds."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from prt_bake.cli.shared.options import AsJson

_LONGEST = 100
"""Characters of a list that is printed."""


def describe(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Any file of ours, or a mesh or sky.")],
    as_json: AsJson = False,
) -> None:
    """Print what a mesh, sky, scene, model, asset or file of samples holds."""
    from prt_bake.inspection.files import describe as read_description

    description = read_description(file)
    if as_json:
        print(json.dumps(description, indent=2))
        return
    lines = dict(_lines(description))
    width = max(map(len, lines))
    for name, value in lines.items():
        print(f"{name:<{width}}  {value}")


def _lines(values: dict[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """What stands in a line of its own: tables within tables by their names, of long lists how long they are."""
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _lines(value, f"{before}{name}: ")
        elif isinstance(value, list | tuple) and len(str(value)) > _LONGEST:
            yield f"{before}{name}", f"{len(value)} entries, see --json"
        else:
            yield f"{before}{name}", str(value)
