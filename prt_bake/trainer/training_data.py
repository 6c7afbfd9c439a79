"""Sources of training data: the protocol, and walks that are traced while the network learns."""

import math
from dataclasses import asdict, replace
from typing import Any, Literal, Protocol

from formats.scene import Scene
from prt_bake.network.model import TrainableModel
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.cores import alternating_threads, available_cores, concurrent_threads
from prt_bake.trainer.learning.learner import LearningSettings, continued
from prt_bake.trainer.references import Follow
from prt_bake.trainer.samples.repeatable import AlternatingRenderer
from prt_bake.trainer.samples.rows import Box, RowSource, RowTracer, StreamSettings, row_tracer
from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.validation import Reference, final_errors, validation_reference

_FIRST_FILL = 16
"""Batches in the buffer before the learner starts."""
_PATHS_A_CORE = 4
"""Most paths per query for each core of a processor with many, whose renderer is faster than the learner."""


class TrainingData(Protocol):
    """Rows to learn from, and references to validate and test with."""

    scene: Scene
    box: Box
    on_gpu: bool
    """Whether rows are made on a GPU."""
    resume_settings: dict[str, Any]
    """Settings that a resumed run must share with the run that it continues."""

    def reference(self, learning: LearningSettings, seconds: float, follow: Follow) -> Reference:
        """The reference of the validation error during the run, path traced for at most `seconds`."""

    def source(self, learning: LearningSettings, network: TrainableModel, state: dict[str, int] | None) -> RowSource:
        """The source of training rows for the network, continued from `state` if given."""

    def learner_threads(self, learning: LearningSettings, device: str) -> int:
        """Threads that the learner may use."""

    def description(self) -> dict[str, Any]:
        """Entries of the model's metadata: the data that it learned from."""

    def errors(
        self, network: TrainableModel, learning: LearningSettings, seconds: float, follow: Follow
    ) -> dict[str, Any]:
        """Entries of the model's metadata: its final errors, measured for at most `seconds`."""


class PathTracedData:
    """Walks in the scene, traced while the network learns."""

    def __init__(
        self, scene: Scene, stream: StreamSettings, seed: int, synchronous: bool, device: Literal["cpu", "cuda"] = "cpu"
    ) -> None:
        """Walks run on `device`. On the processor renderer and learner take turns if `synchronous`, otherwise they run
        concurrently.
        """
        self.scene, self.box = scene, box_of(scene)
        fixed = {f"stream {name}": value for name, value in asdict(stream).items()} if synchronous else {}
        self.resume_settings = {"synchronous": synchronous, "samples": "", **fixed}
        self._stream, self._seed, self._synchronous, self._device = stream, seed, synchronous, device
        self.on_gpu = device == "cuda"
        prepare(scene)  # raises for bad scenes

    def reference(self, learning: LearningSettings, seconds: float, follow: Follow) -> Reference:
        """Path-traced queries of a separate seed."""
        count, walks = learning.held_out_queries, learning.held_out_walks
        return validation_reference(self.scene, count, walks, self._device, seconds, follow)

    def source(self, learning: LearningSettings, network: TrainableModel, state: dict[str, int] | None) -> RowSource:
        """A renderer whose kernel is compiled."""
        if self.on_gpu:
            from prt_bake.network.bssrdf import NeuralBSSRDF
            from prt_bake.trainer.gpu.renderer import compiled_renderer

            assert isinstance(network, NeuralBSSRDF)
            paths = network.packed_paths
            return compiled_renderer(self.scene, self.box, self._stream, self._seed, learning.batch, paths, state)
        row_tracer(self.scene, self.box, self._stream, self._seed).render(0, 1)
        tracer: RowTracer = row_tracer(self.scene, self.box, self._stream, self._seed)
        if self._synchronous:
            return AlternatingRenderer(tracer, self._stream, alternating_threads().renderer, self._seed, state)
        device = network.box_min.device.type
        threads = concurrent_threads(device).renderer
        reuse = self._stream.reuse if device == "cpu" else math.inf
        return BackgroundRenderer(tracer, self._stream, threads, _FIRST_FILL * learning.batch, state, reuse)

    def learner_threads(self, learning: LearningSettings, device: str) -> int:
        """One thread for synchronous runs: the rounding of sums depends on the number of threads."""
        return 1 if self._synchronous else concurrent_threads(device).learner

    def description(self) -> dict[str, Any]:
        """The renderer's settings."""
        return {"stream": asdict(self._stream)}

    def errors(
        self, network: TrainableModel, learning: LearningSettings, seconds: float, follow: Follow
    ) -> dict[str, Any]:
        """Errors on fresh queries."""
        count, walks = learning.held_out_queries, learning.held_out_walks
        found = final_errors(network, self.scene, count, walks, self._device, seconds, follow)
        return {"relative_rmse": asdict(found)}


def box_of(scene: Scene) -> Box:
    """The box of the scene's outermost mesh."""
    low, high = scene.mesh.positions.min(axis=0), scene.mesh.positions.max(axis=0)
    return Box(low, float((high - low).max()))


def stream_for(device: str, synchronous: bool = True) -> StreamSettings:
    """The renderer's settings for the device that path traces. Synchronous runs are the same on any processor."""
    if device == "cpu":
        few = StreamSettings()
        return few if synchronous else replace(few, exits=max(few.exits, _PATHS_A_CORE * available_cores()))
    from prt_bake.trainer.gpu.renderer import GPU_STREAM

    return GPU_STREAM


def learning_for(data: TrainingData, started: bool = False) -> LearningSettings:
    """The learner's settings for the device that path traces; `started`: for weights of an earlier training."""
    settings = LearningSettings()
    if data.on_gpu:
        from prt_bake.trainer.gpu.learner import GPU_LEARNING

        settings = GPU_LEARNING
    return continued(settings) if started else settings
