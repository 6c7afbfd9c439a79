"""`prtbake light`: the spherical harmonics of an environment."""

import json
from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.options import AsJson, Mend, Rotate, Up
from prt_bake.cli.progress import say


def light(
    environment: Annotated[Path, typer.Argument(metavar="ENVIRONMENT", help="Lat-long sky, .exr, .hdr or .png.")],
    degree: Annotated[int, typer.Option(min=0, max=20, help="Highest degree l.")] = 2,
    up: Up = None,
    rotate: Rotate = 0.0,
    mend: Mend = False,
    as_json: AsJson = False,
) -> None:
    """Print the spherical harmonics b_lm of an environment.

    They are those of its radiance (linear Rec.709), in real orthonormal harmonics without Condon–Shortley phase, index
    l(l+1)+m; nothing is pre-convolved.
    """
    from prt_bake.environment import open_environment, project, rotate_light

    axis = up or "y"
    sky = open_environment(environment, mend, say)
    coefficients = rotate_light(project(sky, degree, axis), rotate, axis)
    if as_json:
        lighting = {"up": axis, "degree": degree, "rotate": rotate, "coefficients": coefficients.tolist()}
        print(json.dumps(lighting, indent=2))
        return
    print(f"{'l':>2} {'m':>3} {'R':>14} {'G':>14} {'B':>14}")
    bands = [(l, m) for l in range(degree + 1) for m in range(-l, l + 1)]
    for (l, m), (red, green, blue) in zip(bands, coefficients, strict=True):
        print(f"{l:>2} {m:>3} {red:>14.8g} {green:>14.8g} {blue:>14.8g}")
