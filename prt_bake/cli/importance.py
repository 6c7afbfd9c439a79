"""`prtbake importance`: fits the importance module of a model."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from formats.atomic import existing
from formats.errors import PrtbakeError
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.mesh_name import naming_mesh
from prt_bake.cli.shared.options import Device, Force, Seed
from prt_bake.cli.shared.outputs import check_outputs, refuse_existing
from prt_bake.cli.shared.progress import reporting, stopping
from prt_bake.network.file_names import importance_path


@naming_mesh
def importance(
    model: Annotated[Path, typer.Argument(metavar="MODEL.pt", help="Trained model.")],
    mesh: Annotated[
        Path | None,
        typer.Argument(
            metavar="MESH",
            help="Object that the model was trained on; by default that of its scene.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=0, max=1e6, help="Time limit of evaluating the model and fitting.")
    ] = 60.0,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Optimiser steps instead of --seconds; by default at most 1500.", show_default=False),
    ] = None,
    preset: Annotated[
        Literal["measured", "paper"],
        typer.Option(help="Lobe: measured learns its axis; paper is the paper's Gaussian about the normal."),
    ] = "measured",
    seed: Seed = 0,
    device: Device = "cpu",
    force: Force = False,
) -> None:
    """Fit the importance module of a model: MODEL.importance.pt.

    The module predicts which light directions matter at each point and view; `prtbake render` draws its samples from
    it. It learns from the model alone. A network with lobes of its own needs none. Ctrl-C ends the fit early and keeps
    the module as fitted so far.
    """
    path = importance_path(existing(model))
    check_outputs({"the module": path}, {"MODEL": model, "MESH": mesh})
    refuse_existing([path], force)
    refuse_other_kinds({"MODEL": (model, ("model",)), "MESH": (mesh, ("mesh",))})
    from dataclasses import replace

    from formats.mesh import read_mesh
    from prt_bake.baking.sources import own_mesh, require_device
    from prt_bake.importance.fit import fit_importance
    from prt_bake.importance.module import IMPORTANCE_PRESETS, save_importance
    from prt_bake.importance.own_lobes import own_lobes
    from prt_bake.network.bssrdf import load_model

    require_device(device)
    network, surface = load_model(model, device), read_mesh(mesh or own_mesh(model), drop_flat_faces=True)
    if own_lobes(network) is not None:
        raise PrtbakeError(
            f"{model}: needs no importance module: `prtbake render` samples the lobes that it has itself"
        )

    with reporting("importance") as show, stopping() as stop:

        def report(share: float, text: str) -> None:
            show(share, text)
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
            progress=report,
        )
        stopped = stop()
    save_importance(module, model)
    fit = module.metadata["fit"]
    print(
        f"{path}: {fit['steps']} steps on {fit['queries']:,} queries in {fit['seconds']:.0f} s; KL divergence "
        f"{fit['module']['divergence']:.3f} (uniform {fit['uniform']['divergence']:.3f}, one lobe for the object "
        f"{fit['constant']['divergence']:.3f}), sample variance under a uniform sky "
        f"{fit['module']['variance']:.3f} (uniform {fit['uniform']['variance']:.3f}, one lobe for the object "
        f"{fit['constant']['variance']:.3f})"
    )
    if stopped:
        raise PrtbakeError(f"{path}: the fit was stopped; the module is written as fitted so far")
