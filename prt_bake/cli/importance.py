"""`prtbake importance`: the module that the network renderer draws its directions from."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.options import Device, Seed
from prt_bake.cli.shared.progress import reporting, stopping


def importance(
    model: Annotated[Path, typer.Argument(metavar="MODEL.pt", help="A trained network.")],
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="The object that it was trained on.")],
    seconds: Annotated[float, typer.Option(min=0, max=1e6, help="Time to gather values and to fit, at most.")] = 60.0,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Optimiser steps, in place of seconds; 1500 at most without.", show_default=False),
    ] = None,
    preset: Annotated[
        Literal["measured", "paper"],
        typer.Option(help="The lobe: an axis of its own, or a Gaussian about the normal as the paper has it."),
    ] = "measured",
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Fit the importance module of a network: MODEL.importance.pt.

    It learns from the network alone which directions of light matter at each point and for each view. Ctrl-C ends the
    fit early and keeps what was learnt.
    """
    from dataclasses import replace

    from formats.mesh import read_mesh
    from prt_bake.baking.sources import require_device
    from prt_bake.importance.fit import fit_importance
    from prt_bake.importance.module import IMPORTANCE_PRESETS, importance_path, save_importance
    from prt_bake.network.bssrdf import load_model

    require_device(device)
    network, surface = load_model(model, device), read_mesh(mesh, drop_flat_faces=True)

    with reporting("importance") as show, stopping() as stop:

        def follow(share: float, words: str) -> None:
            show(share, words)
            if stop():
                raise KeyboardInterrupt

        module = fit_importance(
            network,
            surface,
            seconds=seconds,
            steps=steps,
            seed=seed,
            settings=replace(IMPORTANCE_PRESETS[preset], seed=seed),
            device=device,
            progress=follow,
        )
        stopped = stop()
    save_importance(module, model)
    path, fit = importance_path(model), module.metadata["fit"]
    print(
        f"{path}: {fit['steps']} steps on {fit['queries']:,} queries in {fit['seconds']:.0f} s; KL divergence "
        f"{fit['module']['divergence']:.3f} (uniform {fit['uniform']['divergence']:.3f}, one lobe for the object "
        f"{fit['constant']['divergence']:.3f}), variance of a sample under a uniform sky "
        f"{fit['module']['variance']:.3f} (uniform {fit['uniform']['variance']:.3f}, one lobe "
        f"{fit['constant']['variance']:.3f})"
    )
    if stopped:
        raise PrtbakeError(f"{path}: the fit was stopped; the module holds what was learnt")
