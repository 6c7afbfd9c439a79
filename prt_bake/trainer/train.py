"""`train`: fits a network to a scene for a given time or number of steps.

The loss is the squared error (the paper's L2) of Ŝ in units of the network's output scale. Where the boundary bends
light it is estimated from exits of walks (`objective.py`). The optimisers are Muon and AdamW with a cosine schedule and
averaged weights. Matrix products are in bfloat16 if the device is faster in it.
"""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from formats.atomic import refuse_unwritable
from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, load_model
from prt_bake.network.checkpoint import refuse_other_suffix
from prt_bake.network.file_names import state_path
from prt_bake.network.model import TrainableModel
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.cores import select_device, walking_device
from prt_bake.trainer.fit import Fit, NetworkFit
from prt_bake.trainer.history import TrainingProgress
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.offline import SampleFileData
from prt_bake.trainer.resume import require_state, seconds_of
from prt_bake.trainer.run import Part, Progress, Request, Run
from prt_bake.trainer.samples.rows import StreamSettings
from prt_bake.trainer.scene_warnings import training_warning
from prt_bake.trainer.training_data import PathTracedData, TrainingData, learning_for, stream_for

__all__ = ["LearningSettings", "TrainingProgress", "train"]

_MANY_WALKS = 64
"""Per query where only low bands are learned, so that there is time for several passes over all queries."""
QUANTITIES = {"transport": "the transport function", "coefficients": "the coefficients a_lm over the surface"}
"""Names of the quantities that a validation error can measure."""


def train(
    scene: Scene,
    *,
    minutes: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    settings: NetworkSettings | None = None,
    start: NeuralBSSRDF | None = None,
    only_low_bands: bool = False,
    device: str = "auto",
    output: str | Path | None = None,
    resume: bool = False,
    synchronous: bool = False,
    samples: str | Path | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    stop: Callable[[], bool] | None = None,
    part: Part | None = None,
    budget: Budget | None = None,
    stream: StreamSettings | None = None,
    learning: LearningSettings | None = None,
) -> NeuralBSSRDF:
    """Train a neural BSSRDF of a scene for `minutes` of wall time, or for `steps` if given.

    The minutes include the path tracing of validation queries and the final errors. If kernels are compiled first,
    learning still gets half of them. With `steps` the queries take as long as they need.

    Args:
        scene: the scene to path trace.
        minutes, steps: length of the complete run, including earlier parts that are resumed.
        seed: seed of the queries, the walks and the network's initial weights.
        settings: the network; by default the preset "measured" with `seed`. `PRESETS["paper"]` is the paper's.
        start: network to start from, of the same object with another material, or of a similar one. It needs far fewer
            steps than a new one. Use its seed if you give settings.
        only_low_bands: keep all layers of `start` but its low bands, the coefficients to degree 2 that bakes use, and
            the correction by them. All the time goes to paths for these.
        device: "auto" (CUDA if available), "cpu" or "cuda".
        output: path of the model, written once a minute and at the end, with a checkpoint for `resume` beside it.
        resume: continue the run whose checkpoint is beside `output`.
        synchronous: renderer and learner take turns instead of running concurrently. `steps`, `seed` and the settings
            then determine every bit of the weights, on any number of cores, resumed or not; products are in float32.
        samples: file of samples (`record_samples`) to learn from in repeated passes. Only the queries of
            the final errors are path traced then.
        progress: called with a `TrainingProgress` every few seconds. A KeyboardInterrupt, also one raised here, ends
            the training early and keeps what was learned; the final errors are not measured then.
        say: called with sentences about what is being done.
        stop: ends the training like a KeyboardInterrupt, after a complete step, when it returns True.
        part: called with "validation queries", "learning", "low bands" (and the correction by them) or "final errors",
            and the share of that part that is over.
        budget: the wall time of a run that has further parts; by default `minutes` from now.
        stream, learning: settings of the renderer and of the optimiser.

    Returns the network. `network.metadata["training"]` has its final errors as "relative_rmse": the relative RMSE of Ŝ
    and of a_lm on fresh queries, corrected for the reference's noise. A run that was stopped has none.

    Raises QueryError for a time that is not positive, for `synchronous` without `steps`, for `only_low_bands` where
    there are none to learn, and for a loss that is not finite, naming the query; SamplesError for a file that is
    damaged or belongs to another scene; ModelError for a checkpoint that cannot be resumed; StorageError, at once, if
    `output` cannot be written.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene("spot.toml")
    >>> network = prt.train(scene, steps=2, output="quick.pt")  # ten minutes give a good network: minutes=10
    >>> network.metadata["training"]["steps"]
    2
    """
    if start is not None and not isinstance(start, NeuralBSSRDF):
        raise QueryError(f"start: expected a neural BSSRDF, found {type(start).__name__}; train without it")
    if only_low_bands and start is None:
        raise QueryError("only_low_bands: needs start, a network whose other layers are kept")
    values = samples is not None or (stream is not None and stream.rays == "values")
    if only_low_bands and values:
        raise QueryError("only_low_bands: low bands learn from exits of paths; train without samples, or with exits")
    if values and start is not None and start.low is not None and say is not None:
        say("the model will have no low bands, which learn from exits of paths alone; its bakes take longer")
    chosen = settings or replace(PRESETS["measured"], seed=seed if start is None else start.settings.seed)

    def fit(data: TrainingData, device: str) -> NetworkFit:
        return NetworkFit(data, chosen, device, start, only_low_bands)

    network = train_model(
        scene,
        fit,
        started=start is not None,
        many_walks=only_low_bands,
        minutes=minutes,
        steps=steps,
        seed=seed,
        device=device,
        output=output,
        resume=resume,
        synchronous=synchronous,
        samples=samples,
        progress=progress,
        say=say,
        stop=stop,
        part=part,
        budget=budget,
        stream=stream,
        learning=learning,
    )
    assert isinstance(network, NeuralBSSRDF)
    return network


def train_model(
    scene: Scene,
    make: Callable[[TrainingData, str], Fit],
    *,
    started: bool = False,
    many_walks: bool = False,
    minutes: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    device: str = "auto",
    output: str | Path | None = None,
    resume: bool = False,
    synchronous: bool = False,
    samples: str | Path | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    stop: Callable[[], bool] | None = None,
    part: Part | None = None,
    budget: Budget | None = None,
    stream: StreamSettings | None = None,
    learning: LearningSettings | None = None,
) -> TrainableModel:
    """`train` for any model: `make(data, device)` says what is fitted.

    started: whether its weights are those of an earlier training. many_walks: whether each query has 64 walks or more,
    although the learner waits.
    """
    refuse_path("scene", scene, "prt.load_scene")
    if not 0 < minutes < math.inf or (steps is not None and steps < 1):
        raise QueryError(f"train: minutes and steps must be positive and finite, found {minutes:g} and {steps}")
    if synchronous and steps is None:
        raise QueryError("train: synchronous needs steps: the number of steps in a time varies from run to run")
    if output is not None:
        refuse_other_suffix(output)
        for path in (output, state_path(output)):
            refuse_unwritable(path)
    if resume:
        if output is None:
            raise QueryError("train: resume needs output, the model to continue from")
        require_state(output)
    report, follow = say or (lambda sentence: None), part or (lambda name, share: None)
    timed = (budget or Budget(minutes)) if steps is None else None
    if timed is not None and resume and output is not None:
        timed.earlier = seconds_of(output)
    request = Request(steps, timed, output, progress or (lambda state: None), follow, stop or (lambda: False))
    chosen = select_device(device)
    if warning := training_warning(scene):
        report(f"{scene.path}: {warning}")
    data: TrainingData
    with nullcontext() if timed is None else timed.counting_compilation():
        if samples is not None:
            report(f"reading {samples}")
            data = SampleFileData(scene, samples, seed, synchronous)
        else:
            report("path tracing the validation queries")
            values = stream is not None and stream.rays == "values"
            walking = walking_device(chosen, synchronous or values, report)
            renderer = stream or stream_for(walking, synchronous)
            if many_walks:
                walks = max(renderer.exits, _MANY_WALKS)
                renderer = replace(renderer, exits=walks, least_exits=walks)
            data = PathTracedData(scene, renderer, seed, synchronous, walking)
        run = Run(data, make(data, chosen), learning or learning_for(data, started), seed, request, resume)
        if resume and run.nothing_left() and (finished := _finished(output, scene)) is not None:
            report(
                f"{output}: nothing is left to learn: it already had {run.learner.step} steps in "
                f"{run.seconds / 60.0:.3g} minutes of learning, which the requested length includes; request more"
            )
            return finished
        report(f"learning; the validation error is that of {QUANTITIES[run.reference.quantity]}")
        run.learn()
        return run.finish()


def _finished(output: str | Path | None, scene: Scene) -> TrainableModel | None:
    """The model of a finished run; None if its last training was stopped, or it is missing."""
    if output is None or not Path(output).is_file():
        return None
    model: Any = load_model(output)
    finished: TrainableModel = model.on(scene.mesh)
    return None if model.metadata.get("training", {}).get("stopped", True) else finished
