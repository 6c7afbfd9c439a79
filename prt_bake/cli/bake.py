"""`prtbake bake`: from a model or a scene, and a mesh, to an asset."""

import json
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.options import Device, OnlyEye, ReportFile, Seed, output_option, within
from prt_bake.cli.shared.plan import plan_lines
from prt_bake.cli.shared.progress import bake_progress, reporting, say, stopping


def bake(
    context: typer.Context,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="model.pt (neural) or scene.toml (path traced).")],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="Its vertices are baked.")],
    output: Annotated[Path | None, output_option("ASSET.h5", ".h5", ".hdf5")] = None,
    rings: Annotated[int, typer.Option(min=1, max=1024, help="View bins over the cosine to the normal.")] = 16,
    sectors: Annotated[int, typer.Option(min=1, max=1024, help="View bins around the normal.")] = 64,
    degree: Annotated[int, typer.Option(min=0, max=20, help="Highest degree of the harmonics.")] = 2,
    directions: Annotated[
        Literal["fibonacci", "sobol", "uniform"], typer.Option(help="How incident directions are placed.")
    ] = "fibonacci",
    samples: Annotated[int, typer.Option(min=1, help="Directions a view bin; walks, for a scene.")] = 64,
    error: Annotated[
        float | None,
        typer.Option(
            callback=within(0.0, 1.0),
            help="Relative RMSE to reach, of the object and of most vertices.",
            show_default=False,
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            callback=within(0.0, math.inf),
            help="Make it finer for that long, coarse to fine, if --error is not reached before; inf: until Ctrl-C.",
            show_default=False,
        ),
    ] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    precision: Annotated[
        Literal["float32", "bfloat16"], typer.Option(help="Of the network's matrix work.")
    ] = "float32",
    storage: Annotated[
        Literal["float16", "float32"], typer.Option(help="Of the coefficients in the file.")
    ] = "float16",
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Threads; 1, or every core for the walks of a scene.", show_default=False),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Of a dask.distributed scheduler, such as tcp://host:8786, whose workers bake.",
            show_default=False,
        ),
    ] = None,
    convention: Annotated[
        str | None,
        typer.Option(help="How the 7 inputs of a TorchScript SOURCE are meant.", show_default=False),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Print size, time and what would be left out and why, and stop; JSON where it is piped.",
        ),
    ] = False,
    keep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ITEM",
            help="unseen, duplicates, views, bands, channels or all: not left out even where the scene does not need "
            "it; can be given again.",
            show_default=False,
        ),
    ] = None,
    for_light: Annotated[
        Path | None,
        typer.Option(
            metavar="SKY", help="The only light that the asset is for; it holds radiance then.", show_default=False
        ),
    ] = None,
    for_eye: OnlyEye = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Go on with the same bake, stopped or killed, from the blocks kept beside the asset."
        ),
    ] = False,
    report: ReportFile = None,
) -> None:
    """Bake a model or a scene on a mesh into an asset.

    At every vertex and view bin the transport is projected on spherical harmonics. Ctrl-C stops the bake and keeps what
    is done as a valid asset that says so.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("Missing option '--output' / '-o'; --dry-run alone does without.")
    from bakers.transport import transport_property
    from formats.journal import journal_folder
    from formats.json_report import write_report
    from formats.mesh import read_mesh
    from prt_bake.baking import bake as baking
    from prt_bake.baking.report.summary import bake_report
    from prt_bake.baking.sources import open_source, origin

    surface = read_mesh(mesh)
    transport = open_source(source, surface, device, convention)
    if workers is None:
        walks = source.suffix.lower() == ".toml" and scheduler is None
        workers = (os.cpu_count() or 1) if walks else 1
    sampling = (degree, rings, sectors, directions, samples)
    needed: Any = {
        "leave_out": _but(keep or [], baking.ITEMS),
        "for_light": None if for_light is None else _light(for_light, degree, transport_property(transport, "up", "y")),
        "for_eye": for_eye,
    }
    if dry_run:
        plan = baking.plan(
            transport,
            surface,
            *sampling,
            seed,
            error=error,
            precision=precision,
            storage=storage,
            workers=workers,
            device=device,
            **needed,
        )
        print("\n".join(plan_lines(plan)) if sys.stdout.isatty() else json.dumps(plan.as_json(), indent=2))
        return
    assert output is not None
    if resume and not (journal := journal_folder(output)).is_dir():
        say(f"{journal}: there is nothing to go on from; the bake begins at its beginning")
    with reporting("bake", "looking at a few vertices first") as show, stopping() as stop:
        asset = baking.bake(
            transport,
            surface,
            *sampling,
            error,
            seed,
            minutes=minutes,
            out=output,
            precision=precision,
            storage=storage,
            workers=workers,
            scheduler=scheduler,
            device=device,
            progress=bake_progress(show),
            stop=stop,
            resume=resume,
            **needed,
            provenance={"command": context.obj, "mesh": mesh.name, **origin(source)},
        )
        if asset.complete and not stop():
            show(1.0, "")
    summary = bake_report(asset)
    if report is not None:
        write_report(summary, report)
    written = Path(asset.coefficients.file.filename)
    rmse = summary["estimated_relative_rmse"]
    print(
        f"{written}: {summary['vertices_baked']} of {summary['vertices']} vertices in {summary['seconds']:.1f} s, "
        f"estimated relative RMSE of the {'walks' if 'walks' in summary else 'projection'} {rmse['total']:.2%}, "
        f"95th percentile over vertices {rmse['percentile_95_over_vertices']:.2%}"
    )
    if "model_error" in summary:
        print(f"the model's own error is not in these figures: {summary['model_error']:.2%} of the coefficients")
    for remark in _remarks(summary):
        print(remark)
    if not asset.complete:
        raise PrtbakeError(
            f"{written}: the bake was stopped; what is baked is a valid asset that says so; "
            f"the same command with --resume goes on from {journal_folder(output).name} beside it"
        )
    if stop() and journal_folder(output).is_dir():
        raise PrtbakeError(
            f"{written}: the bake was stopped before it came to the error asked for; this asset is whole, but coarser; "
            f"the same command with --resume goes on from {journal_folder(output).name} beside it"
        )


def _but(kept: list[str], items: tuple[str, ...]) -> list[str]:
    """What may be left out where `kept` may not be."""
    if unknown := sorted(set(kept) - {*items, "all"}):
        raise typer.BadParameter(f"--keep: {', '.join(unknown)} is none of {', '.join(items)}, all")
    return [] if "all" in kept else [item for item in items if item not in kept]


def _light(sky: Path, degree: int, up: str) -> Any:
    from formats.atomic import sha256
    from prt_bake.baking.bake import Light
    from prt_bake.lights import environment

    return Light(environment.project(environment.open_environment(sky, say=say), degree, up), sky.name, sha256(sky))


def _remarks(summary: dict[str, Any]) -> Iterator[str]:
    """An error that was not reached; what is in no coefficient, and where the error figure cannot be trusted."""
    if summary.get("error_reached") is False:
        yield f"the error asked for, {summary['settings']['error']:.2%}, was not reached"
    rmse = summary["estimated_relative_rmse"]
    for name, words in (("rounding", f"rounding to {summary['settings']['precision']}"), ("left_out", "leaving out")):
        if name in rmse:
            yield f"{words} makes up {rmse[name]:.2%} of that error"
    for item in summary["left_out"]:
        yield f"left out: {item['item']} ({item['reason']}); {item['saving']}"
    walks = summary.get("walks", {"unscattered": 0.0, "lost": 0.0, "unreliable_bins": 0})
    if walks["unscattered"] >= 0.001:
        yield f"{walks['unscattered']:.1%} of the view goes straight through the object, and is in no coefficient"
    if walks["lost"] > 0:
        yield f"{walks['lost']:.2g} of the light was lost in walks that were cut"
    if walks["unreliable_bins"]:
        bins = summary["vertices_baked"] * summary["settings"]["rings"] * summary["settings"]["sectors"]
        share = walks["unreliable_bins"] / bins
        yield f"{share:.1%} of the bins have too few walks for their error figure to be trusted; give more --samples"
