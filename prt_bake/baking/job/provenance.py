"""Provenance of a bake: the entries of every method, and the errors of bakes that have nothing to report.

docs/reference/bake_report.md explains all keys.
"""

from typing import Any

import numpy as np

from bakers.transport import label, transport_property
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.work import Work

SHOWN = 16
"""Most vertices that are listed by number."""


def known_before(transport: Any, mesh: Mesh, arguments: dict[str, Any], workers: int) -> dict[str, Any]:
    """Entries that are known before the bake."""
    settings = {name: value for name, value in arguments.items() if name not in ("seed", "device")}
    roughness = transport_property(transport, "roughness", None)
    return {
        "settings": {**settings, "workers": workers},
        "seed": arguments["seed"],
        "device": arguments["device"],
        "mesh_sha256": mesh.content_hash,
        "transport": type(transport).__name__,
        "eta": float(transport_property(transport, "eta", 1.0)),
        **({} if roughness is None else {"roughness": float(np.mean(roughness))}),
        "model": dict(getattr(transport, "metadata", None) or {}),
    }


def outcome(
    work: Work, total: float, percentile_95: float, clamped: int, invalid: list[int], baked: int
) -> dict[str, Any]:
    """Cost and estimated error of a bake of `baked` vertices. `clamped`: bins whose direction was clamped to the
    horizon. `invalid`: the vertices that are not finite.
    """
    return {
        "evaluations": work.evaluations,
        "seconds": work.seconds,
        "estimated_relative_rmse": {"total": total, "percentile_95_over_vertices": percentile_95},
        "bins_moved_to_the_horizon": clamped,
        "vertices_not_finite": {"count": len(invalid), "first": invalid[:SHOWN]},
        "vertices_baked": baked,
    }


def nothing_done() -> QueryError:
    """The error to raise if a bake was stopped before it had anything to write."""
    return QueryError("the bake ended before its first vertex was done, and nothing was written; give it more time")


def not_finite(transport: Any, where: str) -> QueryError:
    """The error to raise if a transport returned no finite value `where`, such as "48 view bins of a pilot"."""
    return QueryError(f"{label(transport)}: expected finite values, found NaN or infinite ones at all {where}")
