"""Steps after a training: the report and the importance module. A failure of either is printed; the model is kept."""

from pathlib import Path
from typing import TYPE_CHECKING

from formats.errors import PrtbakeError
from prt_bake.cli.shared.progress import reporting, say, stopping

if TYPE_CHECKING:
    from formats.scene import Scene
    from prt_bake.network.bssrdf import NeuralBSSRDF

_SHARE_OF_THE_TRAINING = 0.1
_LEAST_SECONDS = 2.0
_MOST_SECONDS = {"report": 40.0, "importance": 60.0}


def report(network: "NeuralBSSRDF", scene: "Scene", model: Path, seed: int) -> None:
    """Write MODEL.report.json and MODEL.report.html and print the criteria; prints errors instead of raising."""
    from prt_bake.trainer.report.report import report_training
    from prt_bake.trainer.report.summary import criterion_line

    say("path tracing fresh queries for the report")
    try:
        measured, page = report_training(network, scene, model, seconds=_seconds(network, "report"), seed=seed)
    except PrtbakeError as error:
        say(f"no report: {error}; to try again, run 'prtbake report training {model} {scene.path}'")
        return
    except KeyboardInterrupt:
        say(f"no report: stopped; to write it later, run 'prtbake report training {model} {scene.path}'")
        return
    for row in measured["criteria"]:
        print(criterion_line(row))
    print(f"{page}: {measured['summary'][0]}")


def importance(network: "NeuralBSSRDF", scene: "Scene", model: Path, seed: int) -> None:
    """Fit and write MODEL.importance.pt; prints errors instead of raising. Ctrl-C keeps the module fitted so far."""
    from dataclasses import replace

    from prt_bake.importance.fit import fit_importance
    from prt_bake.importance.module import IMPORTANCE_PRESETS, importance_path, save_importance
    from prt_bake.importance.own_lobes import own_lobes

    if own_lobes(network) is not None:
        say("no importance module: `prtbake render` samples the lobes of the network")
        return
    with reporting("importance") as show, stopping() as stop:

        def report_fit(share: float, text: str) -> None:
            show(share, text)
            if stop():
                raise KeyboardInterrupt

        try:
            module = fit_importance(
                network.cpu(),
                scene.mesh,
                seconds=_seconds(network, "importance"),
                seed=seed,
                settings=replace(IMPORTANCE_PRESETS["measured"], seed=seed),
                progress=report_fit,
            )
            save_importance(module, model)
        except PrtbakeError as error:
            say(f"no importance module: {error}")
            return
        except KeyboardInterrupt:
            say(f"no importance module: stopped; to fit it later, run 'prtbake importance {model} {scene.mesh_path}'")
            return
    fit = module.metadata["fit"]
    print(
        f"{importance_path(model)}: KL divergence {fit['module']['divergence']:.3f} "
        f"(uniform {fit['uniform']['divergence']:.3f}), sample variance under a uniform sky "
        f"{fit['module']['variance']:.3f} (uniform {fit['uniform']['variance']:.3f})"
    )


def _seconds(network: "NeuralBSSRDF", what: str) -> float:
    trained = float(network.metadata["training"]["seconds"])
    return min(_MOST_SECONDS[what], max(_LEAST_SECONDS, _SHARE_OF_THE_TRAINING * trained))
