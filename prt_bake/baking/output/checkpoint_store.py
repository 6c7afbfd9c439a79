"""Finished blocks of a bake in fixed samples, in a store: what a bake that was stopped or killed goes on from."""

from dataclasses import astuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block, Task, cuts
from bakers.path_traced import Account
from formats.asset.error_covariance import ErrorShape
from prt_bake.baking.output.checkpoint import Store

Cut = tuple[int, int]
"""The first vertex of a block, and the one after its last."""

_STAGE = "block-"


class Shelf:
    """Blocks by their vertices; nothing is kept without a store."""

    def __init__(self, store: Store | None) -> None:
        self._store = store

    @property
    def there(self) -> list[Cut]:
        """The blocks that an earlier run has done."""
        return [] if self._store is None else [_cut(name) for name in self._store.names(_STAGE)]

    def cuts(self, task: Task, vertices: NDArray[np.int64]) -> list[Cut]:
        """What is there of these vertices, and between it the blocks that are missing, in order."""
        kept = self.there
        there = [vertices[(vertices >= first) & (vertices < last)] for first, last in kept]
        missing = np.setdiff1d(vertices, np.concatenate([vertices[:0], *there]))
        return sorted(kept + cuts(task, missing))

    def keep(self, block: Block) -> None:
        """Takes a block."""
        if self._store is not None:
            name = _name(block.first_vertex, block.first_vertex + len(block.valid))
            self._store.write(name, as_arrays(block))

    def kept(self, cut: Cut) -> Block | None:
        """Gives a block back; None where it is not there, or broken."""
        arrays = None if self._store is None else self._store.read(_name(*cut))
        if arrays is None:
            return None
        parts = arrays["coefficients"], arrays["standard_error"], arrays["valid"], int(arrays["bent"])
        account = _account(arrays["account"]) if "account" in arrays else None
        shape = ErrorShape(arrays["covariance"], arrays["channels"], arrays["apart"])
        return Block(cut[0], *parts, account, int(arrays["more"]), shape=shape)


def as_arrays(block: Block) -> dict[str, NDArray[Any]]:
    """A block as it is kept."""
    arrays: dict[str, NDArray[Any]] = {
        "coefficients": block.coefficients,
        "standard_error": block.standard_error,
        "valid": block.valid,
        "bent": np.asarray(block.bent),
        "more": np.asarray(block.more),
    }
    if block.shape is not None:
        arrays |= {name: getattr(block.shape, name) for name in ("covariance", "channels", "apart")}
    if block.account is not None:
        arrays["account"] = np.array(astuple(block.account), np.float64)
    return arrays


def _account(numbers: NDArray[np.float64]) -> Account:
    bins, bent, unreliable = (int(number) for number in numbers[:3])
    return Account(bins, bent, unreliable, *(float(number) for number in numbers[3:]))


def _name(first: int, last: int) -> str:
    return f"{_STAGE}{first}-{last}"


def _cut(name: str) -> Cut:
    first, last = name.removeprefix(_STAGE).split("-")
    return int(first), int(last)
