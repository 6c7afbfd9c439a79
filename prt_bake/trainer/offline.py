"""Training data from a file of samples, split into training, validation and test sets.

A hash of its key assigns each query to a set: 5 % validate, 5 % test, the others train. A query is in the same set in
every run and in every file that contains it.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.atomic import sha256
from formats.errors import SamplesError
from formats.samples import Samples, read_samples
from formats.scene import Scene
from prt_bake.mathematics.random import uniforms
from prt_bake.network.model import TrainableModel
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.cores import alternating_threads
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.references import Follow
from prt_bake.trainer.samples.queries import Queries
from prt_bake.trainer.samples.repeatable import ShuffledRows
from prt_bake.trainer.samples.rows import Batch, Box, RowSource, SourceStatistics, build_batch
from prt_bake.trainer.samples.traced import TracedQueries
from prt_bake.trainer.training_data import box_of
from prt_bake.trainer.validation import HeldOut, Reference, final_errors, relative_noise

VALIDATION_SHARE, TEST_SHARE = 0.05, 0.05
_SPLIT_STREAM = 0x5B


class Split(NamedTuple):
    """Masks [N] of the samples that train, validate and test."""

    learning: NDArray[np.bool_]
    validation: NDArray[np.bool_]
    test: NDArray[np.bool_]


def split_by_key(keys: NDArray[np.uint64]) -> Split:
    """The set of each query, from its key alone."""
    u = _uniform(keys)
    validation = u < VALIDATION_SHARE
    test = ~validation & (u < VALIDATION_SHARE + TEST_SHARE)
    return Split(~validation & ~test, validation, test)


def _uniform(keys: NDArray[np.uint64]) -> NDArray[np.float64]:
    return uniforms((_SPLIT_STREAM, keys), 1)[..., 0]


class SampleFileData:
    """The samples of a file, held in memory."""

    def __init__(self, scene: Scene, path: str | Path, seed: int, synchronous: bool) -> None:
        """Read and split the file.

        Raises SamplesError if the file is damaged, belongs to another scene or is too short to split, and QueryError if
        its positions are not on the scene's surface.
        """
        self.on_gpu = False
        self.scene, self.box = scene, box_of(scene)
        self._path, self._seed, self._synchronous = Path(path), seed, synchronous
        self._samples = read_samples(path)
        if self._samples.head.scene_hash != scene.content_hash:
            raise SamplesError(
                f"{path}: was sampled from another scene ({self._samples.head.scene}, or it changed since); "
                f"sample {Path(scene.path).name} again"
            )
        self._split = split_by_key(self._samples.keys)
        self.resume_settings = {"synchronous": synchronous, "samples": sha256(path)}
        for name, chosen in self._split._asdict().items():
            if not chosen.any():
                raise SamplesError(
                    f"{path}: none of its {len(chosen)} queries is left for {name} (5 % validate, 5 % test); "
                    "sample at least some hundreds"
                )

    def reference(self, learning: LearningSettings, seconds: float, follow: Follow) -> Reference:
        """The validation samples, at most `held_out_queries`; the choice depends on their keys alone."""
        chosen = np.flatnonzero(self._split.validation)
        order = np.argsort(_uniform(self._samples.keys[chosen]), kind="stable")
        return self._held_out(chosen[order[: learning.held_out_queries]])

    def source(self, learning: LearningSettings, network: TrainableModel, state: dict[str, int] | None) -> RowSource:
        """Passes over the training samples, each in a different order."""
        return FileRows(self._samples, np.flatnonzero(self._split.learning), self.box, self._path, self._seed, state)

    def learner_threads(self, learning: LearningSettings, device: str) -> int:
        """Half of the cores; one thread for synchronous runs, where the rounding of sums must not vary."""
        return 1 if self._synchronous or device != "cpu" else alternating_threads().learner

    def description(self) -> dict[str, Any]:
        """The file and the size of each set."""
        return {
            "samples": {
                "file": self._path.name,
                "complete": self._samples.complete,
                "walks_a_query": self._samples.head.walks,
                "directions": self._samples.head.directions,
                **{f"{name}_queries": int(chosen.sum()) for name, chosen in self._split._asdict().items()},
            }
        }

    def errors(
        self, network: TrainableModel, learning: LearningSettings, seconds: float, follow: Follow
    ) -> dict[str, Any]:
        """The errors on the test samples and on fresh queries."""
        test = self._held_out(np.flatnonzero(self._split.test))
        count, walks = learning.held_out_queries, learning.held_out_walks
        fresh = final_errors(network, self.scene, count, walks, seconds=seconds, follow=follow)
        return {
            "test_relative_rmse": {"transport": test.relative_rmse(network), "transport_noise": relative_noise(test)},
            "relative_rmse": asdict(fresh),
        }

    def _held_out(self, chosen: NDArray[np.int64]) -> HeldOut:
        samples = self._samples
        return HeldOut(
            self._queries(chosen),
            samples.mean[chosen].astype(np.float64),
            samples.standard_error[chosen].astype(np.float64),
        )

    def _queries(self, chosen: NDArray[np.int64]) -> Queries:
        samples = self._samples
        positions, outgoing = samples.positions[chosen], samples.outgoing[chosen].astype(np.float64)
        location, _cosine = prepare(self.scene).surface.choose(positions, outgoing)
        return Queries(samples.keys[chosen], positions, outgoing, samples.incident[chosen].astype(np.float64), location)


class FileRows:
    """Training rows of a file's samples, in repeated passes."""

    exits = False
    traced: TracedQueries | None = None

    def __init__(
        self,
        samples: Samples,
        chosen: NDArray[np.int64],
        box: Box,
        path: Path,
        seed: int,
        state: dict[str, int] | None = None,
    ) -> None:
        """Rows of the samples `chosen`, numbered by their index in the file, continued from `state` if given."""
        self._batch = _rows(samples, chosen, box)
        self._path = path
        self._statistics = SourceStatistics(len(chosen) * samples.head.walks, len(self._batch.rows), 0.0)
        drawn = 0 if state is None else state["drawn"]
        self._shuffled = ShuffledRows(lambda _block: self._batch, len(self._batch.rows), None, seed, drawn)

    def start(self) -> None:
        """Do nothing: rows can be drawn at once."""

    def stop(self) -> None:
        """Do nothing: no thread runs beside the learner."""

    def draw(self, count: int) -> Batch:
        """The next `count` rows."""
        return self._shuffled.draw(count)

    def describe(self, number: int) -> str:
        """A query's number and file, for messages."""
        return f"query {number} of {self._path.name}"

    def statistics(self) -> SourceStatistics:
        """The walks and rows of the training set."""
        return self._statistics

    def state(self) -> dict[str, int]:
        """State to continue from."""
        return {"drawn": self._shuffled.drawn}


def _rows(samples: Samples, chosen: NDArray[np.int64], box: Box) -> Batch:
    return build_batch(
        chosen,
        samples.positions[chosen],
        samples.outgoing[chosen],
        samples.incident[chosen],
        samples.mean[chosen],
        box,
    )
