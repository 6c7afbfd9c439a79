"""`prtbake train`: from a scene to a model."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.options import Seed, output_option
from prt_bake.cli.shared.progress import reporting, say, stopping

if TYPE_CHECKING:
    from prt_bake.trainer.train import TrainingProgress


def train(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene to learn.")],
    output: Annotated[Path, output_option("MODEL.pt", ".pt", ".safetensors")],
    minutes: Annotated[
        float, typer.Option(min=1e-3, max=1e6, help="Time to train, earlier runs that are resumed included.")
    ] = 10.0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Optimiser steps in all, in place of minutes.", show_default=False)
    ] = None,
    preset: Annotated[
        Literal["measured", "paper"],
        typer.Option(help="The network: as measured best, or as the paper has it."),
    ] = "measured",
    samples: Annotated[
        Path | None,
        typer.Option(
            metavar="SAMPLES.h5",
            help="Learn from what `prtbake sample` wrote, not from walks.",
            show_default=False,
        ),
    ] = None,
    synchronous: Annotated[
        bool,
        typer.Option("--synchronous", help="Renderer and learner take turns: with --steps, the same bits every time."),
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from MODEL.train.pt beside the output.")] = False,
    with_report: Annotated[
        bool, typer.Option("--report/--no-report", help="Measure the model afterwards: MODEL.report.json and .html.")
    ] = True,
    with_importance: Annotated[
        bool, typer.Option("--importance/--no-importance", help="Fit its importance module afterwards.")
    ] = True,
    seed: Seed = 0,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="Where the network learns; auto: a graphics card if any.")
    ] = "auto",
) -> None:
    """Path trace a scene and fit a network to it.

    Renderer and learner work side by side until the time is used up. Ctrl-C ends the training early and keeps what was
    learnt; --resume goes on from there. A report on the model and its importance module (what the network renderer
    draws its directions from) follow, each within a tenth of the time.
    """
    from dataclasses import replace

    from formats.scene import read_scene
    from prt_bake.cli.shared import after_training
    from prt_bake.network.settings import PRESETS
    from prt_bake.trainer.cores import select_device
    from prt_bake.trainer.train import train as fit

    learning_on, read = select_device(device), read_scene(scene)
    with reporting("train") as show, stopping() as stop:

        def follow(row: "TrainingProgress") -> None:
            show(row.share, _told(row))
            if stop():
                raise KeyboardInterrupt

        network = fit(
            read,
            minutes=minutes,
            steps=steps,
            seed=seed,
            settings=replace(PRESETS[preset], seed=seed),
            device=learning_on,
            output=output,
            resume=resume,
            synchronous=synchronous,
            samples=samples,
            progress=follow,
            say=say,
        )
        stopped = stop()
    for sentence in _figures(network.metadata["training"]):
        print(f"{output}: {sentence}")
    if stopped:
        raise PrtbakeError(f"{output}: the training was stopped; the model holds what was learnt, --resume goes on")
    if with_report:
        after_training.report(network, read, output, seed)
    if with_importance:
        after_training.importance(network, read, output, seed)


def _told(row: "TrainingProgress") -> str:
    return (
        f"step {row.step}, loss {row.loss:.4g}, validation error {row.validation:.2%}, "
        f"{row.queries_per_second:,.0f} queries/s ({row.reuse:.2g} times each, {row.waited:.0%} waiting), "
        f"{row.walks_per_second:,.0f} walks/s ({row.walking:.0%} walking)"
    )


def _figures(training: dict[str, Any]) -> list[str]:
    """What a training came to, in sentences."""
    said = [f"{training['steps']} steps, {training['walks']:,} walks in {training['seconds']:.0f} s"]
    if "test_relative_rmse" in training:
        test, samples = training["test_relative_rmse"], training["samples"]
        said.append(
            f"relative RMSE on the {samples['test_queries']:,} queries of {samples['file']} kept for testing "
            f"{test['transport']:.2%} (noise, {test['transport_noise']:.2%}, taken out)"
        )
    rmse = training["relative_rmse"]
    names = (
        {"coefficients": "of coefficients"}
        if rmse["transport"] is None
        else {
            "transport": "of the transport function",
            "coefficients": "of coefficients",
        }
    )
    errors = ", ".join(f"{words} {rmse[name]:.2%}" for name, words in names.items())
    noises = " and ".join(f"{rmse[name + '_noise']:.2%}" for name in names)
    said.append(f"relative RMSE on fresh queries {errors} (the reference's noise, {noises}, taken out)")
    return said
