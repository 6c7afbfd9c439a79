"""`prtbake info`: what a file holds."""

import json
from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.options import AsJson


def describe(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Any file of ours, or a mesh or sky.")],
    as_json: AsJson = False,
) -> None:
    """Print what a mesh, sky, scene, model, asset or file of samples holds."""
    from prt_bake.inspection import describe as read_description

    description = read_description(file)
    if as_json:
        print(json.dumps(description, indent=2))
        return
    width = max(map(len, description))
    for name, value in description.items():
        print(f"{name:<{width}}  {value}")
