"""The input of every method of baking: transport, pruning, output, workers, callbacks and the cost so far."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bakers.workers import Workers
from formats.asset import AssetHead
from formats.mesh import Mesh
from prt_bake.baking.job.forecast import BakeStatus
from prt_bake.baking.job.pruning_record import Pruning

Progress = Callable[[int, int, BakeStatus], None]
"""progress(vertices done, all vertices, (seconds, evaluations, estimated relative error)). The last argument also has
the attributes `left`, predicted seconds or None, and `stage`, the name of the current pass.
"""


@dataclass
class Work:
    """A bake to be done, and its cost so far."""

    transport: Any
    mesh: Mesh
    pruning: Pruning
    head: AssetHead
    """Of the asset without pruning."""
    report: dict[str, Any]
    """Provenance that is known before the bake."""
    out: str | Path | None
    storage: str
    workers: Workers
    seed: int
    progress: Progress | None
    stop: Callable[[], bool] | None
    began: float
    evaluations: int
    finished: bool = False
    """Whether the asset is as fine as requested, so that its checkpoints are no longer needed."""

    @property
    def seconds(self) -> float:
        """Since the bake began."""
        return time.monotonic() - self.began

    @property
    def stopped(self) -> bool:
        """Whether the caller requested an early end."""
        return self.stop is not None and self.stop()
