"""`prtbake demo`: the main job on the shipped scene, model and sky."""

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.progress import bake_progress, reporting, stopping


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for what is made.")] = Path("demo"),
    quality: Annotated[
        Literal["quick", "fine"], typer.Option(help="quick: a minute; fine: smaller errors, larger picture.")
    ] = "quick",
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Threads; by default as many as cores.", show_default=False)
    ] = None,
) -> None:
    """Bake and relight the shipped object, and measure it."""
    from prt_bake.shipped.demonstration import FINE, QUICK, demonstrate

    settings = {"quick": QUICK, "fine": FINE}[quality]
    with reporting("bake") as show, stopping() as stop:
        result = demonstrate(
            out,
            settings,
            workers or os.cpu_count() or 1,
            progress=bake_progress(show),
            stop=stop,
        )
        if result.asset.complete:
            show(1.0, "")
    for file in result.files:
        print(file)
    print("error against run time: seconds, evaluations, estimated relative RMSE of the coefficients")
    for rows, words in ((result.ladder, "as many directions at every bin"), (result.asset.error_vs_time, "this bake")):
        for seconds, evaluations, error in rows:
            print(f"  {seconds:8.1f} {evaluations:15,.0f} {error:9.3%}   {words}")
    for name, figures in (("picture", result.comparison), ("object", result.object_comparison)):
        print(
            f"{name}: MSE {figures.mse:.3g}, SSIM {figures.ssim:.4f}, FLIP {figures.flip:.4f} against the path tracer"
        )
    print(f"the reference's own noise: MSE {result.noise_mse:.3g} on the object")
    if not result.asset.complete:
        raise PrtbakeError(f"{out}: the bake was stopped; the pictures show what is baked")
