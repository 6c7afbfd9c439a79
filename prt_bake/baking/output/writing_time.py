"""What it takes to keep the blocks of a bake and to write its asset: tried on some vertices, in a folder of its own."""

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
from prt_bake.baking.job.pruning_record import Needs
from prt_bake.baking.output.pruned_sink import pared_head
from prt_bake.baking.output.sink import open_sink

REPEATED = 4


def keeping_time(arrays: dict[str, NDArray[Any]], read: bool) -> float:
    """Seconds that it takes to keep a block in a journal, and to read it once where that is done."""
    with TemporaryDirectory() as folder, Journal(Path(folder) / "asset.h5", {}, False) as journal:
        journal.write("first", arrays)

        def keep() -> None:
            journal.write("block", arrays)
            if read:
                journal.read("block")

        taken = _seconds(keep)
        journal.remove()
    return taken


def writing_time(coefficients: NDArray[np.float32], head: AssetHead, storage: str, needs: Needs, all_of: int) -> float:
    """Seconds that it takes to write an asset of so many vertices, all like these [n,B,K,3]."""
    views = len(head.directions) if needs.views == "all" else 1
    light = None if needs.light is None else needs.light.coefficients
    kept = pared_head(head, needs)
    terms = 1 if light is not None else (kept.degree + 1) ** 2
    some = coefficients[:, :views, :terms, : needs.channels]
    # Chunks are packed several at a time: with one alone it would take longer.
    some = np.concatenate([some] * min(REPEATED, max(1, all_of // len(some))))
    how = kept, storage, views, needs.channels, light

    def write(many: int) -> None:
        block = Block(0, some[:many], np.zeros((many, views), np.float32), np.ones(many, bool), 0)
        with TemporaryDirectory() as folder, open_sink(Path(folder) / "asset.h5", *how) as sink:
            sink.write(block)
            sink.finish({}, np.zeros((0, 3)), False).close()

    write(1)
    least, most = _seconds(lambda: write(1)), _seconds(lambda: write(len(some)))
    return least + max(most - least, 0.0) / max(len(some) - 1, 1) * all_of


def _seconds(work: Callable[[], None]) -> float:
    began = time.monotonic()
    work()
    return time.monotonic() - began
