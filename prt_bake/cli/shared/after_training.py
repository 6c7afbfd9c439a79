"""Steps after a training: the report and the importance module. A failure of either is printed; the model is kept."""

from pathlib import Path
from typing import TYPE_CHECKING

from formats.errors import PrtbakeError
from prt_bake.cli.shared.next_step import command
from prt_bake.cli.shared.progress import Report, reporting, say

if TYPE_CHECKING:
    from formats.scene import Scene
    from prt_bake.network.model import Model
    from prt_bake.trainer.budget import Budget

_SHARE_OF_THE_TRAINING = 0.1
_LEAST_SECONDS = 2.0
_MOST_SECONDS = {"report": 40.0, "importance": 60.0}


def report(
    network: "Model", scene: "Scene", model: Path, seed: int, budget: "Budget | None" = None, module: bool = True
) -> bool:
    """Write MODEL.report.json and MODEL.report.html, print the criteria and the quality, and return whether it is done.

    budget: the wall time of the training with what follows; `module`: whether the importance module still follows.
    Prints errors instead of raising; Ctrl-C is raised after a message.
    """
    from prt_bake.trainer.report.report import report_training
    from prt_bake.trainer.report.summary import criterion_line

    again = f"run `{command('prtbake', 'report', 'training', model, scene.path)}`"
    within = None if budget is None else budget.report(module)
    if within == 0.0:
        say(f"no report: no time is left for it; to write it later, {again}")
        return False
    with reporting("report") as show:

        def follow(share: float) -> None:
            show_part(show, "comparing with the path tracer", share, budget)

        try:
            measured, page = report_training(
                network,
                scene,
                model,
                seconds=_seconds(network, "report"),
                within=within,
                seed=seed,
                follow=follow,
            )
        except PrtbakeError as error:
            say(f"no report: {error}; to try again, {again}")
            return False
        except KeyboardInterrupt:
            say(f"no report: stopped; to write it later, {again}")
            raise
    for row in measured["criteria"]:
        print(criterion_line(row))
    print(f"{page}: {measured['summary'][0]}")
    return True


def importance(network: "Model", scene: "Scene", model: Path, seed: int, budget: "Budget | None" = None) -> None:
    """Fit and write MODEL.importance.pt; prints errors instead of raising. Ctrl-C keeps the module fitted so far."""
    from dataclasses import replace

    from prt_bake.importance.fit import fit_importance
    from prt_bake.importance.module import IMPORTANCE_PRESETS, importance_path, save_importance
    from prt_bake.importance.own_lobes import own_lobes

    if own_lobes(network) is not None:
        say("no importance module: `prtbake render` samples the lobes of the network")
        return
    again = f"to fit it later, run `{command('prtbake', 'importance', model, scene.mesh_path)}`"
    seconds = _seconds(network, "importance") if budget is None else budget.importance()
    if seconds == 0.0:
        say(f"no importance module: no time is left for it; {again}")
        return
    with reporting("importance") as show:
        try:
            module = fit_importance(
                network.cpu(),
                scene.mesh,
                seconds=seconds,
                seed=seed,
                settings=replace(IMPORTANCE_PRESETS["measured"], seed=seed),
                progress=lambda share, text: show_part(show, text, share, budget),
            )
            save_importance(module, model)
        except PrtbakeError as error:
            say(f"no importance module: {error}")
            return
        except KeyboardInterrupt:
            say(f"no importance module: stopped; {again}")
            raise
    fit = module.metadata["fit"]
    print(
        f"{importance_path(model)}: KL divergence {fit['module']['divergence']:.3f} "
        f"(uniform {fit['uniform']['divergence']:.3f}), sample variance under a uniform sky "
        f"{fit['module']['variance']:.3f} (uniform {fit['uniform']['variance']:.3f})"
    )


def quality_of(network: "Model") -> str:
    """The quality of a model by the final errors of its training, in words."""
    from prt_bake.trainer.report.quality import learning_minutes, quality
    from prt_bake.trainer.report.summary import final_error

    training = network.metadata["training"]
    minutes = learning_minutes(training["seconds"], network.metadata.get("started_from", ""))
    return quality(final_error(training["relative_rmse"]), minutes, training["walks"], network.kind)


def show_part(show: Report, text: str, share: float, budget: "Budget | None") -> None:
    """Show a part of a training: of the wall time if the run has one, else its own share."""
    if budget is None:
        show(share, text)
    else:
        show(budget.share, text, budget.left)


def _seconds(network: "Model", what: str) -> float:
    trained = float(network.metadata["training"]["seconds"])
    return min(_MOST_SECONDS[what], max(_LEAST_SECONDS, _SHARE_OF_THE_TRAINING * trained))
