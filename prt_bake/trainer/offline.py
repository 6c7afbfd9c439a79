"""Learning from a file of samples: what is learnt from, what watches, and what tests in the end.

A query's side is decided by a hash of its key: 5 in 100 validate, 5 in 100 test, the others are learnt from. It stays
on its side in every file that holds it, however long and in whatever order, and in every run.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.atomic import sha256
from formats.errors import SamplesError
from formats.samples import Samples, read_samples
from formats.scene import Scene
from prt_bake.mathematics.random import uniforms
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.cores import undivided
from prt_bake.trainer.learner import LearningSettings
from prt_bake.trainer.samples.queries import Queries
from prt_bake.trainer.samples.repeatable import ShuffledRows
from prt_bake.trainer.samples.rows import Batch, Box, RowSource, SourceStatistics, build_batch
from prt_bake.trainer.training_data import box_of
from prt_bake.trainer.validation import HeldOut, Reference, final_errors

VALIDATION_SHARE, TEST_SHARE = 0.05, 0.05
_SPLIT_STREAM = 0x5B


class Split(NamedTuple):
    """Which samples [N] are learnt from, which validate, which test."""

    learning: NDArray[np.bool_]
    validation: NDArray[np.bool_]
    test: NDArray[np.bool_]


def split_by_key(keys: NDArray[np.uint64]) -> Split:
    """The side of each query, by its key alone."""
    place = _place(keys)
    validation = place < VALIDATION_SHARE
    test = ~validation & (place < VALIDATION_SHARE + TEST_SHARE)
    return Split(~validation & ~test, validation, test)


def _place(keys: NDArray[np.uint64]) -> NDArray[np.float64]:
    return uniforms((_SPLIT_STREAM, keys), 1)[..., 0]


class SampleFileData:
    """The samples of a file, all in memory."""

    def __init__(self, scene: Scene, path: str | Path, seed: int, synchronous: bool) -> None:
        """Read and split the file.

        Raises SamplesError where it is damaged, of another scene, or too short to be split; QueryError where its
        positions do not lie on the scene's surface.
        """
        self.scene, self.box = scene, box_of(scene)
        self._path, self._seed, self._synchronous = Path(path), seed, synchronous
        self._samples = read_samples(path)
        if self._samples.head.scene_hash != scene.content_hash:
            raise SamplesError(
                f"{path}: was sampled from another scene ({self._samples.head.scene}, or it changed since); "
                f"sample {Path(scene.path).name} anew"
            )
        self._sides = split_by_key(self._samples.keys)
        self.begun = {"synchronous": synchronous, "samples": sha256(path)}
        for name, side in self._sides._asdict().items():
            if not side.any():
                raise SamplesError(
                    f"{path}: of its {len(side)} queries none is left for {name} (5 in 100 validate, 5 test); "
                    "sample some hundreds at least"
                )

    def reference(self, learning: LearningSettings) -> Reference:
        """The validating samples, or as many as are asked for, always the same ones."""
        chosen = np.flatnonzero(self._sides.validation)
        order = np.argsort(_place(self._samples.keys[chosen]), kind="stable")
        return self._held_out(chosen[order[: learning.held_out_queries]])

    def source(self, learning: LearningSettings, device: str, state: dict[str, int] | None) -> RowSource:
        """Passes over the samples that are learnt from, each in an order of its own."""
        return FileRows(self._samples, np.flatnonzero(self._sides.learning), self.box, self._path, self._seed, state)

    def learning_threads(self, learning: LearningSettings, device: str) -> int:
        """Half of the cores; one where every bit counts."""
        return 1 if self._synchronous or device != "cpu" else undivided().learners

    def figures(self, network: NeuralBSSRDF, learning: LearningSettings) -> dict[str, Any]:
        """The error on the testing samples, never looked at before, and on fresh queries."""
        test = self._held_out(np.flatnonzero(self._sides.test))
        noise = np.sqrt(np.sum(test.standard_error**2) / max(float(np.sum(test.mean**2)), 1e-300))
        fresh = final_errors(
            network, self.scene, prepare(self.scene), learning.held_out_queries, learning.held_out_walks
        )
        return {
            "samples": {
                "file": self._path.name,
                "complete": self._samples.complete,
                "walks_a_query": self._samples.head.walks,
                "directions": self._samples.head.directions,
                **{f"{name}_queries": int(side.sum()) for name, side in self._sides._asdict().items()},
            },
            "test_relative_rmse": {"transport": test.relative_rmse(network), "transport_noise": float(noise)},
            "relative_rmse": fresh.as_json(),
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
    """Rows of a file's samples, passed over again and again."""

    exits = False

    def __init__(
        self,
        samples: Samples,
        chosen: NDArray[np.int64],
        box: Box,
        path: Path,
        seed: int,
        state: dict[str, int] | None = None,
    ) -> None:
        """Rows of the `chosen` samples, numbered by their place in the file; `state` is another's, to go on."""
        self._batch = _rows(samples, chosen, box)
        self._path = path
        self._done = SourceStatistics(len(chosen) * samples.head.walks, len(self._batch.rows), 0.0)
        drawn = 0 if state is None else state["drawn"]
        self._shuffled = ShuffledRows(lambda block: self._batch, len(self._batch.rows), None, seed, drawn)

    def start(self) -> None:
        """Nothing to wait for."""

    def stop(self) -> None:
        """Nothing goes on beside the learner."""

    def draw(self, count: int, generator: np.random.Generator) -> Batch:
        """The next `count` rows; the generator is left alone."""
        return self._shuffled.draw(count)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return f"query {number} of {self._path.name}"

    def done(self) -> SourceStatistics:
        """The walks and rows that the file has to learn from."""
        return self._done

    def state(self) -> dict[str, int]:
        """What it takes to go on from here."""
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
