"""What a training run learns from and is measured by; here walks of a scene, beside the learner or in turns with it."""

import math
from dataclasses import asdict
from typing import Any, Protocol

from formats.scene import Scene
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.tracer.prepared import PreparedScene, prepare
from prt_bake.trainer.cores import divided, undivided
from prt_bake.trainer.learner import LearningSettings
from prt_bake.trainer.samples.repeatable import AlternatingRenderer
from prt_bake.trainer.samples.rows import Box, RowSource, RowTracer, StreamSettings, row_tracer
from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.validation import Reference, final_errors, validation_reference

_FIRST_FILL = 16
"""Batches that the buffer holds before the learner draws from it."""


class TrainingData(Protocol):
    """What a training run learns from and is measured by."""

    scene: Scene
    box: Box
    begun: dict[str, Any]
    """What a resumed run must share with the one that it goes on from."""

    def reference(self, learning: LearningSettings) -> Reference:
        """What the run is watched by."""

    def source(self, learning: LearningSettings, device: str, state: dict[str, int] | None) -> RowSource:
        """Where the rows come from, from `state` on."""

    def learning_threads(self, learning: LearningSettings, device: str) -> int:
        """Threads that may learn."""

    def figures(self, network: NeuralBSSRDF, learning: LearningSettings) -> dict[str, Any]:
        """What the trained network's metadata say of its errors and of what it learnt from."""


class PathTracedData:
    """Walks of a scene, made while the learner learns."""

    def __init__(self, scene: Scene, stream: StreamSettings, seed: int, synchronous: bool) -> None:
        """With `synchronous` renderer and learner take turns."""
        self.scene, self.box = scene, box_of(scene)
        asked = {f"stream {name}": value for name, value in asdict(stream).items()} if synchronous else {}
        self.begun = {"synchronous": synchronous, "samples": "", **asked}
        self._stream, self._seed, self._synchronous = stream, seed, synchronous
        self._prepared: PreparedScene = prepare(scene)

    def reference(self, learning: LearningSettings) -> Reference:
        """Queries of a seed of their own."""
        return validation_reference(self.scene, self._prepared, learning.held_out_queries, learning.held_out_walks)

    def source(self, learning: LearningSettings, device: str, state: dict[str, int] | None) -> RowSource:
        """A renderer, its kernel compiled."""
        walks: RowTracer = row_tracer(self.scene, self._prepared, self.box, self._stream, self._seed)
        walks.render(0, 1)
        if self._synchronous:
            return AlternatingRenderer(walks, self._stream, undivided().walkers, self._seed, state)
        threads = divided(learning.core_share, device).walkers
        reuse = self._stream.reuse if device == "cpu" else math.inf
        return BackgroundRenderer(walks, self._stream, threads, _FIRST_FILL * learning.batch, state, reuse)

    def learning_threads(self, learning: LearningSettings, device: str) -> int:
        """One where every bit counts: sums depend on how they are shared out."""
        return 1 if self._synchronous else divided(learning.core_share, device).learners

    def figures(self, network: NeuralBSSRDF, learning: LearningSettings) -> dict[str, Any]:
        """Errors on fresh queries, and how the renderer asked."""
        final = final_errors(network, self.scene, self._prepared, learning.held_out_queries, learning.held_out_walks)
        return {"stream": asdict(self._stream), "relative_rmse": final.as_json()}


def box_of(scene: Scene) -> Box:
    """The box of the scene's outermost mesh."""
    low, high = scene.mesh.positions.min(axis=0), scene.mesh.positions.max(axis=0)
    return Box(low, float((high - low).max()))
