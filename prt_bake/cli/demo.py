"""`prtbake demo`: bakes and relights the shipped object."""

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from formats.errors import PrtbakeError
from formats.extras import EVALUATE, require
from prt_bake.cli.shared.next_step import say_next_of_asset
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import bake_progress, reporting, stopping


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to write to.")] = Path("demo"),
    quality: Annotated[
        Literal["quick", "fine"], typer.Option(help="quick: about 2 minutes; fine: smaller errors, larger picture.")
    ] = "quick",
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Threads; by default one per core.", show_default=False)
    ] = None,
) -> None:
    """Bake and relight the shipped object, and measure the error.

    The error is that of the picture, compared with a path-traced reference.
    """
    require("demo", *EVALUATE)
    from prt_bake.shipped import demonstration as shipped

    inputs = (shipped.MODEL, shipped.MESH, shipped.SKY, shipped.REFERENCE, shipped.REFERENCE_REPORT)
    check_outputs({"--out": [out / name for name in shipped.FILES]}, {"the shipped object": inputs}, folder=out)
    settings = {"quick": shipped.QUICK, "fine": shipped.FINE}[quality]
    with reporting("bake") as show, stopping() as stop:
        cores = workers or os.cpu_count() or 1
        result = shipped.demonstrate(out, settings, cores, progress=bake_progress(show), stop=stop)
        if result.asset.complete:
            show(1.0, "")
    for file in result.files:
        print(file)
    print("error against run time: seconds, evaluations, estimated relative RMSE of the coefficients")
    for rows, name in ((result.ladder, "uniform sampling"), (result.asset.error_vs_time, "this bake")):
        for seconds, evaluations, error in rows:
            print(f"  {seconds:8.1f} {evaluations:15,.0f} {error:9.3%}   {name}")
    print(f"error of the coefficients {result.asset.error}")
    for name, figures in (("picture", result.comparison), ("object", result.object_comparison)):
        print(
            f"{name}: MSE {figures.mse:.3g}, SSIM {figures.ssim:.4f}, FLIP {figures.flip:.4f} against the path tracer"
        )
    print(f"noise of the reference: MSE {result.noise_mse:.3g} on the object")
    if not result.asset.complete:
        raise PrtbakeError(f"{out}: the bake was stopped; vertices not yet baked are black in the pictures")
    say_next_of_asset(out / "spot.h5", "--view", "three-quarter-back")  # where its pictures stand
