"""The search for the lobes of all vertices of a bake, in blocks that a killed bake resumes from."""

from collections.abc import Callable
from typing import Any

import numpy as np

from bakers.workers import Workers
from formats.asset.lobes import Lobes
from prt_bake.baking.lobes.pilot import LobePlan
from prt_bake.baking.lobes.search import Index, LobeSearch
from prt_bake.baking.output.checkpoint_store import CheckpointStore

AT_ONCE = 16
"""Vertices of a block."""


def find_lobes(
    search: LobeSearch,
    plan: LobePlan,
    vertices: Index,
    workers: Workers,
    store: CheckpointStore,
    stopped: Callable[[], bool],
    progress: Callable[[int], None],
) -> Lobes | None:
    """The planned lobes at `vertices`; None if the search was stopped. Others have none.

    progress: called with the number of vertices that are done.
    """

    def find(block: Index) -> dict[str, Any]:
        name = f"lobes-{int(block[0]):09d}"
        arrays = store.read(name)
        if arrays is None:
            arrays = workers.do(_find_block, (search, plan), block)
            store.write(name, arrays)
        return arrays

    lobes = _empty(search.vertices, search.grid, plan.lobes)
    blocks = [vertices[first : first + AT_ONCE] for first in range(0, len(vertices), AT_ONCE)]
    done, found = 0, workers.in_order(find, blocks)
    try:
        for block in blocks:
            if stopped():
                return None
            arrays = next(found)
            lobes.axes[block], lobes.sharpness[block] = arrays["axes"], arrays["sharpness"]
            lobes.powers[block] = arrays["powers"]
            done += len(block)
            progress(done)
    except KeyboardInterrupt:
        return None
    finally:
        found.close()
    return lobes


def _find_block(search: LobeSearch, plan: LobePlan, vertices: Index) -> dict[str, Any]:
    fields = search.fields(vertices, plan.own > 0, plan.fitted)
    names = ("axes", "sharpness", "powers")
    return {name: np.stack([getattr(f, name) for f in fields], axis=2).astype(np.float32) for name in names}


def _empty(vertices: int, grid: tuple[int, int], count: int) -> Lobes:
    shape = vertices, grid[0] * grid[1], count
    axes = np.zeros((*shape, 3), np.float32)
    axes[..., 2] = 1.0
    return Lobes(*grid, axes, np.ones(shape, np.float32), np.zeros((*shape, 3), np.float32))
