"""`prtbake report bake`: measures the error of bakes against their run time."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from formats.extras import EVALUATE, require
from prt_bake.cli.shared.ineffective import refuse_given
from prt_bake.cli.shared.kinds import SOURCE, refuse_other_kinds
from prt_bake.cli.shared.mesh_name import naming_mesh
from prt_bake.cli.shared.options import Eye, Seed, View
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say
from prt_bake.cli.shared.viewing import refuse_view_and_eye


@naming_mesh
def bake(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="model.pt (neural) or scene.toml (path traced).")],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="Mesh to bake.")],
    scene: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE.toml",
            help="Scene of the model: adds path-traced bakes and the model's error.",
            show_default=False,
        ),
    ] = None,
    light: Annotated[
        Path | None,
        typer.Option(metavar="SKY", help="Sky of a picture, whose error budget is added.", show_default=False),
    ] = None,
    side: View = None,
    eye: Eye = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the report.")] = Path(
        "bake-report"
    ),
    rings: Annotated[int, typer.Option(min=1, max=1024, help="View bins along the cosine to the normal.")] = 16,
    sectors: Annotated[int, typer.Option(min=1, max=1024, help="View bins around the normal.")] = 64,
    degree: Annotated[int, typer.Option(min=0, max=20, help="Highest SH degree l.")] = 2,
    vertices: Annotated[int, typer.Option(min=1, max=4096, help="Random vertices to measure.")] = 12,
    points: Annotated[int, typer.Option(min=8, max=1 << 16, help="Pixels of the error budget.")] = 192,
    seconds: Annotated[float, typer.Option(min=1, max=1e6, help="Approximate time of all methods together.")] = 120.0,
    precision: Annotated[
        Literal["float32", "bfloat16"], typer.Option(help="Number type of the network's matrix products.")
    ] = "float32",
    seed: Seed = 0,
) -> None:
    """Measure the error of every baking method against its run time.

    Writes bake.md, bake.json and bake.png: uniform Monte Carlo, Sobol, a lattice and adaptive bakes, with fitted slopes
    and efficiencies. With --scene adds path-traced bakes; with --light adds the error budget of a picture.
    """
    refuse_view_and_eye(side, eye)
    if light is None:
        refuse_given(context, ("side", "eye", "points"), "without --light")
    from prt_bake.baking.report.report import report_bake, report_files

    inputs = {"SOURCE": source, "MESH": mesh, "--scene": scene, "--light": light}
    require("report bake", *EVALUATE)
    refuse_other_kinds({"SOURCE": (source, SOURCE), "MESH": (mesh, ("mesh",)), "--scene": (scene, ("scene",))})
    check_outputs({"--out": report_files(out)}, inputs, folder=out)
    from formats.mesh import read_mesh
    from formats.scene import read_scene
    from prt_bake.baking.sources import open_source
    from prt_bake.geometry import camera
    from prt_bake.lights.environment import read_environment

    surface = read_mesh(mesh)
    transport = open_source(source, surface)
    given = None if scene is None else read_scene(scene)
    up = str(getattr(transport, "metadata", {}).get("up", "y"))
    files = report_bake(
        transport,
        surface,
        out,
        scene=given,
        sky=None if light is None else read_environment(light),
        view=None if light is None else camera.fit(surface, 512, 512, eye=eye, up=up, view=side),
        up=up,
        degree=degree,
        rings=rings,
        sectors=sectors,
        vertices=vertices,
        points=points,
        seconds=seconds,
        precision=precision,
        seed=seed,
        title=f"Baking {source.name}",
        say=say,
    )
    print(files[0].read_text(encoding="utf-8"))
    for file in files:
        print(file)
