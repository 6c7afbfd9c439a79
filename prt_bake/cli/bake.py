"""`prtbake bake`: bakes a model or a scene into an asset."""

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.ineffective import refuse_given
from prt_bake.cli.shared.kinds import SOURCE, refuse_other_kinds
from prt_bake.cli.shared.mesh_name import naming_mesh
from prt_bake.cli.shared.next_step import say_next_of_asset
from prt_bake.cli.shared.options import Force, OnlyEye, ReportFile, Seed, output_option, within
from prt_bake.cli.shared.outputs import check_outputs, refuse_existing, warn_of_small_disk
from prt_bake.cli.shared.plan import lobes_sentence, plan_lines
from prt_bake.cli.shared.progress import Stop, bake_progress, reporting, say, stopping

if TYPE_CHECKING:
    from formats.asset import Asset
    from prt_bake.baking.bake import Progress

OTHER_EFFORTS = "; --error, --minutes or --samples choose another"
_BYTES_OF_A_COEFFICIENT = 8
"""On the disk while a bake is written: 6 in the checkpoint, 2 in the asset."""


@naming_mesh
def bake(
    context: typer.Context,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="model.pt (neural), scene.toml (path traced), or a function (.onnx, TorchScript)."
        ),
    ],
    mesh: Annotated[
        Path | None,
        typer.Argument(metavar="MESH", help="Mesh whose vertices are baked; by default that of the source's scene."),
    ] = None,
    output: Annotated[Path | None, output_option("ASSET.h5", ".h5", ".hdf5")] = None,
    rings: Annotated[int, typer.Option(min=1, max=1024, help="View bins along the cosine to the normal.")] = 16,
    sectors: Annotated[int, typer.Option(min=1, max=1024, help="View bins around the normal.")] = 64,
    degree: Annotated[int, typer.Option(min=0, max=20, help="Highest SH degree l.")] = 2,
    directions: Annotated[
        Literal["fibonacci", "sobol", "uniform"], typer.Option(help="Point set of the light directions.")
    ] = "fibonacci",
    samples: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Fixed number of light directions per view bin; for a scene, of paths (64 by default).",
            show_default=False,
        ),
    ] = None,
    error: Annotated[
        float | None,
        typer.Option(
            callback=within(0.0, 1.0),
            help="Relative RMSE to reach, of the object and of 95 % of its vertices; 0.02 by default for a model.",
            show_default=False,
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            callback=within(0.0, math.inf),
            help="Time budget: refines from coarse to fine until then or until --error is reached; inf: until Ctrl-C.",
            show_default=False,
        ),
    ] = None,
    seed: Seed = 0,
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option(help="Device that runs the network, or path traces the scene.")
    ] = "cpu",
    precision: Annotated[
        Literal["float32", "bfloat16"], typer.Option(help="Number type of the network's matrix products.")
    ] = "float32",
    storage: Annotated[
        Literal["float16", "float32"], typer.Option(help="Number type of the coefficients in the file.")
    ] = "float16",
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Threads; by default 1, or every core for a scene.", show_default=False),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="dask.distributed scheduler whose workers bake, such as tcp://host:8786.",
            show_default=False,
        ),
    ] = None,
    convention: Annotated[
        str | None,
        typer.Option(
            help="The 7 inputs of an ONNX or TorchScript SOURCE, such as 'incident, position, outgoing; angles=unit'.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print size, time and pruning of the bake without baking; JSON when piped."),
    ] = False,
    keep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ITEM",
            help="Do not prune: unseen, duplicates, views, bands, channels or all. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    for_light: Annotated[
        Path | None,
        typer.Option(metavar="SKY", help="Bake radiance under this sky alone; cannot be relit.", show_default=False),
    ] = None,
    for_eye: OnlyEye = None,
    lobes: Annotated[
        int, typer.Option(min=0, max=4, help="Most lobes in a view, for narrow light; as many as gain something.")
    ] = 4,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Resume the same bake, stopped or killed, from the checkpoint beside the asset."),
    ] = False,
    force: Force = False,
    report: ReportFile = None,
) -> None:
    """Bake a model or a scene on a mesh into an asset.

    Projects the transport at every vertex and view bin on spherical harmonics. Ctrl-C stops the bake; the vertices
    finished so far are written as a valid partial asset.
    """
    if source.suffix.lower() == ".toml":
        refuse_given(
            context, ("directions", "convention", *(("lobes",) if lobes else ())), "on a scene, which is path traced"
        )
    if output is None and not dry_run:
        raise typer.BadParameter("Missing option '--output' / '-o'; only --dry-run works without it.")
    refuse_other_kinds({"SOURCE": (source, SOURCE), "MESH": (mesh, ("mesh",)), "--for-light": (for_light, ("sky",))})
    from bakers.transport import transport_property
    from formats.journal import journal_folder
    from formats.json_report import as_text, write_report
    from formats.mesh import read_mesh
    from prt_bake.baking import bake as baking
    from prt_bake.baking.report.summary import bake_report
    from prt_bake.baking.sources import open_source, origin, own_mesh

    if mesh is None:
        mesh = own_mesh(source, convention)
        say(f"bakes on the mesh {mesh}")
    inputs = {"SOURCE": source, "MESH": mesh, "--for-light": for_light}
    check_outputs({"--output": output, "--report": report}, inputs)
    if output is not None and not dry_run:
        _refuse_existing(output, force, resume)
    surface = read_mesh(mesh)
    transport = open_source(source, surface, device, convention)
    if workers is None:
        walks_here = source.suffix.lower() == ".toml" and scheduler is None and device == "cpu"
        workers = (os.cpu_count() or 1) if walks_here else 1
    sampling = (degree, rings, sectors, directions, samples)
    effort = baking.choose_effort(transport, degree, directions, samples, error, minutes)
    shared: Any = {
        "precision": precision,
        "storage": storage,
        "workers": workers,
        "device": device,
        "leave_out": _prunable_except(keep or [], baking.ITEMS),
        "for_light": None if for_light is None else _light(for_light, degree, transport_property(transport, "up", "y")),
        "for_eye": for_eye,
        "lobes": lobes,
    }
    if dry_run:
        say("predicts the bake from pilots and some of its blocks, which takes minutes on a large mesh")
        with reporting("plan", "pilot on a few vertices"):
            plan = baking.plan(transport, surface, *sampling, seed, error=error, minutes=minutes, **shared)
        print("\n".join(plan_lines(plan)) if sys.stdout.isatty() else as_text(plan.as_json()))
        return
    assert output is not None
    bins, terms = 1 if for_eye else rings * sectors, 1 if for_light else (degree + 1) ** 2
    warn_of_small_disk(output, len(surface.positions) * bins * terms * 3 * _BYTES_OF_A_COEFFICIENT)
    if resume and not (journal := journal_folder(output)).is_dir():
        say(f"{journal}: there is no checkpoint to resume from; the bake starts from the beginning")
    with reporting("bake", "pilot on a few vertices") as show, stopping() as stop:
        stop.at_once = True  # plan and pilot leave nothing to keep
        asset = baking.bake(
            transport,
            surface,
            *sampling,
            error,
            seed,
            minutes=minutes,
            out=output,
            scheduler=scheduler,
            progress=_saying(effort.sentence, stop, bake_progress(show, effort.error)),
            stop=stop,
            resume=resume,
            **shared,
            provenance={"command": context.obj, "mesh": mesh.name, **origin(source)},
        )
        if asset.complete and not stop():
            show(1.0, "")
    summary = bake_report(asset)
    if report is not None:
        write_report(summary, report)
    written = Path(asset.coefficients.file.filename)
    _print_outcome(asset, written, summary)
    _refuse_unfinished(asset, written, journal_folder(output), stop())
    eye = () if for_eye is None else ("--eye", ",".join(map(str, for_eye)))
    say_next_of_asset(written, *eye, lights=() if for_light is None else (for_light,))


def _refuse_existing(output: Path, force: bool, resume: bool) -> None:
    """Refuse to replace an asset, or the finished blocks of a bake that was stopped or killed."""
    from formats.journal import journal_folder

    journal = journal_folder(output)
    unfinished = any(journal.glob("*.npz"))
    refuse_existing([output, *([journal] if unfinished else [])], force, resume if unfinished else None)


def _saying(effort: str, stop: Stop, progress: "Progress") -> "Progress":
    """The progress callback, which first says what the bake does, once its arguments and files are in order.

    From the first finished vertex on `stop` lets the current block end.
    """
    said = False

    def report(done: int, total: int, status: Any) -> None:
        nonlocal said
        if not said:
            said = True
            say(f"bakes {effort}" + OTHER_EFFORTS * effort.endswith("the default"))
        stop.at_once = stop.at_once and done == 0
        progress(done, total, status)

    return report


def _prunable_except(kept: list[str], items: tuple[str, ...]) -> list[str]:
    if unknown := sorted(set(kept) - {*items, "all"}):
        raise typer.BadParameter(f"--keep: expected {', '.join(items)} or all, found {', '.join(unknown)}")
    return [] if "all" in kept else [item for item in items if item not in kept]


def _light(sky: Path, degree: int, up: str) -> Any:
    from formats.atomic import sha256
    from prt_bake.baking.bake import Light
    from prt_bake.lights import environment

    return Light(environment.project(environment.open_environment(sky, say=say), degree, up), sky.name, sha256(sky))


def _print_outcome(asset: "Asset", written: Path, summary: dict[str, Any]) -> None:
    rmse = summary["estimated_relative_rmse"]
    figures = "unknown"
    if rmse["total"] is not None:
        figures = f"{rmse['total']:.2%}, 95th percentile over vertices {rmse['percentile_95_over_vertices']:.2%}"
    print(
        f"{written}: {summary['vertices_baked']} of {summary['vertices']} vertices in {summary['seconds']:.1f} s, "
        f"estimated relative RMSE of the {'path tracing' if 'walks' in summary else 'projection'} {figures}"
    )
    if "walks" not in summary:
        print(f"error of the coefficients {asset.error}")
    for remark in _remarks(summary):
        print(remark)


def _refuse_unfinished(asset: "Asset", written: Path, journal: Path, stopped: bool) -> None:
    """Raise PrtbakeError for a bake that ended before it was finished, and say how to continue it."""
    if not asset.complete:
        ended = "the bake was stopped" if stopped else "its time ended before every vertex was baked"
        raise PrtbakeError(
            f"{written}: {ended}; the file is a valid partial asset; "
            f"the same command with --resume continues from {journal.name} beside it"
        )
    if stopped and journal.is_dir():
        raise PrtbakeError(
            f"{written}: the bake was stopped before it was finished; the asset is complete, but coarser or without "
            f"lobes; the same command with --resume continues from {journal.name} beside it"
        )


def _remarks(summary: dict[str, Any]) -> Iterator[str]:
    """Yield sentences on the requested error, on pruning, and on the limits of a path-traced bake."""
    if summary.get("error_reached") is False:
        yield f"the requested error of {summary['settings']['error']:.2%} was not reached"
    rmse = summary["estimated_relative_rmse"]
    for name, source in (("rounding", f"rounding to {summary['settings']['precision']}"), ("left_out", "pruning")):
        if name in rmse:
            yield f"{source} contributes {rmse[name]:.2%} to this error"
    if "walks" not in summary:
        yield lobes_sentence(summary["lobes"])
    for item in summary["left_out"]:
        yield f"pruned: {item['item']} ({item['reason']}); {item['saving']}"
    if "walks" not in summary:
        return
    walks = summary["walks"]
    if walks["unscattered"] >= 0.001:
        yield f"unscattered transmission, {walks['unscattered']:.1%} of the view on average, is not in the coefficients"
    if walks["lost"] > 0:
        yield f"{walks['lost']:.2g} of the light was lost in truncated paths"
    if walks["unreliable_bins"]:
        bins = summary["vertices_baked"] * summary["settings"]["rings"] * summary["settings"]["sectors"]
        if rmse["total"] is None:
            yield "no path carried light: the object is black, or its error is unknown"
        share = walks["unreliable_bins"] / bins
        yield f"{share:.1%} of the bins have too few paths for a reliable error estimate; increase --samples"
