"""What `prtbake train` writes beside a model: the importance module, and the report that says how good the model is."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from formats.errors import PrtbakeError
from prt_bake.cli.progress import reporting, say

if TYPE_CHECKING:
    from formats.scene import Scene

SHARE = 0.1
"""Of the training's time, at most, for either."""
MOST_IMPORTANCE, MOST_REPORT = 60.0, 40.0
_LEAST = 2.0


def budget(trained: float, most: float) -> float:
    """Seconds for one of them, after `trained` seconds of training."""
    return max(_LEAST, min(most, SHARE * trained))


def write_importance(network: Any, scene: "Scene", output: Path, seed: int, device: str) -> None:
    """Fit the importance module of a network and write it beside the model."""
    from dataclasses import replace

    from prt_bake.importance import IMPORTANCE_PRESETS, importance_path, save_importance
    from prt_bake.importance_fit import fit_importance

    seconds = budget(network.metadata["training"]["seconds"], MOST_IMPORTANCE)
    try:
        with reporting("importance") as show:
            module = fit_importance(
                network,
                scene.mesh,
                seconds=seconds,
                seed=seed,
                settings=replace(IMPORTANCE_PRESETS["measured"], seed=seed),
                device=device,
                progress=show,
            )
    except PrtbakeError as fault:  # a black object has nothing to draw directions by, and a model all the same
        say(f"no importance module: {fault}")
        return
    save_importance(module, output)
    fit = module.metadata["fit"]
    print(
        f"{importance_path(output)}: variance of a sample under a uniform sky {fit['module']['variance']:.3f} "
        f"(uniform directions {fit['uniform']['variance']:.3f})"
    )


def write_report(network: Any, scene: "Scene", output: Path, seed: int) -> None:
    """Measure a network against the path tracer and write the report beside the model."""
    from prt_bake.training_report import report_training

    say("path tracing fresh queries for the report")
    seconds = budget(network.metadata["training"]["seconds"], MOST_REPORT)
    try:
        found, page = report_training(network, scene, output, seconds=seconds, seed=seed)
    except PrtbakeError as fault:  # without matplotlib there is the JSON alone
        say(str(fault))
        return
    print(f"{page}: {found['summary'][0]}")
