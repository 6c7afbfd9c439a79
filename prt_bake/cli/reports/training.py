"""`prtbake report training`: measures a model against the path tracer."""

from pathlib import Path
from typing import Annotated

import typer

from formats.atomic import existing
from formats.extras import EVALUATE, require
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.options import Seed
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import reporting
from prt_bake.network.file_names import report_paths


def training(
    model: Annotated[Path, typer.Argument(metavar="MODEL.pt", help="Model that `prtbake train` wrote.")],
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene that the model was trained on.")],
    seconds: Annotated[
        float,
        typer.Option(
            min=0,
            max=1e6,
            help="Path tracing time for the queries; a picture takes half as much again. More time narrows intervals.",
        ),
    ] = 40.0,
    queries: Annotated[int, typer.Option(min=16, max=1 << 20, help="Number of fresh queries.")] = 1024,
    vertices: Annotated[int, typer.Option(min=16, max=1 << 20, help="Vertices queried from 8 views.")] = 192,
    seed: Seed = 0,
) -> None:
    """Validate a model against path-traced queries.

    Writes MODEL.report.json and MODEL.report.html beside the model: its error over time, angle and position, without
    the reference's noise, with a confidence interval of each figure.
    """
    check_outputs({"the report": report_paths(existing(model))}, {"MODEL": model, "SCENE": scene})
    require("report training", *EVALUATE)
    refuse_other_kinds({"MODEL": (model, ("model",)), "SCENE": (scene, ("scene",))})
    from formats.scene import read_scene
    from prt_bake.network.bssrdf import load_model
    from prt_bake.trainer.report.report import report_training
    from prt_bake.trainer.report.summary import criterion_line

    network, given = load_model(model), read_scene(scene)
    with reporting("report") as show:
        measured, page = report_training(
            network,
            given,
            model,
            seconds=seconds,
            queries=queries,
            vertices=vertices,
            seed=seed,
            follow=lambda share: show(share, "comparing with the path tracer"),
        )
    for row in measured["criteria"]:
        print(criterion_line(row))
    print(f"{page}: {measured['summary'][0]}")
