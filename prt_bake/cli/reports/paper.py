"""`prtbake report paper`: reproduces the paper's tables."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from formats.errors import PrtbakeError
from formats.extras import EVALUATE, require
from prt_bake.cli.shared.options import Device, Seed
from prt_bake.cli.shared.outputs import check_outputs
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
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of all results, reused by later runs.")
    ] = Path("paper"),
    size: Annotated[int, typer.Option(min=16, max=4096, help="Width and height of the pictures.")] = 512,
    spp: Annotated[int, typer.Option(min=2, help="Samples per pixel of the network's pictures.")] = 256,
    reference_spp: Annotated[
        int | None,
        typer.Option(min=8, help="Paths per pixel of the references; by default 1024.", show_default=False),
    ] = None,
    reference_minutes: Annotated[
        float | None,
        typer.Option(min=0, max=1e6, help="Time of each reference, instead of --reference-spp.", show_default=False),
    ] = None,
    train_minutes: Annotated[
        float, typer.Option(min=0.01, max=1e6, help="Training time of a scene without a model in scenes/models.")
    ] = 10.0,
    scenes: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the scenes; by default the repository's.", show_default=False),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small and coarse: tests the report; its figures mean nothing.")
    ] = False,
    layers: Annotated[
        bool,
        typer.Option(
            "--layers", help="Depth ablation instead: 3 to 7 layers with and without skips (dragon by default)."
        ),
    ] = False,
    times: Annotated[
        bool,
        typer.Option(
            "--times",
            help="Training-time ablation instead: 1/8, 1/4, 1/2 and all of --train-minutes, with an extrapolation "
            "(dragon, outdoor by default).",
        ),
    ] = False,
    baselines: Annotated[
        bool,
        typer.Option(
            "--baselines",
            help="The paper's second table instead: the network beside NeuMIP and NeRFactor, each trained for "
            "--train-minutes (grape and paperweight by default).",
        ),
    ] = False,
    device: Device = "cpu",
    seed: Seed = 0,
) -> None:
    """Reproduce the paper's tables: path tracing, the network with each sampling, and SH, on the five scenes.

    Results are kept in the folder and reused while their inputs are unchanged. Ctrl-C stops after the current step, and
    the same command resumes. Prints the figures of each scene, and the tables at the end.
    """
    from prt_bake.baking.sources import require_device
    from prt_bake.lights.environment import read_environment
    from prt_bake.paper.artefacts import Stopped
    from prt_bake.paper.baselines import contenders
    from prt_bake.paper.baselines.table import standing
    from prt_bake.paper.report import FILES, PaperReport, sky_files
    from prt_bake.paper.results import TITLES, Result
    from prt_bake.paper.scenes import scenes_folder, select_scenes
    from prt_bake.paper.settings import ReportSettings
    from prt_bake.paper.tables import shown
    from prt_bake.paper.times import summary

    require("report paper", *EVALUATE)
    require_device(device)
    folder = scenes_folder(scenes)
    by_default = ["dragon"] if layers or times else list(contenders.SCENES) if baselines else []
    selected = select_scenes(scene or by_default)
    skies = sky_files(sky or (["outdoor"] if times else []), folder)
    check_outputs({"--out": [out / name for name in FILES]}, {"--sky": sky}, folder=out)
    for path in skies.values():
        read_environment(path)  # a broken file stops the report before the trainings
    settings = ReportSettings(
        size=size,
        spp=spp,
        reference_spp=reference_spp or (None if reference_minutes is not None else 1024),
        reference_minutes=reference_minutes,
        train_minutes=train_minutes,
        device=device,
        seed=seed,
    )

    def print_result(result: Result) -> None:
        flips = ", ".join(f"{TITLES[line.method]} {line.alone['flip']:.4f}" for line in result.lines)
        print(
            f"{result.scene}, {result.sky}: FLIP {flips} (noise of the reference {result.noise['flip']:.4f})",
            flush=True,
        )

    def print_comparison(comparison: contenders.Comparison) -> None:
        for sentence in filter(None, (standing(comparison, contender) for contender in contenders.CONTENDERS)):
            print(f"{comparison.scene}, {comparison.sky}: {sentence}", flush=True)

    if quick:
        say("report paper: --quick tests the report; the figures that it prints mean nothing")
    with stopping() as stop:
        report = PaperReport(out, folder, settings, quick=quick, say=say, progress=_progress_lines(), stop=stop)
        try:
            if layers:
                for name, errors in report.run_layers(selected).items():
                    print(
                        f"{name}: " + ", ".join(f"{network} {shown(error, '.3f')}" for network, error in errors.items())
                    )
            if times:
                for name, rows in report.run_times(selected, skies).items():
                    print(summary(name, rows))
            if baselines:
                report.run_baselines(selected, skies, print_comparison)
            if not (layers or times or baselines):
                report.run(selected, skies, print_result)
        except Stopped as stopped:
            raise PrtbakeError(str(stopped)) from None
        finally:
            if report.results:
                print((out / "tables.md").read_text(encoding="utf-8"))
            for file in report.files:
                print(file)


def _progress_lines() -> Callable[[str, float, str], None]:
    """Return a callback that prints progress as a line every few seconds."""
    last = time.monotonic()

    def show(what: str, share: float, text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= PLAIN_INTERVAL:
            last = time.monotonic()
            say(f"{what} {share:.0%} {text}".rstrip())

    return show
