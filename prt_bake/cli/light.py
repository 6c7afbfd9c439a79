"""`prtbake light`: projects an environment on spherical harmonics."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.options import AsJson, Mend, Rotate
from prt_bake.cli.shared.progress import say

_ROWS_FOR_SUNS = 2048


def light(
    environment: Annotated[
        Path,
        typer.Argument(
            metavar="ENVIRONMENT",
            help="Lat-long sky (.exr, .hdr, .png), lights file (.toml) or sun:x,y,z[:r,g,b][:degrees].",
        ),
    ],
    degree: Annotated[int, typer.Option(min=0, max=20, help="Highest SH degree l.")] = 2,
    up: Annotated[Literal["y", "z"], typer.Option(help="Axis of the sky that points up.")] = "y",
    rotate: Rotate = 0.0,
    mend: Mend = False,
    as_json: AsJson = False,
) -> None:
    """Print the SH coefficients and the suns of an environment.

    The coefficients b_lm project radiance (linear Rec.709) on real orthonormal harmonics without Condon–Shortley phase,
    index l(l+1)+m; nothing is pre-convolved. Suns are small strong sources in a sky. They are included in the
    coefficients; `prtbake shade` splits them off.
    """
    refuse_other_kinds({"ENVIRONMENT": (environment, LIGHT)})
    from formats.json_report import as_text
    from prt_bake.lights.harmonics import project_lighting
    from prt_bake.lights.lighting import read_lighting
    from prt_bake.lights.sun_detection import split_suns

    # Suns of a larger sky are found in a downsampled copy, made while its coefficients are summed.
    lighting = read_lighting([environment], up, rotate, mend=mend, say=say, most_rows=_ROWS_FOR_SUNS, degree=degree)
    coefficients, skies = project_lighting(lighting, degree), [split_suns(sky) for sky in lighting.skies]
    found = [pair for sky in skies for pair in zip(sky.suns, sky.shares, strict=True)]
    if as_json:
        suns = [
            {
                "direction": sun.direction.tolist(),
                "irradiance": sun.irradiance.tolist(),
                "angular_diameter": sun.angular_diameter,
                "share": share,
            }
            for sun, share in found
        ]
        result = {"up": up, "degree": degree, "rotate": rotate, "coefficients": coefficients.tolist(), "suns": suns}
        print(as_text(result))
        return
    print(f"{'l':>2} {'m':>3} {'R':>14} {'G':>14} {'B':>14}")
    bands = [(l, m) for l in range(degree + 1) for m in range(-l, l + 1)]
    for (l, m), (red, green, blue) in zip(bands, coefficients, strict=True):
        print(f"{l:>2} {m:>3} {red:>14.8g} {green:>14.8g} {blue:>14.8g}")
    total = "the energy" if len(skies) == 1 else "the energy of its sky"
    for sun, share in found:
        direction, irradiance = (",".join(f"{x:.6g}" for x in vector) for vector in (sun.direction, sun.irradiance))
        print(f"sun:{direction}:{irradiance}:{sun.angular_diameter:.4g}  {share:.1%} of {total}")
