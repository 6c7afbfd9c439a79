"""`prtbake report training`: how good a trained model is."""

from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.shared.options import Seed
from prt_bake.cli.shared.progress import say


def training(
    model: Annotated[Path, typer.Argument(metavar="MODEL.pt", help="Model that `prtbake train` wrote.")],
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene that it was trained on.")],
    seconds: Annotated[
        float,
        typer.Option(
            min=0,
            max=1e6,
            help="Time for path tracing queries, and half as long again for a picture; more makes intervals narrower.",
        ),
    ] = 40.0,
    queries: Annotated[int, typer.Option(min=16, max=1 << 20, help="Fresh queries.")] = 1024,
    vertices: Annotated[int, typer.Option(min=16, max=1 << 20, help="Vertices that are asked from 8 sides.")] = 192,
    seed: Seed = 0,
) -> None:
    """Path trace fresh queries and hold a model against them.

    Writes MODEL.report.json and MODEL.report.html beside the model: its error against time, angle and position, the
    reference's own noise taken out, and how well each figure is known.
    """
    from formats.scene import read_scene
    from prt_bake.network.bssrdf import load_model
    from prt_bake.trainer.report.report import report_training
    from prt_bake.trainer.report.summary import criterion_line

    network, given = load_model(model), read_scene(scene)
    say("path tracing fresh queries")
    found, page_path = report_training(
        network, given, model, seconds=seconds, queries=queries, vertices=vertices, seed=seed
    )
    for row in found["criteria"]:
        print(criterion_line(row))
    print(f"{page_path}: {found['summary'][0]}")
