"""Adds lobes to an asset that was baked before."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bakers.plain_function import as_transport
from bakers.transport import on_mesh, prepared, refuse_foreign, smooth, transport_kind, up_to
from bakers.workers import Threads
from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.baking.job.arguments import MOST_LOBES
from prt_bake.baking.lobes.agreement import harmonics_apart
from prt_bake.baking.lobes.pilot import none_gained, plan_lobes
from prt_bake.baking.lobes.search import LobeSearch, node_grid
from prt_bake.baking.lobes.stage import find_lobes
from prt_bake.baking.output.checkpoint_store import MemoryStore
from prt_bake.jit.limits import limited_threads
from prt_bake.lobes.selftest import with_lobes


def add_lobes(
    asset: Asset,
    transport: Any,
    most: int = MOST_LOBES,
    *,
    workers: int = 1,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> Asset:
    """The asset with lobes for what the transport holds beyond its harmonics; its coefficients are unchanged.

    Args:
        asset: of the same object; also a path-traced bake, whose object the transport is a network of.
        transport: offers evaluate or evaluate_block (`bakers.transport`), or is a function as in `prt_bake.bake`.
        most: most lobes in a view; as many are found as gain something.
        workers: threads.
        device: where a network is evaluated ("cpu", "cuda").
        progress: called with the vertices that are done and all vertices.

    Warns if the transport's harmonics are far off the coefficients. Raises QueryError for a transport without Ŝ, for a
    mesh that is not its own, and for an asset made for one light or one eye.

    >>> import prt_bake as prt
    >>> asset = prt.add_lobes(prt.read_asset("spot.h5"), prt.load_model("spot.pt"))
    >>> prt.write_asset(asset, "lobes.h5")
    """
    if not 1 <= most <= MOST_LOBES:
        raise QueryError(f"most: expected 1 to {MOST_LOBES} lobes in a view, found {most}")
    transport = as_transport(transport)
    if transport_kind(transport) == "coefficients":
        raise QueryError(
            "transport: expected one that evaluates Ŝ, found one that estimates coefficients only; give a network of "
            "the same object"
        )
    if asset.quantity != "transfer" or any(item.get("item") == "other views" for item in asset.left_out):
        raise QueryError(
            "asset: it was made for one light or one camera position and has no lobes; bake it without for_light and "
            "for_eye"
        )
    refuse_foreign(transport, asset.mesh)
    whole = on_mesh(transport, asset.mesh)
    harmonics = prepared(up_to(whole, asset.degree), "float32", device)
    without_lobes = prepared(smooth(whole, asset.degree), "float32", device)
    grid = node_grid(asset.rings, asset.sectors, asset.coefficients.shape[1])
    vertices = np.flatnonzero(asset.valid)
    with limited_threads(transport, workers):
        search = LobeSearch(without_lobes, whole, asset, asset.degree, grid)
        apart = harmonics_apart(asset, harmonics, search)
        plan = plan_lobes(search, vertices, most)
        lobes = None
        if plan.lobes:

            def report(done: int) -> None:
                if progress is not None:
                    progress(done, len(vertices))

            lobes = find_lobes(search, plan, vertices, Threads(workers), MemoryStore(), lambda: False, report)
            if lobes is None:
                raise KeyboardInterrupt
    entry: dict[str, Any] = {**plan.as_json(), "harmonics_apart": apart}
    if lobes is None:
        entry["reason"] = none_gained(plan, grid)
    return with_lobes(replace(asset, provenance={**asset.provenance, "lobes": entry}), lobes)
