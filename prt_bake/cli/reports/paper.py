"""`prtbake report paper`: the paper's tables anew."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.options import Device, Seed
from prt_bake.cli.shared.progress import PLAIN_INTERVAL, say, stopping


def paper(
    scene: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="grape, dragon, paperweight, drink or lucy; all by default.", show_default=False
        ),
    ] = None,
    sky: Annotated[
        list[str] | None,
        typer.Option(metavar="SKY", help="outdoor, indoor, or a file; both by default.", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for what is made, kept between runs.")] = Path(
        "paper"
    ),
    size: Annotated[int, typer.Option(min=16, max=4096, help="Width and height of the pictures.")] = 512,
    spp: Annotated[int, typer.Option(min=2, help="Samples a pixel of the network's pictures.")] = 256,
    reference_spp: Annotated[
        int | None,
        typer.Option(min=8, help="Walks a pixel of the references; 1024 where no time is given.", show_default=False),
    ] = None,
    reference_minutes: Annotated[
        float | None, typer.Option(min=0, max=1e6, help="Time for each reference.", show_default=False)
    ] = None,
    train_minutes: Annotated[
        float, typer.Option(min=0.01, max=1e6, help="Time to train a scene whose model is not in scenes/models.")
    ] = 10.0,
    scenes: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="The repository's folder of scenes, where it is elsewhere.", show_default=False
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small and coarse: the form of the tables, not their figures.")
    ] = False,
    layers: Annotated[
        bool, typer.Option("--layers", help="Train 3 to 7 layers with and without skips instead (dragon by default).")
    ] = False,
    times: Annotated[
        bool,
        typer.Option(
            "--times",
            help="Train for 1/8, 1/4, 1/2 and all of --train-minutes instead, to see where longer leads "
            "(dragon by default, outdoor).",
        ),
    ] = False,
    device: Device = "cpu",
    seed: Seed = 0,
) -> None:
    """Make the paper's tables anew: path tracing, the network with each sampling, and harmonics, on the five scenes.

    Every step is kept in the folder and never repeated while its inputs stay; Ctrl-C stops after what is under way, and
    the same command goes on. Prints the tables, and after each scene what is known so far.
    """
    from prt_bake.baking.sources import require_device
    from prt_bake.paper.artefacts import Stopped
    from prt_bake.paper.report import PaperReport, sky_files
    from prt_bake.paper.results import TITLES, Result
    from prt_bake.paper.scenes import chosen
    from prt_bake.paper.settings import ReportSettings
    from prt_bake.paper.times import told

    require_device(device)
    folder = scenes or Path(__file__).parents[2] / "scenes"
    asked = chosen(scene or (["dragon"] if layers or times else []))
    settings = ReportSettings(
        size=size,
        spp=spp,
        reference_spp=reference_spp or (None if reference_minutes is not None else 1024),
        reference_minutes=reference_minutes,
        train_minutes=train_minutes,
        device=device,
        seed=seed,
    )

    def tell(result: Result) -> None:
        flips = ", ".join(f"{TITLES[line.method]} {line.alone['flip']:.4f}" for line in result.lines)
        print(
            f"{result.scene}, {result.sky}: FLIP {flips} (the reference's noise {result.noise['flip']:.4f})", flush=True
        )

    with stopping() as stop:
        work = PaperReport(out, folder, settings, quick=quick, say=say, progress=_lines(), stop=stop)
        try:
            if layers:
                for name, errors in work.run_layers(asked).items():
                    print(f"{name}: " + ", ".join(f"{network} {error:.3f}" for network, error in errors.items()))
            if times:
                skies = sky_files(sky or ["outdoor"], folder)
                for name, rows in work.run_times(asked, skies).items():
                    print(told(name, rows))
            if not (layers or times):
                work.run(asked, sky_files(sky or [], folder), tell)
        except Stopped as ending:
            raise PrtbakeError(str(ending)) from None
        finally:
            if work.results:
                print((out / "tables.md").read_text(encoding="utf-8"))
            for file in work.files:
                print(file)


def _lines() -> Callable[[str, float, str], None]:
    """Progress of a long list of steps as a line now and then."""
    last = time.monotonic()

    def show(what: str, share: float, words: str) -> None:
        nonlocal last
        if time.monotonic() - last >= PLAIN_INTERVAL:
            last = time.monotonic()
            say(f"{what} {share:.0%} {words}".rstrip())

    return show
