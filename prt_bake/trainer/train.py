"""`train`: fits a network to a scene for a given time or number of steps.

The loss is the squared error (the paper's L2) of Ŝ in units of the network's output scale. Where the boundary bends
light it is estimated from exits of walks (`objective.py`). The optimisers are Muon and AdamW with a cosine schedule and
averaged weights. Matrix products are in bfloat16 if the device is faster in it.
"""

import json
import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from formats.atomic import refuse_unwritable
from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, save_model
from prt_bake.network.checkpoint import refuse_other_suffix
from prt_bake.network.file_names import state_path
from prt_bake.tracer.prepared import interface_kind, is_unrefracted
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.cores import select_device, walking_device
from prt_bake.trainer.history import Meter, TrainingProgress, every_tenth
from prt_bake.trainer.interior import interior_of, is_clear, with_fitting_grid
from prt_bake.trainer.learner import Learner, LearningSettings
from prt_bake.trainer.offline import SampleFileData
from prt_bake.trainer.prefetch import Prefetcher
from prt_bake.trainer.resume import read_state, require_state, seconds_of, write_state
from prt_bake.trainer.samples.rows import RowSource, StreamSettings
from prt_bake.trainer.scene_warnings import training_warning
from prt_bake.trainer.training_data import PathTracedData, TrainingData, box_of, learning_for, stream_for

__all__ = ["LearningSettings", "TrainingProgress", "train"]

Progress = Callable[[TrainingProgress], None]
Part = Callable[[str, float], None]
QUANTITIES = {"transport": "the transport function", "coefficients": "the coefficients a_lm over the surface"}
"""Names of the quantities that a validation error can measure."""


def train(
    scene: Scene,
    *,
    minutes: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    settings: NetworkSettings | None = None,
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
        device: "auto" (CUDA if available), "cpu" or "cuda".
        output: path of the model, written once a minute and at the end, with a checkpoint for `resume` beside it.
        resume: continue the run whose checkpoint is beside `output`.
        synchronous: renderer and learner take turns instead of running concurrently. `steps`, `seed` and the settings
            then determine every bit of the weights, on any number of cores, resumed or not; products are in float32.
        samples: file of samples (`record_samples`) to learn from in repeated passes. Only validation and test queries
            are path traced then.
        progress: called with a `TrainingProgress` every few seconds. A KeyboardInterrupt, also one raised here, ends
            the training early and keeps what was learned; the final errors are not measured then.
        say: called with sentences about what is being done.
        stop: ends the training like a KeyboardInterrupt, after a complete step, when it returns True.
        part: called with "validation queries", "learning" or "final errors" and the finished share of that part.
        budget: the wall time of a run that has further parts; by default `minutes` from now.
        stream, learning: settings of the renderer and of the optimiser.

    Returns the network. `network.metadata["training"]` has its final errors as "relative_rmse": the relative RMSE of Ŝ
    and of a_lm on fresh queries, corrected for the reference's noise. A run that was stopped has none.

    Raises QueryError for a time that is not positive, for `synchronous` without `steps`, and for a loss that is not
    finite, naming the query; SamplesError for a file that is damaged or belongs to another scene; ModelError for a
    checkpoint that cannot be resumed; StorageError, at once, if `output` cannot be written.

    >>> import prt_bake as prt
    >>> scene = prt.load_scene("spot.toml")
    >>> network = prt.train(scene, steps=2, output="quick.pt")  # ten minutes give a good network: minutes=10
    >>> network.metadata["training"]["steps"]
    2
    """
    refuse_path("scene", scene, "prt.load_scene")
    if minutes <= 0 or (steps is not None and steps < 1):
        raise QueryError(f"train: minutes and steps must be positive, found {minutes:g} and {steps}")
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
            data = PathTracedData(scene, stream or stream_for(walking), seed, synchronous, walking)
        run = _Run(
            data,
            _settings_for(settings or replace(PRESETS["measured"], seed=seed), scene),
            learning or learning_for(data),
            chosen,
            seed,
            timed,
            follow,
        )
        if resume:
            assert output is not None
            run.restore(output)
            if run.nothing_left(steps):
                report(
                    f"{output}: nothing is left to learn: it already had {run.learner.step} steps in "
                    f"{run.seconds / 60.0:.3g} minutes of learning, which the requested length includes; request more"
                )
        report(f"learning; the validation error is that of {QUANTITIES[run.reference.quantity]}")
        run.learn(steps, output, progress, stop or (lambda: False))
        return run.finish(output)


class _Run:
    """One training run: its data, its learner and its progress."""

    def __init__(
        self,
        data: TrainingData,
        settings: NetworkSettings,
        learning: LearningSettings,
        device: str,
        seed: int,
        budget: Budget | None,
        part: Part,
    ) -> None:
        self.data, self.learning, self.seed = data, learning, seed
        self.budget, self.part = budget, part
        self.scene, box = data.scene, data.box
        interior = None
        if settings.ray_samples:
            interior = interior_of(self.scene, box, settings.interfaces > 0, settings.material_channels > 0)
            settings = with_fitting_grid(settings, interior)
        self.resume_settings = {
            **{f"network {name}": value for name, value in settings.as_json().items()},
            "interior": "" if interior is None else interior.content_hash,
            "seed": seed,
            "muon": learning.muon,
            **data.resume_settings,
        }
        self.synchronous = bool(self.resume_settings["synchronous"])
        self.reference = data.reference(
            learning, math.inf if budget is None else budget.validation, partial(part, "validation queries")
        )
        network = NeuralBSSRDF(
            settings, box.corner, box.side, self.reference.scale() or 1.0, _metadata(self.scene), interior
        ).to(device)
        network = network.on(self.scene.mesh)
        # The faster precision is measured by a clock, which must not decide the bits of a synchronous run.
        self.learner = self._learner(network, replace(learning, bfloat16=False) if self.synchronous else learning)
        self.generator = np.random.default_rng(seed)
        self.seconds = 0.0
        self.length = math.inf
        """Seconds of learning of the complete run, if it ends by time."""
        self.stopped = False
        self.source: RowSource | None = None
        self.source_state: dict[str, int] | None = None
        self.history: list[TrainingProgress] = []

    def _learner(self, network: NeuralBSSRDF, learning: LearningSettings) -> Learner:
        if not self.data.on_gpu:
            return Learner(network, learning)
        from prt_bake.trainer.gpu.learner import GpuLearner

        return GpuLearner(network, learning)

    def restore(self, output: str | Path) -> None:
        """Continue from the checkpoint beside `output`."""
        state = read_state(output, self.scene.content_hash, self.resume_settings)
        for network in (self.learner.network, self.learner.model):
            network.output_scale = float(state["output_scale"])
        self.learner.restore(state["learner"])
        self.generator.bit_generator.state = json.loads(state["generator"])
        self.seconds, self.source_state = float(state["seconds"]), dict(state["source"])
        self.history = [TrainingProgress(**report) for report in state["history"]]

    def nothing_left(self, steps: int | None) -> bool:
        """Whether a resumed run had the requested length."""
        if steps is not None:
            return self.learner.step >= steps
        return self.budget is not None and self.budget.learning(self.seconds) <= 0.0

    def state(self) -> dict[str, Any]:
        """The checkpoint's content: plain values and tensors."""
        assert self.source is not None
        return {
            "scene": self.scene.content_hash,
            "begun": self.resume_settings,
            "output_scale": self.learner.network.output_scale,
            "learner": self.learner.state(),
            "generator": json.dumps(self.generator.bit_generator.state),
            "source": self.source.state(),
            "seconds": self.seconds,
            **({} if self.budget is None else {"spent": self.budget.spent}),
            "history": [asdict(report) for report in self.history],
        }

    def learn(
        self, steps: int | None, output: str | Path | None, progress: Progress | None, stop: Callable[[], bool]
    ) -> None:
        """Learn until the end of the run, or until it is stopped."""
        device = self.learner.network.frequencies.device.type
        self.source = self.data.source(self.learning, self.learner.network, self.source_state)
        threads_before = torch.get_num_threads()
        threads = self.data.learner_threads(self.learning, device)
        prefetching = 0 if self.synchronous or device != "cpu" else threads
        prefetcher = Prefetcher(self.source, self.learner, self.generator, prefetching)
        torch.set_num_threads(threads)
        try:
            with self.learner.stream():
                self._learn(self.source, prefetcher, steps, output, progress, stop)
        except KeyboardInterrupt:
            if self.learner.step == 0:
                raise
            self.stopped = True
        finally:
            self.source.stop()
            prefetcher.stop()
            torch.set_num_threads(threads_before)

    def _learn(
        self,
        source: RowSource,
        prefetcher: Prefetcher,
        steps: int | None,
        output: str | Path | None,
        progress: Progress | None,
        stop: Callable[[], bool],
    ) -> None:
        before = self.seconds
        if self.budget is not None:
            self.length = before + self.budget.learning(before)
        first, begun = True, time.perf_counter()
        saved = begun
        meter = Meter(source.statistics())
        source.start()
        meter.add_wait(meter.seconds)
        self.part("learning", self.share(steps))
        while (share := self.share(steps)) < 1.0:
            if stop():
                raise KeyboardInterrupt
            requested = time.perf_counter()
            batch, encoding = prefetcher.draw()
            meter.add_wait(time.perf_counter() - requested)
            meter.add_step(self.learner.learn(source, batch, share, self.generator, encoding), len(batch.rows))
            if first and self.budget is not None:  # it has compiled and loaded kernels, which is not learning
                begun = time.perf_counter()
                self.length = before + self.budget.learning(before)
            first = False
            self.seconds = before + time.perf_counter() - begun
            if meter.seconds > self.learning.report_every:
                self._report(meter, self.share(steps), source, progress)
                meter = Meter(source.statistics())
            if output is not None and time.perf_counter() - saved > self.learning.checkpoint_every:
                self.save(output)
                saved = time.perf_counter()
        self.learner.check(source)
        if not meter.empty:
            self._report(meter, 1.0, source, progress)

    def share(self, steps: int | None) -> float:
        """The share of the run that is over, by steps if given, else by time."""
        if steps is not None:
            return self.learner.step / steps
        return self.seconds / self.length if self.length > 0.0 else 1.0

    def _report(self, meter: Meter, share: float, source: RowSource, progress: Progress | None) -> None:
        validation = self.reference.relative_rmse(self.learner.model)
        consumed = self.learner.step * self.learning.batch
        report = meter.progress(self.seconds, self.learner.step, share, consumed, source.statistics(), validation)
        self.history.append(report)
        if progress is not None:
            progress(report)

    def save(self, output: str | Path) -> None:
        """Write the model and its checkpoint."""
        assert self.source is not None
        self.learner.check(self.source)
        save_model(self.learner.model, output)
        write_state(output, self.state())

    def finish(self, output: str | Path | None) -> NeuralBSSRDF:
        """Round the weights, measure the final errors unless the run was stopped, and write the model.

        A KeyboardInterrupt ends the measurement alone.
        """
        assert self.source is not None
        if output is not None:  # measuring takes long and may be interrupted
            self.save(output)
        network = self.learner.result()
        training: dict[str, Any] = {
            "seconds": self.seconds,
            "steps": self.learner.step,
            "walks": self.source.statistics().walks,
            "seed": self.seed,
            "learning": asdict(self.learning),
            "precision": "bfloat16" if self.learner.bfloat16 else "float32",
            "device": _name_of(network.frequencies.device),
            **self.data.description(),
            "validation_vs_time": [
                [report.seconds, report.walks, report.validation] for report in every_tenth(self.history)
            ],
            "validation_of": self.reference.quantity,
        }
        network.metadata["training"] = training
        try:
            training |= {} if self.stopped else self._errors(network)
        except KeyboardInterrupt:
            self.stopped = True
        training["stopped"] = self.stopped
        if output is not None:
            save_model(network, output)
        return network

    def _errors(self, network: NeuralBSSRDF) -> dict[str, Any]:
        """The final errors."""
        seconds = math.inf if self.budget is None else self.budget.figures()
        follow = partial(self.part, "final errors")
        follow(0.0)
        return self.data.errors(network, self.learning, seconds, follow)


def _name_of(device: torch.device) -> str:
    """The name of the GPU that learned, or "cpu"."""
    return str(torch.cuda.get_device_name(device)) if device.type == "cuda" else device.type


def _settings_for(settings: NetworkSettings, scene: Scene) -> NetworkSettings:
    """The settings without inputs that are useless for the scene.

    The normal is useless where the boundary does not bend light. Refracted rays are useless where they hardly ever
    reach the other side. Lobes are useless where hardly any light crosses unscattered, and where a smooth interface
    excludes that light from Ŝ.
    """
    if is_unrefracted(scene):
        return replace(settings, tells_normal=False, interfaces=0, lobes=0)
    if not is_clear(scene, box_of(scene)):
        return replace(settings, interfaces=0, lobes=0)
    return settings if interface_kind(scene) == ROUGH else replace(settings, lobes=0)


def _metadata(scene: Scene) -> dict[str, Any]:
    return {
        "scene": Path(scene.path).name,
        "scene_hash": scene.content_hash,
        "up": scene.up,
        "unit": scene.unit,
        "eta": float(scene.eta),
        "roughness": float(np.mean(scene.roughness)),
        "normals": scene.normals,
    }
