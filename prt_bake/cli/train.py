"""`prtbake train`: path traces a scene and fits a model to it."""

import math
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.errors import PrtbakeError
from formats.extras import EVALUATE, missing_sentence
from prt_bake.cli.shared.ineffective import refuse_given
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.next_step import command, say_next, unused
from prt_bake.cli.shared.options import Force, Mend, Seed, output_option
from prt_bake.cli.shared.outputs import Paths, check_outputs, refuse_existing
from prt_bake.cli.shared.progress import reporting, say, stopping
from prt_bake.network.file_names import importance_path, report_paths, state_path

if TYPE_CHECKING:
    from formats.scene import Scene
    from prt_bake.network.model import Model
    from prt_bake.trainer.budget import Budget
    from prt_bake.trainer.train import TrainingProgress


_START_AND_END = 2.0
"""Seconds in which Python starts and ends, which are part of the wall time."""


def train(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene to train on.")],
    output: Annotated[Path, output_option("MODEL.pt", ".pt", ".safetensors")],
    minutes: Annotated[
        float,
        typer.Option(
            min=1e-3,
            max=1e6,
            help="Wall time, with report and importance module. Less than 1 is exceeded, and more if kernels are "
            "compiled first, since learning keeps half of it. Includes earlier runs that --resume continues.",
        ),
    ] = 10.0,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Total optimiser steps, instead of --minutes.", show_default=False)
    ] = None,
    preset: Annotated[
        Literal["measured", "paper"],
        typer.Option(help="Network: measured is the best in our tests; paper is the paper's."),
    ] = "measured",
    baseline: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Train a model that the paper compares itself with instead of the network: neumip, "
            "neumip-pyramid, neumip-log, nerfactor, nerfactor-known or nerfactor-unknown.",
            show_default=False,
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LIGHT",
            help="Light of the pictures that nerfactor-known and nerfactor-unknown learn from, as in `prtbake shade`; "
            "by default the sky of the example. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    mend: Mend = False,
    start: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="EARLIER.pt",
            help="Start from a model of the object with another material, size or detail: takes far less time.",
            show_default=False,
        ),
    ] = None,
    only_low_bands: Annotated[
        bool,
        typer.Option(
            "--only-low-bands",
            help="Keep all layers of the --from model but those of the coefficients to degree 2, which bakes use.",
        ),
    ] = False,
    samples: Annotated[
        Path | None,
        typer.Option(
            metavar="SAMPLES.h5",
            help="Learn from a file that `prtbake sample` wrote, in place of path tracing.",
            show_default=False,
        ),
    ] = None,
    synchronous: Annotated[
        bool,
        typer.Option("--synchronous", help="Render and learn in turns: with --steps, bit-reproducible."),
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume from MODEL.train.pt beside the output.")] = False,
    force: Force = False,
    with_report: Annotated[
        bool, typer.Option("--report/--no-report", help="Then measure the model: MODEL.report.json and .html.")
    ] = True,
    with_importance: Annotated[
        bool, typer.Option("--importance/--no-importance", help="Then fit the importance module.")
    ] = True,
    seed: Seed = 0,
    device: Annotated[
        Literal["auto", "cpu", "cuda"],
        typer.Option(help="Device that path traces and learns; auto: the GPU if there is one."),
    ] = "auto",
) -> None:
    """Path trace a scene and fit a network to it.

    Renders training samples and trains concurrently until the time is used up. Ctrl-C ends the training early and keeps
    the model; --resume continues it, unless it learned from pictures. Then measures the model and fits its importance
    module, from which `prtbake render` draws light directions.
    """
    began = time.perf_counter() - _START_AND_END
    _refuse_ineffective(context, baseline, light, start, only_low_bands)
    if light is None:
        refuse_given(context, ("mend",), "without --light")
    outputs: dict[str, Paths] = {"--output": output, "the checkpoint": state_path(output)}
    outputs |= {"--report": report_paths(output)} if with_report else {}
    outputs |= {"--importance": importance_path(output)} if with_importance else {}
    check_outputs(outputs, {"SCENE": scene, "--samples": samples, "--light": light, "--from": start})
    refuse_existing((output, state_path(output), importance_path(output)), force, resume)
    expected = {"SCENE": (scene, ("scene",)), "--samples": (samples, ("samples",)), "--light": (light, LIGHT)}
    refuse_other_kinds({**expected, "--from": (start, ("model",))})
    if with_report and (missing := missing_sentence(*EVALUATE)):
        say(f"there will be no report: {missing}; `prtbake report training` writes it later")
        with_report = False
    from dataclasses import replace
    from functools import partial

    from formats.scene import read_scene
    from prt_bake.cli.shared import after_training
    from prt_bake.network.bssrdf import load_model
    from prt_bake.network.settings import PRESETS
    from prt_bake.trainer.budget import Budget
    from prt_bake.trainer.cores import select_device
    from prt_bake.trainer.train import train as fit

    fitted: Callable[..., Model]
    if baseline is None:
        earlier: Any = None if start is None else load_model(start)
        settings = replace(PRESETS[preset], seed=seed) if start is None else None
        selected = select_device(device)
        fitted = partial(fit, settings=settings, start=earlier, only_low_bands=only_low_bands)
    else:
        from prt_bake.baselines.by_name import train_baseline

        selected, fitted = "cpu" if device == "auto" else device, partial(train_baseline, baseline=baseline)
    read = read_scene(scene)
    if light is not None:
        from prt_bake.lights.lighting import read_lighting

        fitted = partial(fitted, light=read_lighting(light, read.up, mend=mend, say=say, mesh=read.mesh))
    budget = Budget(minutes, began, report=with_report, importance=with_importance) if steps is None else None
    with stopping() as stop:
        stop.at_once = True
        with reporting("train", "loading") as show:

            def part(name: str, share: float) -> None:
                # Only learning has something to finish: a step, and the model.
                stop.at_once = name != "learning"
                if stop.at_once:
                    after_training.show_part(show, name, share, budget)

            def report(row: "TrainingProgress") -> None:
                share, left = (row.share, None) if budget is None else (budget.share, budget.left)
                show(
                    share,
                    "error unknown" if math.isnan(row.validation) else f"error {row.validation:.1%}",
                    left,
                    _details(row),
                )

            network = fitted(
                read,
                minutes=minutes,
                steps=steps,
                seed=seed,
                device=selected,
                output=output,
                resume=resume,
                synchronous=synchronous,
                samples=samples,
                progress=report,
                say=say,
                stop=stop,
                part=part,
                budget=budget,
            )
        stop.at_once = True
        for sentence in _figures(network.metadata["training"], output, scene):
            print(f"{output}: {sentence}")
        if network.metadata["training"]["stopped"]:
            raise PrtbakeError(f"{output}: the training was stopped; the model is written, and {_to_go_on(network)}")
        _measure(network, read, output, seed, budget, with_report, with_importance)
        if stop():
            raise PrtbakeError(f"{output}: the model is complete, and what should follow it was stopped")
    on = ("--device", device) if device == "cuda" else ()
    say_next("prtbake", "bake", output, read.mesh_path, "-o", unused(output.with_suffix(".h5")), *on)


def _refuse_ineffective(
    context: typer.Context, baseline: str | None, light: list[str] | None, start: Path | None, only_low_bands: bool
) -> None:
    """Raise typer.BadParameter for options that the chosen model does not have."""
    source = context.get_parameter_source("preset")
    preset = source is not None and source.name == "COMMANDLINE"
    if baseline is not None and preset:
        raise typer.BadParameter("--preset: is for the network; omit it, since a baseline has the published size")
    if start is not None and (preset or baseline is not None):
        other = "--preset" if preset else "--baseline"
        raise typer.BadParameter(f"--from: the model is of the kind of the earlier one; omit {other}")
    if only_low_bands and start is None:
        raise typer.BadParameter("--only-low-bands: keeps the other layers of an earlier model; name it with --from")
    if light is None:
        return
    from prt_bake.baselines.by_name import FROM_PICTURES

    if baseline not in FROM_PICTURES:
        names = " and ".join(FROM_PICTURES)
        raise typer.BadParameter(f"--light: is for --baseline {names}; omit it, since other models learn for all light")


def _measure(
    network: "Model",
    read: "Scene",
    output: Path,
    seed: int,
    budget: "Budget | None",
    with_report: bool,
    with_importance: bool,
) -> None:
    """Write the report of a model and its importance module; Ctrl-C ends both."""
    from prt_bake.cli.shared import after_training
    from prt_bake.importance.own_lobes import own_lobes

    reported = False
    with suppress(KeyboardInterrupt), nullcontext() if budget is None else budget.counting_compilation():
        if with_report:
            module = with_importance and own_lobes(network) is None
            reported = after_training.report(network, read, output, seed, budget, module)
        if with_importance:
            after_training.importance(network, read, output, seed, budget)
    if not reported:
        print(f"{output}: {after_training.quality_of(network)}")


def _to_go_on(network: "Model") -> str:
    """What continues a training that was stopped, in words."""
    if "pictures" in network.metadata["training"]:
        return "a training from pictures cannot be resumed: run it again, with --force, for a better one"
    return "--resume continues it"


def _details(row: "TrainingProgress") -> str:
    return (
        f"step {row.step} · loss {row.loss:.4g} · {row.queries_per_second:,.0f} queries/s · "
        f"{row.walks_per_second:,.0f} paths/s"
    )


def _figures(training: dict[str, Any], output: Path, scene: Path) -> list[str]:
    """Return the results of a training as sentences."""
    sentences = [f"{training['steps']} steps, {training['walks']:,} paths in {training['seconds']:.0f} s of learning"]
    if "lobe_share" in training:
        sentences.append(f"{training['lobe_share']:.1%} of its Ŝ is its glossy lobe")
    if "test_relative_rmse" in training:
        test, samples = training["test_relative_rmse"], training["samples"]
        sentences.append(
            f"relative RMSE on the {samples['test_queries']:,} test queries of {samples['file']} "
            f"{_percent(test['transport'])} (the noise, {_percent(test['transport_noise'])}, is subtracted)"
        )
    if "relative_rmse" not in training:
        measuring = command("prtbake", "report", "training", output, scene)
        return [*sentences, f"its errors are not measured; `{measuring}` measures them"]
    rmse = training["relative_rmse"]
    names = {"transport": "of the transport function", "coefficients": "of the coefficients"}
    if rmse["transport_noise"] is None:
        del names["transport"]
    known = {key: _percent(rmse[key]) for key in names}
    errors = ", ".join(f"{name} {known[key]}" for key, name in names.items())
    noises = " and ".join(f"{rmse[key + '_noise']:.2%}" for key in names)
    sentences.append(f"relative RMSE on fresh queries {errors} (the noise of the reference, {noises}, is subtracted)")
    return sentences


def _percent(error: float | None) -> str:
    return "unknown" if error is None or math.isnan(error) else f"{error:.2%}"
