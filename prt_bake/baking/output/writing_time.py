"""Measured time to write checkpoints and the asset of a bake, for plans."""

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Block
from formats.asset import AssetHead
from formats.journal import Journal
from prt_bake.baking.job.pruning_record import Pruning
from prt_bake.baking.output.pruned_sink import pruned_head
from prt_bake.baking.output.sink import open_sink

REPEATED = 4


def checkpoint_time(arrays: dict[str, NDArray[Any]], read: bool) -> float:
    """Seconds to write a block to a journal and, with `read`, to read it once."""
    with TemporaryDirectory() as folder, Journal(Path(folder) / "asset.h5", {}, False) as journal:
        journal.write("first", arrays)

        def write_and_read() -> None:
            journal.write("block", arrays)
            if read:
                journal.read("block")

        seconds = _seconds(write_and_read)
        journal.remove()
    return seconds


def writing_time(
    coefficients: NDArray[np.float32], head: AssetHead, storage: str, pruning: Pruning, vertices: int
) -> float:
    """Seconds to write an asset of `vertices` vertices that are like these coefficients [n,B,K,3]."""
    views = len(head.directions) if pruning.views == "all" else 1
    light = None if pruning.light is None else pruning.light.coefficients
    pruned = pruned_head(head, pruning)
    terms = 1 if light is not None else (pruned.degree + 1) ** 2
    some = coefficients[:, :views, :terms, : pruning.channels]
    # Chunks are compressed several at a time, which is faster than one at a time.
    some = np.concatenate([some] * min(REPEATED, max(1, vertices // len(some))))
    arguments = pruned, storage, views, pruning.channels, light

    def write(many: int) -> None:
        block = Block(0, some[:many], np.zeros((many, views), np.float32), np.ones(many, bool), 0)
        with TemporaryDirectory() as folder, open_sink(Path(folder) / "asset.h5", *arguments) as sink:
            sink.write(block)
            sink.finish({}, np.zeros((0, 3)), False).close()

    write(1)
    least, most = _seconds(lambda: write(1)), _seconds(lambda: write(len(some)))
    return least + max(most - least, 0.0) / max(len(some) - 1, 1) * vertices


def _seconds(work: Callable[[], None]) -> float:
    began = time.monotonic()
    work()
    return time.monotonic() - began
