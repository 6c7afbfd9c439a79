"""Checkpoints of an adaptive pass: its blocks, its settings and its result."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import RefinedBlock
from formats.errors import StorageError
from prt_bake.baking.adaptive.pass_settings import LATTICES, Pass, PassSettings
from prt_bake.baking.output.checkpoint_store import CheckpointStore

ClampedBlock = tuple[RefinedBlock, int]
"""A block and the number of its bins that were clamped to the horizon."""

DONE = "done-"
"""Prefix of the names of results of complete passes."""
EVALUATED = "evaluated-"
"""Prefix of the names of blocks that hold only the vertices from which others are interpolated."""


@dataclass(frozen=True)
class PassCheckpoints:
    """Checkpoints of pass `number`. Blocks are identified by the number of their first baked vertex."""

    store: CheckpointStore
    number: int

    def start(self, settings: PassSettings, block_vertices: int) -> None:
        """Deletes checkpoints of an earlier run with other settings. Bakes for a time never have equal settings."""
        refinement, interpolation = settings.refinement, settings.active_interpolation
        values = [
            refinement.light_tolerance,
            refinement.view_tolerance,
            refinement.validation_noise,
            refinement.floor,
            refinement.initial_sizes,
            refinement.full_levels,
            LATTICES.index(refinement.lattices),
        ]
        if interpolation is not None:
            values += [interpolation.spacing, float(interpolation.bins)]
        tolerances, name = np.array(values, np.float64), f"settings-{self.number:02d}"
        known = self.store.read(name)
        if known is not None and np.array_equal(known["tolerances"], tolerances):
            return
        self.forget_blocks()
        self.forget_evaluated()
        self.store.forget(f"{DONE}{self.number:02d}")
        self.store.write(name, {"tolerances": tolerances, "block_vertices": np.asarray(block_vertices)})

    def write(self, first: int, block: RefinedBlock, clamped: int) -> None:
        """Stores a block."""
        self.store.write(self._name(first), as_arrays(block, clamped))

    def read(self, first: int) -> ClampedBlock | None:
        """A block of this pass; None if it is not finished."""
        return self._read(self._name(first))

    def require(self, first: int) -> ClampedBlock:
        """A finished block of this pass; raises StorageError if it cannot be read."""
        return self._require(self._name(first))

    def require_previous(self, first: int) -> ClampedBlock:
        """The same block of the pass before; raises StorageError if it cannot be read."""
        return PassCheckpoints(self.store, self.number - 1).require(first)

    def write_evaluated(self, first: int, block: RefinedBlock, clamped: int) -> None:
        """Stores the vertices of a block from which others are interpolated."""
        self.store.write(EVALUATED + self._name(first), as_arrays(block, clamped))

    def read_evaluated(self, first: int) -> ClampedBlock | None:
        """The vertices of a block from which others are interpolated; None if they are not finished."""
        return self._read(EVALUATED + self._name(first))

    def require_evaluated(self, first: int) -> ClampedBlock:
        """The same of a block where they are finished; raises StorageError if they cannot be read."""
        return self._require(EVALUATED + self._name(first))

    def finished(self) -> list[int]:
        """The finished blocks."""
        return self._firsts("")

    def finished_evaluated(self) -> list[int]:
        """The blocks whose vertices to interpolate from are finished."""
        return self._firsts(EVALUATED)

    def forget_blocks(self) -> None:
        """Deletes the blocks."""
        self.store.forget(self._name(""))

    def forget_previous(self) -> None:
        """Deletes the blocks of the pass before."""
        PassCheckpoints(self.store, self.number - 1).forget_blocks()

    def forget_evaluated(self) -> None:
        """Deletes the vertices that others were interpolated from."""
        self.store.forget(EVALUATED + self._name(""))

    def write_result(self, done: Pass) -> None:
        """Marks the pass as complete."""
        self.store.write(f"{DONE}{self.number:02d}", done.tally.as_arrays() | {"seconds": np.asarray(done.seconds)})

    def read_result(self, before: Correction) -> Pass | None:
        """The result of a pass that is complete, for the prior `before` of its correction; None if it is not.

        Its blocks may be deleted already, if the next pass is complete too.
        """
        arrays = self.store.read(f"{DONE}{self.number:02d}")
        if arrays is None:
            return None
        tally = Tally.from_arrays(arrays)
        return Pass.of(tally, before, complete=True, seconds=float(arrays["seconds"]))

    def _name(self, first: int | str) -> str:
        return f"{self.number:02d}-{first}"

    def _read(self, name: str) -> ClampedBlock | None:
        arrays = self.store.read(name)
        return None if arrays is None else (RefinedBlock.from_arrays(arrays), int(arrays["clamped"]))

    def _require(self, name: str) -> ClampedBlock:
        found = self._read(name)
        if found is None:
            raise StorageError(
                f"checkpoint {name}: expected a finished block of this bake, found none that can be read; "
                "bake again without resuming"
            )
        return found

    def _firsts(self, kind: str) -> list[int]:
        prefix = kind + self._name("")
        return [int(name.removeprefix(prefix)) for name in self.store.names(prefix)]


def as_arrays(block: RefinedBlock, clamped: int) -> dict[str, NDArray[Any]]:
    """The arrays that a checkpoint of the block holds."""
    return block.as_arrays() | {"clamped": np.asarray(clamped)}
