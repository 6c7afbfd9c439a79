"""`prtbake materials`: lists the materials that scenes can name."""

import math
import re
import textwrap
from typing import Annotated

import typer


def complete_material() -> list[str]:
    """Return the names of materials for a shell, with hyphens in place of what would need quotes."""
    from formats.scene.materials import materials as table

    return [re.sub(r"[\W_]+", "-", material.name) for material in table().values()]


def materials(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[NAME]", help="One material.", show_default=False, autocompletion=complete_material),
    ] = None,
) -> None:
    """List the materials that a scene can name.

    Columns: transport mean free path and diffuse mean free path in mm, and albedo, for red, green and blue; index of
    refraction.
    """
    import numpy as np

    from formats.scene.materials import find_material
    from formats.scene.materials import materials as table
    from prt_bake.inspection.translucency import translucency

    try:
        chosen = list(table().values()) if name is None else [find_material(name)]
    except KeyError as cause:
        raise typer.BadParameter(f"unknown material {name!r}; {cause.args[0]}") from None
    width = max(len(material.name) for material in chosen)
    group = ""
    for material in chosen:
        if material.group != group:
            group = material.group
            print(textwrap.fill(f"{group}: {material.source.removeprefix('an estimate: ')}", 100))
            print(f"  {'':<{width}}  {'transport mm':^18}  {'diffuse mm':^18}  {'albedo':^18}  eta")
        scattering, absorption = np.array(material.sigma_s_reduced), np.array(material.sigma_a)
        light = translucency(scattering, absorption, 0.0, 1.0)
        numbers = (light.transport, light.diffuse, scattering / (scattering + absorption))
        columns = "  ".join(" ".join(f"{_short(value):>5}" for value in values) + " " for values in numbers)
        print(f"  {material.name:<{width}}  {columns} {material.eta:g}")
    print("transport: how far light goes until its direction is lost; an object 5 to 50 times as long glows")
    print("diffuse: how deep it gets; albedo: what is left of it after one scattering; eta: index of refraction")


def _short(value: float) -> str:
    """Return a number in five characters."""
    if value == math.inf:
        return "inf"
    return f"{value:.0f}" if value >= 100.0 else f"{value:.1f}" if value >= 10.0 else f"{value:.3f}"
