"""`prtbake report bases`: how much of a transport each basis of light represents."""

from pathlib import Path
from typing import Annotated

import typer

from formats.extras import EVALUATE, require
from prt_bake.cli.shared.kinds import SOURCE, refuse_other_kinds
from prt_bake.cli.shared.options import Seed
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say


def bases(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Network (.pt, .safetensors), or scene.toml (path traced).")
    ],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="Mesh of the object.")],
    light: Annotated[list[Path], typer.Option(metavar="SKY", help="Lat-long picture (.exr, .hdr); can be repeated.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the report.")] = Path(
        "bases-report"
    ),
    points: Annotated[int, typer.Option(min=8, max=4096, help="Points at which errors are measured.")] = 192,
    size: Annotated[int, typer.Option(min=0, max=512, help="Width and height of the picture; 0: none.")] = 48,
    seed: Seed = 0,
) -> None:
    """Measure how well harmonics, wavelets, Gaussians and learned functions represent a transport.

    Writes bases.md, bases.json and bases.png: relative errors of Ŝ and of radiance under each light, and FLIP in a
    picture under the first, by the numbers that a basis stores for a view bin.
    """
    from prt_bake.bases.report import report_bases, report_files

    twice = {sky.name for sky in light if [other.name for other in light].count(sky.name) > 1}
    if twice:
        raise typer.BadParameter(f"--light: expected skies of different names, found {min(twice)} twice; omit one")
    inputs = {"SOURCE": source, "MESH": mesh} | {f"--light {sky}": sky for sky in light}
    require("report bases", *EVALUATE)
    refuse_other_kinds({"SOURCE": (source, SOURCE), "MESH": (mesh, ("mesh",)), "--light": (light, ("sky",))})
    check_outputs({"--out": report_files(out)}, inputs, folder=out)
    from formats.mesh import read_mesh
    from prt_bake.baking.sources import open_source
    from prt_bake.lights.environment import read_environment

    surface = read_mesh(mesh)
    transport = open_source(source, surface)
    files = report_bases(
        transport,
        surface,
        {sky.name: read_environment(sky) for sky in light},
        out,
        up=str(getattr(transport, "metadata", {}).get("up", "y")),
        points=points,
        size=size,
        seed=seed,
        title=f"Bases of light for {source.name}",
        say=say,
    )
    print(files[0].read_text(encoding="utf-8"))
    for file in files:
        print(file)
