"""The lobes of a bake: how many pay is tried before its first pass, and they are found after its last one."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from bakers.transport import prepared, smooth, transport_kind
from formats.asset import Asset, AssetHead, read_asset
from formats.asset.lobes import LOBE_BYTES, add_lobes_to_file
from prt_bake.baking.job.forecast import BakeStatus
from prt_bake.baking.job.pruning_record import Pruning
from prt_bake.baking.job.work import Progress, Work
from prt_bake.baking.lobes.pilot import LobePlan, none_gained, plan_lobes
from prt_bake.baking.lobes.search import LobeSearch, node_grid
from prt_bake.baking.lobes.stage import find_lobes
from prt_bake.baking.output.checkpoint_store import CheckpointStore
from prt_bake.lobes.selftest import with_lobes

STAGE = "lobes"
SHARE_OF_TIME = 0.5
"""Most of a bake's time limit that lobes may take."""


@dataclass(frozen=True)
class LobesOfBake:
    """The lobes that a bake will find.

    Attributes:
        entry: for the provenance of the finished asset.
        seconds: predicted, of the search with all workers; 0 without lobes.
        bytes: in the file before compression.
    """

    entry: dict[str, Any]
    seconds: float = 0.0
    bytes: int = 0
    _search: LobeSearch | None = None
    _plan: LobePlan | None = None

    @property
    def entry_before(self) -> dict[str, Any]:
        """For the provenance of the asset without the lobes, which remains if the bake ends before they are found."""
        if self._plan is None:
            return self.entry
        return {**self.entry, "lobes_in_a_view": 0, "reason": "the bake ended before they were found"}

    def add_to(self, asset: Asset, work: Work, store: CheckpointStore) -> Asset | None:
        """The finished asset with its lobes; None if the search was stopped."""
        if self._search is None or self._plan is None:
            return asset
        rmse = asset.provenance["estimated_relative_rmse"]
        evaluations, vertices = float(work.evaluations), work.pruning.vertices

        def report(done: int) -> None:
            if work.progress is not None:
                left = self.seconds * (1.0 - done / len(vertices))
                row = (work.seconds, evaluations, rmse["total"] or 0.0)
                work.progress(done, len(vertices), BakeStatus(row, left, STAGE))

        lobes = find_lobes(self._search, self._plan, vertices, work.workers, store, lambda: work.stopped, report)
        if lobes is None:
            return None
        copy, original = work.pruning.copies.T
        for values in (lobes.axes, lobes.sharpness, lobes.powers):
            values[copy] = values[original]
        asset = with_lobes(replace(asset, provenance={**asset.provenance, "lobes": self.entry}), lobes)
        if work.out is None:
            return asset
        asset.close()
        add_lobes_to_file(work.out, work.out, lobes, {"lobes": self.entry}, asset.selftest)
        return read_asset(work.out, load=False)


def plan_lobes_of_bake(
    transport: Any,
    whole: Any,
    head: AssetHead,
    pruning: Pruning,
    most: int,
    minutes: float | None,
    workers: int,
    precision: str,
    device: str,
) -> LobesOfBake:
    """Try what lobes gain. transport: prepared for the bake; whole: with all bands; minutes: time limit."""
    reason = _reason_against(transport, pruning, most, minutes)
    if reason is not None:
        return LobesOfBake({"lobes_in_a_view": 0, "reason": reason})
    without_lobes = prepared(smooth(whole, pruning.kept_degree), precision, device)
    views = 1 if pruning.views == "one" else len(pruning.local)
    grid = node_grid(head.rings, head.sectors, views)
    search = LobeSearch(without_lobes, whole, head, pruning.kept_degree, grid)
    plan = plan_lobes(search, pruning.vertices, most)
    seconds = plan.seconds * len(pruning.vertices) / workers
    if plan.lobes and minutes is not None and seconds > SHARE_OF_TIME * 60.0 * minutes:
        reason = f"they would take {seconds:.0f} s, more than {SHARE_OF_TIME:.0%} of the time limit"
        return LobesOfBake({**plan.as_json(), "lobes_in_a_view": 0, "reason": reason})
    if not plan.lobes:
        return LobesOfBake({**plan.as_json(), "reason": none_gained(plan, grid)})
    size = len(pruning.vertices) * search.grid[0] * search.grid[1] * plan.lobes * LOBE_BYTES
    return LobesOfBake(plan.as_json(), seconds, size, search, plan)


def _reason_against(transport: Any, pruning: Pruning, most: int, minutes: float | None) -> str | None:
    if most == 0:
        return "not requested"
    if transport_kind(transport) == "coefficients":
        return "the source estimates coefficients only; `prtbake lobes` adds those of a network of the same object"
    if pruning.light is not None:
        return "the asset is made for one light"
    if pruning.views == "eye":
        return "the asset is made for one camera position"
    if minutes == math.inf:
        return "the bake runs until it is stopped; `prtbake lobes` adds them"
    return None


def counting_lobes(progress: Progress | None, seconds: float) -> Progress | None:
    """A progress callback whose prediction of the time left includes `seconds` for lobes."""
    if progress is None or seconds == 0.0:
        return progress
    report: Callable[[int, int, BakeStatus], None] = progress

    def later(done: int, total: int, status: BakeStatus) -> None:
        left = status.left if status.left is None or status.stage == STAGE else status.left + seconds
        report(done, total, BakeStatus((status[0], status[1], status[2]), left, status.stage, status.figures))

    return later
