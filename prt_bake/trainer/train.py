"""`train`: fits a network to a scene, until the time or the steps are used up.

Loss: squared error (the paper's L2) of Ŝ in units of the network's output scale, or from walks' exits behind a smooth
interface (`prt_bake.trainer.objective`). AdamW, a rate that falls along a cosine to zero, weights averaged over the
last part of the run, and matrix work in bfloat16 with float32 weights where the processor is faster in it.
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, save_model
from prt_bake.tracer.prepared import interface_kind, is_unbent
from prt_bake.tracer.surface.interface import ROUGH
from prt_bake.trainer.cores import select_device
from prt_bake.trainer.history import Meter, TrainingProgress, every_tenth
from prt_bake.trainer.interior import interior_of, is_clear, with_fitting_grid
from prt_bake.trainer.learner import Learner, LearningSettings
from prt_bake.trainer.offline import SampleFileData
from prt_bake.trainer.prefetch import Prefetcher
from prt_bake.trainer.resume import read_state, require_state, write_state
from prt_bake.trainer.samples.rows import RowSource, StreamSettings
from prt_bake.trainer.scene_remarks import training_warning
from prt_bake.trainer.training_data import PathTracedData, TrainingData, box_of

__all__ = ["LearningSettings", "TrainingProgress", "train"]

Progress = Callable[[TrainingProgress], None]
QUANTITIES = {"transport": "the transport function", "coefficients": "the coefficients a_lm over the surface"}
"""What a training is watched by, in words."""


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
    stream: StreamSettings | None = None,
    learning: LearningSettings | None = None,
) -> NeuralBSSRDF:
    """Train a neural BSSRDF of a scene for `minutes`, or for `steps` where given, and return it with its final figures.

    `settings` are those of the preset "measured", with `seed`, unless given; `PRESETS["paper"]` is the paper's network.
    `minutes` and `steps` count from the very beginning, resumed or not. `say` is told what goes on before and after.
    `device` is "auto" (a graphics card where there is one), "cpu" or "cuda". The figures (relative RMSE of Ŝ and of
    a_lm on fresh queries, reference noise taken out) stand in `network.metadata["training"]`.

    Renderer and learner run side by side; with `synchronous` they take turns, and `steps`, `seed` and the settings
    decide every bit of the weights, whatever the number of cores, resumed or not; matrix work is in float32 then. With
    `samples` (`record_samples`) nothing is walked while learning: the file is learnt from again and again, but for what
    validates and tests. With `output` the model is written there once a minute and at the end, beside it what `resume`
    needs. A KeyboardInterrupt ends the training early and keeps what was learnt.

    Raises QueryError for a time that is not positive, for `synchronous` without `steps`, and where the loss stops being
    finite, naming the query; SamplesError for a file that is damaged or of another scene.
    """
    refuse_path("scene", scene, "prt.load_scene")
    if minutes <= 0 or (steps is not None and steps < 1):
        raise QueryError(f"train: minutes {minutes:g} and steps {steps} where positive ones are expected")
    if synchronous and steps is None:
        raise QueryError("train: synchronous needs steps: what fits into minutes is never the same twice")
    if resume:
        if output is None:
            raise QueryError("train: resume needs the output that it goes on from")
        require_state(output)
    tell = say or (lambda sentence: None)
    if remark := training_warning(scene):
        tell(f"{scene.path}: {remark}")
    material: TrainingData
    if samples is not None:
        tell(f"reading {samples}")
        material = SampleFileData(scene, samples, seed, synchronous)
    else:
        tell("path tracing the queries that the training is measured by")
        material = PathTracedData(scene, stream or StreamSettings(), seed, synchronous)
    run = _Run(
        material,
        _as_the_scene_needs(settings or replace(PRESETS["measured"], seed=seed), scene),
        learning or LearningSettings(),
        select_device(device),
        seed,
    )
    if resume:
        assert output is not None
        run.restore(output)
        if run.share(minutes * 60.0, steps) >= 1.0:
            tell(
                f"{output}: nothing is left to learn: it had {run.learner.step} steps in {run.seconds / 60.0:.3g} "
                "minutes already, and what is asked for counts from the very beginning; ask for more"
            )
    tell(f"learning; the validation error is that of {QUANTITIES[run.reference.of]}")
    run.learn(minutes * 60.0, steps, output, progress)
    tell("path tracing fresh queries for the final figures")
    return run.finish(output)


class _Run:
    """One training run: what is learnt from, who learns, and how far they have come."""

    def __init__(
        self, material: TrainingData, settings: NetworkSettings, learning: LearningSettings, device: str, seed: int
    ) -> None:
        self.material, self.learning, self.seed = material, learning, seed
        self.scene = material.scene
        box = material.box
        interior = interior_of(self.scene, box) if settings.ray_samples else None
        settings = settings if interior is None else with_fitting_grid(settings, interior)
        network_begun = {f"network {name}": value for name, value in settings.as_json().items()}
        told = "" if interior is None else interior.content_hash
        self.begun = {**network_begun, "interior": told, "seed": seed, **material.begun}
        self.reference = material.reference(learning)
        network = NeuralBSSRDF(
            settings, box.corner, box.side, self.reference.scale() or 1.0, _metadata(self.scene), interior
        ).to(device)
        network = network.on(self.scene.mesh)
        # what a processor is faster in is measured, and no clock may decide the bits of a synchronous run
        steady = replace(learning, bfloat16=False) if self.begun["synchronous"] else learning
        self.learner = Learner(network, steady)
        self.generator = np.random.default_rng(seed)
        self.seconds = 0.0
        self.source: RowSource | None = None
        self.source_state: dict[str, int] | None = None
        self.history: list[TrainingProgress] = []

    def restore(self, output: str | Path) -> None:
        """Take up where the checkpoint beside `output` was written."""
        state = read_state(output, self.scene.content_hash, self.begun)
        for network in (self.learner.network, self.learner.answer):
            network.output_scale = float(state["output_scale"])
        self.learner.restore(state["learner"])
        self.generator.bit_generator.state = json.loads(state["generator"])
        self.seconds, self.source_state = float(state["seconds"]), dict(state["source"])
        self.history = [TrainingProgress(**row) for row in state["history"]]

    def state(self) -> dict[str, Any]:
        """What `restore` needs, plain values and tensors."""
        assert self.source is not None
        return {
            "scene": self.scene.content_hash,
            "begun": self.begun,
            "output_scale": self.learner.network.output_scale,
            "learner": self.learner.state(),
            "generator": json.dumps(self.generator.bit_generator.state),
            "source": self.source.state(),
            "seconds": self.seconds,
            "history": [asdict(row) for row in self.history],
        }

    def learn(self, seconds: float, steps: int | None, output: str | Path | None, progress: Progress | None) -> None:
        """Learn until the time or the steps are used up, or until Ctrl-C."""
        device = self.learner.network.frequencies.device.type
        self.source = self.material.source(self.learning, device, self.source_state)
        threads = torch.get_num_threads()
        learning = self.material.learning_threads(self.learning, device)
        beside = 0 if self.begun["synchronous"] or device != "cpu" else learning
        ahead = Prefetcher(self.source, self.learner, self.generator, beside)
        torch.set_num_threads(learning)
        try:
            self._learn(self.source, ahead, seconds, steps, output, progress)
        except KeyboardInterrupt:
            pass
        finally:
            self.source.stop()
            ahead.stop()
            torch.set_num_threads(threads)

    def _learn(
        self,
        source: RowSource,
        ahead: Prefetcher,
        seconds: float,
        steps: int | None,
        output: str | Path | None,
        progress: Progress | None,
    ) -> None:
        before = self.seconds
        begun = saved = time.perf_counter()
        meter = Meter(source.done())
        source.start()
        meter.add_wait(meter.seconds)
        while (share := self.share(seconds, steps)) < 1.0:
            asked = time.perf_counter()
            batch, told = ahead.draw()
            meter.add_wait(time.perf_counter() - asked)
            meter.add_step(self.learner.learn(source, batch, share, self.generator, told), len(batch.rows))
            self.seconds = before + time.perf_counter() - begun
            if meter.seconds > self.learning.report_every:
                self._report(meter, self.share(seconds, steps), source, progress)
                meter = Meter(source.done())
            if output is not None and time.perf_counter() - saved > self.learning.checkpoint_every:
                self.save(output)
                saved = time.perf_counter()
        if not meter.empty:
            self._report(meter, 1.0, source, progress)

    def share(self, seconds: float, steps: int | None) -> float:
        """How much of the time or of the steps is used up."""
        return self.learner.step / steps if steps is not None else self.seconds / seconds

    def _report(self, meter: Meter, share: float, source: RowSource, progress: Progress | None) -> None:
        validation = self.reference.relative_rmse(self.learner.answer)
        learnt = self.learner.step * self.learning.batch
        row = meter.row(self.seconds, self.learner.step, share, learnt, source.done(), validation)
        self.history.append(row)
        if progress is not None:
            progress(row)

    def save(self, output: str | Path) -> None:
        """Write the model, and beside it what `resume` needs."""
        save_model(self.learner.answer, output)
        write_state(output, self.state())

    def finish(self, output: str | Path | None) -> NeuralBSSRDF:
        """Round the weights, measure the final figures, note them in the model and write it."""
        assert self.source is not None
        if output is not None:  # before what takes long
            self.save(output)
        network = self.learner.answer.eval().rounded()
        network.metadata["training"] = {
            "seconds": self.seconds,
            "steps": self.learner.step,
            "walks": self.source.done().walks,
            "seed": self.seed,
            "learning": asdict(self.learning),
            "precision": "bfloat16" if self.learner.bfloat16 else "float32",
            **self.material.figures(network, self.learning),
            "validation_vs_time": [[row.seconds, row.walks, row.validation] for row in every_tenth(self.history)],
            "validation_of": self.reference.of,
        }
        if output is not None:
            save_model(network, output)
        return network


def _as_the_scene_needs(settings: NetworkSettings, scene: Scene) -> NetworkSettings:
    """The settings as they are, but for what would say nothing: the normal where light leaves unbent, rays that turn
    where they hardly reach the other side, and lobes of what crosses unscattered where hardly anything does, or where
    a smooth interface keeps it out of Ŝ.
    """
    if is_unbent(scene):
        return replace(settings, tells_normal=False, ray_turns=0, lobes=0)
    if not is_clear(scene, box_of(scene)):
        return replace(settings, ray_turns=0, lobes=0)
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
