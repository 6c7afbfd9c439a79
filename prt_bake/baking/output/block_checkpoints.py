"""Checkpoints of a bake with fixed samples: finished blocks, from which a stopped or killed bake resumes."""

from dataclasses import astuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block, Task, cuts
from bakers.path_traced import WalkStatistics
from formats.asset.error_covariance import ErrorCovariance
from prt_bake.baking.output.checkpoint_store import CheckpointStore

Cut = tuple[int, int]
"""The first vertex of a block, and the one after its last."""

_STAGE = "block-"


class BlockCheckpoints:
    """Blocks by their vertices; without a store nothing is kept."""

    def __init__(self, store: CheckpointStore | None) -> None:
        self._store = store

    @property
    def finished(self) -> list[Cut]:
        """The blocks of an earlier run."""
        return [] if self._store is None else [_cut(name) for name in self._store.names(_STAGE)]

    def cuts(self, task: Task, vertices: NDArray[np.int64]) -> list[Cut]:
        """The finished blocks of these vertices and blocks of all others, in order."""
        finished = self.finished
        done = [vertices[(vertices >= first) & (vertices < last)] for first, last in finished]
        missing = np.setdiff1d(vertices, np.concatenate([vertices[:0], *done]))
        return sorted(finished + cuts(task, missing))

    def write(self, block: Block) -> None:
        """Stores a block."""
        if self._store is not None:
            name = _name(block.first_vertex, block.first_vertex + len(block.valid))
            self._store.write(name, as_arrays(block))

    def read(self, cut: Cut) -> Block | None:
        """A finished block; None if it is missing or damaged."""
        arrays = None if self._store is None else self._store.read(_name(*cut))
        if arrays is None:
            return None
        parts = arrays["coefficients"], arrays["standard_error"], arrays["valid"], int(arrays["clamped"])
        statistics = _statistics(arrays["statistics"]) if "statistics" in arrays else None
        errors = ErrorCovariance(arrays["covariance"], arrays["channels"], arrays["apart"])
        return Block(cut[0], *parts, statistics, int(arrays["extra_evaluations"]), error_covariance=errors)


def as_arrays(block: Block) -> dict[str, NDArray[Any]]:
    """The arrays that a checkpoint of the block holds."""
    arrays: dict[str, NDArray[Any]] = {
        "coefficients": block.coefficients,
        "standard_error": block.standard_error,
        "valid": block.valid,
        "clamped": np.asarray(block.clamped),
        "extra_evaluations": np.asarray(block.extra_evaluations),
    }
    if block.error_covariance is not None:
        arrays |= {name: getattr(block.error_covariance, name) for name in ("covariance", "channels", "apart")}
    if block.statistics is not None:
        arrays["statistics"] = np.array(astuple(block.statistics), np.float64)
    return arrays


def _statistics(numbers: NDArray[np.float64]) -> WalkStatistics:
    bins, clamped, unreliable = (int(number) for number in numbers[:3])
    return WalkStatistics(bins, clamped, unreliable, *(float(number) for number in numbers[3:]))


def _name(first: int, last: int) -> str:
    return f"{_STAGE}{first}-{last}"


def _cut(name: str) -> Cut:
    first, last = name.removeprefix(_STAGE).split("-")
    return int(first), int(last)
