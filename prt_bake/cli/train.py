"""`prtbake train`: from a scene to a model."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.options import Device, Seed, output_option
from prt_bake.cli.progress import reporting, say, stopping

if TYPE_CHECKING:
    from prt_bake.trainer.fit import TrainingRow


def train(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene to learn.")],
    output: Annotated[Path, output_option("MODEL.pt", ".pt", ".safetensors")],
    minutes: Annotated[float, typer.Option(min=0, max=1e6, help="Time to train.")] = 10.0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Optimiser steps in all, in place of minutes.", show_default=False)
    ] = None,
    preset: Annotated[
        Literal["measured", "paper"],
        typer.Option(help="The network: as measured best, or as the paper has it."),
    ] = "measured",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from MODEL.train.pt beside the output.")] = False,
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Path trace a scene and fit a network to it.

    Renderer and learner work side by side until the time is used up. Ctrl-C ends the training early and keeps what was
    learnt; --resume goes on from there.
    """
    from formats.scene import read_scene
    from prt_bake.network_settings import PRESETS
    from prt_bake.sources import require_device
    from prt_bake.trainer.fit import train as fit

    require_device(device)

    with reporting("train") as show, stopping() as stop:

        def follow(row: "TrainingRow") -> None:
            show(
                row.share,
                f"step {row.step}, loss {row.loss:.4g}, validation error {row.validation:.2%}, "
                f"{row.queries_per_second:,.0f} queries/s, {row.walks_per_second:,.0f} walks/s",
            )
            if stop():
                raise KeyboardInterrupt

        network = fit(
            read_scene(scene),
            minutes=minutes,
            steps=steps,
            seed=seed,
            settings=PRESETS[preset],
            device=device,
            output=output,
            resume=resume,
            progress=follow,
            say=say,
        )
        stopped = stop()
    training = network.metadata["training"]
    rmse = training["relative_rmse"]
    print(
        f"{output}: {training['steps']} steps, {training['walks']:,} walks in {training['seconds']:.0f} s; "
        f"relative RMSE on fresh queries {rmse['transport']:.2%}, of coefficients {rmse['coefficients']:.2%} "
        f"(the reference's noise, {rmse['transport_noise']:.2%} and {rmse['coefficients_noise']:.2%}, taken out)"
    )
    if stopped:
        raise PrtbakeError(f"{output}: the training was stopped; the model holds what was learnt, --resume goes on")
