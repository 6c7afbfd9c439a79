"""What every bake is handed: the transport, what is needed of it, where the asset goes, and whom to tell."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bakers.workers import Crew
from formats.asset import AssetHead
from formats.mesh import Mesh
from prt_bake.baking.job.forecast import Standing
from prt_bake.baking.job.pruning_record import Needs

Progress = Callable[[int, int, Standing], None]
"""progress(vertices done, vertices in all, (seconds, evaluations, estimated relative error)); the last one's attribute
`left` is the seconds that are left, as they are foretold, or None, and `stage` says in words which pass it is.
"""


@dataclass
class Work:
    """A bake that is to be done, and what it has cost so far."""

    transport: Any
    mesh: Mesh
    needs: Needs
    head: AssetHead
    """Of an asset of which nothing is left out."""
    report: dict[str, Any]
    """Provenance that is known before the bake."""
    out: str | Path | None
    storage: str
    crew: Crew
    seed: int
    progress: Progress | None
    stop: Callable[[], bool] | None
    began: float
    evaluations: int

    @property
    def seconds(self) -> float:
        """Since the bake began."""
        return time.monotonic() - self.began

    @property
    def stopped(self) -> bool:
        """Whether it is to end early."""
        return self.stop is not None and self.stop()
