"""`prtbake sample`: writes path-traced training samples, or a test set of pictures."""

from pathlib import Path
from typing import Annotated, Any

import typer

from formats.errors import FormatError, PrtbakeError
from prt_bake.cli.shared.ineffective import refuse_given
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next, unused
from prt_bake.cli.shared.options import Force, Seed, Size, read_size
from prt_bake.cli.shared.outputs import check_outputs, refuse_existing
from prt_bake.cli.shared.progress import reporting, stopping
from prt_bake.cli.shared.test_sets import write_olat

_SUFFIXES = (".h5", ".hdf5")
_OF_SAMPLES = ("count", "walks", "directions", "force")
_OF_OLAT = (
    "views",
    "lights",
    "test_views",
    "test_lights",
    "size",
    "spp",
    "skies",
    "subsurface",
    "light_diameter",
    "dry_run",
)


def _olat_option(text: str, low: int = 1) -> Any:
    return typer.Option(min=low, max=1 << 16, help=f"With --olat: {text}", show_default=False)


def sample(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene to path trace.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="SAMPLES.h5", help="File to write; with --olat the folder."),
    ],
    count: Annotated[int | None, typer.Option(min=1, help="Number of queries.", show_default=False)] = None,
    walks: Annotated[int, typer.Option(min=2, help="Paths per query, shared by its light directions.")] = 8,
    directions: Annotated[int, typer.Option(min=1, help="Light directions per query.")] = 8,
    olat: Annotated[
        bool,
        typer.Option(
            "--olat", help="Write a test set instead: pictures under one directional light at a time, and under skies."
        ),
    ] = False,
    views: Annotated[int | None, _olat_option("cameras of the training set; by default 16.")] = None,
    lights: Annotated[int | None, _olat_option("lights of the training set; by default 8.")] = None,
    test_views: Annotated[int | None, _olat_option("cameras of the test set; by default 8.")] = None,
    test_lights: Annotated[int | None, _olat_option("lights of the test set; by default 2.")] = None,
    size: Annotated[
        Any,
        typer.Option(
            parser=read_size, metavar="WxH", help="With --olat: pixels; by default 256x256.", show_default=False
        ),
    ] = None,
    spp: Annotated[int | None, _olat_option("paths per pixel; by default 64.", 2)] = None,
    skies: Annotated[
        list[Path] | None,
        typer.Option(
            "--sky",
            metavar="SKY",
            help="With --olat: a held-out sky, by default the shipped one. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    subsurface: Annotated[
        bool,
        typer.Option(
            "--subsurface",
            help="With --olat: only scattered light from under the surface, as in networks and assets; without it also "
            "unscattered and reflected light.",
        ),
    ] = False,
    light_diameter: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=180,
            metavar="DEG",
            help="With --olat: angular diameter of the lights; by default 0. Smooth interfaces need more.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="With --olat: print size and time, and write nothing.")
    ] = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Path trace training queries and write them with their noise.

    `prtbake train SCENE.toml --samples SAMPLES.h5` learns from them. Ctrl-C keeps the queries finished so far. Each
    --seed draws different queries.

    With --olat, writes a test set for relightable objects into a folder, in the layout that relightable Gaussians read.
    It first prints size and time. Ctrl-C keeps the finished pictures, and the same command continues. `prtbake compare
    PREDICTED FOLDER` scores predicted pictures.
    """
    if olat:
        refuse_given(context, _OF_SAMPLES, "with --olat")
        refuse_other_kinds({"SCENE": (scene, ("scene",)), "--sky": (skies, ("sky",))})
        from prt_bake.olat.settings import OlatSettings

        chosen: dict[str, Any] = {
            "views": views,
            "lights": lights,
            "test_views": test_views,
            "test_lights": test_lights,
        }
        chosen |= {"spp": spp, "light_diameter": light_diameter}
        if isinstance(size, Size):
            chosen |= {"width": size.width, "height": size.height}
        numbers = {name: value for name, value in chosen.items() if value is not None}
        settings = OlatSettings(seed=seed, subsurface=subsurface, **numbers)
        return write_olat(scene, output, settings, skies or [], dry_run)
    refuse_given(context, _OF_OLAT, "without --olat")
    if count is None:
        raise typer.BadParameter("Missing option '--count'; only --olat works without it.")
    if output.suffix.lower() not in _SUFFIXES:
        raise FormatError(f"{output}: expected a name that ends in .h5 or .hdf5, found {output.suffix!r}")
    check_outputs({"--output": output}, {"SCENE": scene})
    refuse_existing([output], force)
    refuse_other_kinds({"SCENE": (scene, ("scene",))})
    from formats.scene import read_scene
    from prt_bake.trainer.samples.record import record_samples

    with reporting("sample") as show, stopping() as stop:
        done = record_samples(
            read_scene(scene),
            output,
            count,
            walks=walks,
            directions=directions,
            seed=seed,
            progress=lambda done, total: show(done / total, f"{done:,} of {total:,} queries"),
            stop=stop,
        )
    print(f"{output}: {done:,} queries of {directions} directions, {done * walks:,} paths")
    if done < count:
        raise PrtbakeError(f"{output}: the sampling was stopped; the file holds {done:,} of {count:,} queries")
    say_next("prtbake", "train", scene, "--samples", output, "-o", unused(output.with_name(f"{scene.stem}.pt")))
