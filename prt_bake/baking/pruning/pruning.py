"""Decides which vertices, views, bands and channels of a bake are redundant and can be pruned.

Each item is reported with its reason, its saving and its cost, and can be switched off. A pilot at a few vertices
decides; `prt_bake.baking.output.pruned_sink` checks the decision at every vertex that is baked, and the bake restarts
without an item that fails.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.horizon import clamp_to_horizon
from bakers.plan import PrunableItem
from bakers.transport import transport_kind
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.pruning_record import SHARE_OF_ERROR, Light, Pruning
from prt_bake.baking.job.views import Views, horizons, views_of
from prt_bake.baking.pruning.hidden_vertices import seen_from_eye, seen_from_outside
from prt_bake.baking.pruning.redundancy import (
    VIEWS,
    Redundancy,
    directions_for,
    measure_redundancy,
    pilot_bins,
    pilot_size,
)
from prt_bake.baking.pruning.rounding import measure_rounding
from prt_bake.geometry.camera import refuse_eye_in_object
from prt_bake.mathematics import sh, sphere

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ITEMS = ("unseen", "duplicates", "views", "bands", "channels")
"""A further item also needs a field in `Pruning`, and a step in `PrunedSink` that prunes and checks it; a test requires
its name in the help of `--keep` and in the docstring of `bake`.
"""
ALWAYS_TOLERATED = 2.0**-12
"""Relative error that an item may add if no error is requested: half of the rounding of float16."""
PILOT_SHARE, USUAL_DIRECTIONS = 0.1, 64
"""Largest cost of the pilot over that of a bake, and the directions per bin of that bake."""


@dataclass
class _Decisions:
    """Items that may be pruned, and the decision about each."""

    prunable: Collection[str]
    pruned: list[PrunableItem] = field(default_factory=list)
    kept: list[PrunableItem] = field(default_factory=list)

    def prune(self, name: str, redundant: bool, reason: str, saving: str, cost: str) -> bool:
        """Records the item; true if it is redundant and may be pruned."""
        allowed = name in self.prunable
        if redundant and not allowed:
            reason = f"{reason}; switched off"
        pruned = allowed and redundant
        (self.pruned if pruned else self.kept).append(PrunableItem(name, reason, saving if pruned else "", cost))
        return pruned


def choose_pruning(
    transport: Any,
    mesh: Mesh,
    degree: int,
    rings: int,
    sectors: int,
    *,
    error: float | None,
    seed: int,
    prunable: Collection[str],
    light: Light | None = None,
    eye: Array | None = None,
) -> Pruning:
    """What the bake of `mesh` evaluates if the items `prunable` may be pruned.

    Raises QueryError for unknown items, and for an eye that is on the object, inside it or sees nothing of it.
    """
    unknown = sorted(set(prunable) - set(ITEMS))
    if unknown:
        raise QueryError(f"leave_out: expected items of {', '.join(ITEMS)}, found {', '.join(unknown)}")
    tolerated = ALWAYS_TOLERATED if error is None else SHARE_OF_ERROR * error
    decisions = _Decisions(prunable)
    vertices = _vertices(mesh, eye, decisions)
    copies = _copies(mesh, vertices, decisions) if "duplicates" in prunable else np.zeros((0, 2), np.int64)
    vertices = np.setdiff1d(vertices, copies[:, 0])
    all_views = views_of(mesh, rings, sectors)
    views, local, outgoing = "all", sphere.view_bins(rings, sectors), all_views
    kept_degree, channels, signal, evaluations = degree, 3, 0.0, 0
    if eye is not None:
        views, local, outgoing = "eye", np.array([[0.0, 0.0, 1.0]]), _towards(mesh, eye)
        reason = f"requested for the camera position {eye.tolist()} alone"
        decisions.pruned.append(PrunableItem("other views", reason, _smaller(rings * sectors), "nothing"))
    bins = pilot_bins(local)
    if _pilot_runs(transport, vertices, len(local), bins, degree, light, decisions):
        found = measure_redundancy(transport, mesh, vertices, degree, outgoing, bins, seed)
        signal, evaluations, cost = found.signal, found.evaluations, f"{found.evaluations:,} evaluations"
        several = views == "all" and len(local) > VIEWS
        if several and _views_are_equal(found, tolerated, len(local), decisions):
            views, local, outgoing = "one", local[bins], _subset(outgoing, bins)
        if light is not None:
            kept_degree = _degree_for(light, found, degree, tolerated)
            saving = f"{_smaller(sh.count(degree))} in bytes; harmonics of degree {kept_degree} of {degree}"
            decisions.pruned.append(PrunableItem("other lights", f"requested for {light.name} alone", saving, cost))
            degree = kept_degree
        else:
            kept_degree = _bands(found, degree, tolerated, decisions)
        channels = _channels(found, light, tolerated, decisions)
    rounding, more = measure_rounding(transport, mesh, all_views, rings * sectors, degree, seed)
    return Pruning(
        vertices=vertices,
        copies=copies,
        views=views,
        local=local,
        outgoing=outgoing,
        degree=degree,
        kept_degree=kept_degree,
        channels=channels,
        light=light,
        tolerated=tolerated,
        signal=signal,
        evaluations=evaluations + more,
        pruned=decisions.pruned,
        kept=decisions.kept,
        rounding=rounding,
    )


def _vertices(mesh: Mesh, eye: Array | None, decisions: _Decisions) -> Index:
    """The vertices that the eye sees, or any eye outside the object."""
    everything = np.arange(len(mesh.positions))
    if eye is not None:
        refuse_eye_in_object(mesh, eye)
        seen = seen_from_eye(mesh, eye)
    elif "unseen" in decisions.prunable:
        seen = seen_from_outside(mesh)
    else:
        return everything
    hidden = int((~seen).sum())
    if hidden == len(seen):
        where = "from outside it" if eye is None else f"from for_eye {eye.tolist()}"
        raise QueryError(f"mesh: none of its {len(seen)} vertices is visible {where}; nothing would be baked")
    if eye is None:
        reason = f"{hidden} of {len(seen)} vertices cannot be seen from outside"
        decisions.prune("unseen", hidden > 0, reason, f"{hidden / len(seen):.1%} of the bake", "rays")
    return everything[seen]


def _copies(mesh: Mesh, vertices: Index, decisions: _Decisions) -> NDArray[np.int64]:
    """[n,2]: a vertex, and the first vertex with the same position and normal."""
    rows = np.concatenate([mesh.positions, mesh.normals], axis=1)[vertices]
    _unique, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    same = first[inverse.reshape(-1)]
    twice = np.flatnonzero(same != np.arange(len(vertices)))
    merged = 0 if mesh.source_vertex is None else len(np.unique(mesh.source_vertex[mesh.source_vertex >= 0]))
    before = 0 if mesh.source_vertex is None else int((mesh.source_vertex >= 0).sum()) - merged
    reason = f"{len(twice)} of {len(vertices)} vertices have the position and normal of another"
    reason += f"; {before} were merged when the mesh was read" if before else ""
    saving = f"{len(twice) / len(vertices):.1%} of the bake"
    decisions.prune("duplicates", len(twice) > 0, reason, saving, "nothing")
    return np.stack([vertices[twice], vertices[same[twice]]], axis=1)


def _pilot_runs(
    transport: Any, vertices: Index, views: int, bins: Index, degree: int, light: Light | None, decisions: _Decisions
) -> bool:
    """Whether a pilot measures `bins` of the `views`: if something needs it, and it is not too expensive or noisy."""
    wanted = {"views", "bands", "channels"} & set(decisions.prunable)
    if not wanted and light is None:
        return False
    pilot_cost = pilot_size(vertices) * len(bins) * directions_for(degree)
    if light is None and pilot_cost > PILOT_SHARE * len(vertices) * views * USUAL_DIRECTIONS:
        reason = "the bake is too small for a pilot"
    elif transport_kind(transport) == "coefficients":
        reason = "path tracing is too noisy for a pilot"
    else:
        return True
    if wanted:
        decisions.kept.append(PrunableItem("views, bands, channels", reason, "", "nothing"))
    return False


def _views_are_equal(found: Redundancy, tolerated: float, bins: int, decisions: _Decisions) -> bool:
    """Whether one view may replace the `bins` of each vertex."""
    reason, cost = found.views.reason("views"), f"{found.evaluations:,} evaluations; adds {found.views.total:.2g}"
    return decisions.prune("views", found.views.within(tolerated), reason, _smaller(bins), cost)


def _channels(found: Redundancy, light: Light | None, tolerated: float, decisions: _Decisions) -> int:
    """Number of channels: 1 if all are equal, under a grey light if there is one."""
    grey_light = light is None or bool(
        np.ptp(light.coefficients, axis=1).max() <= tolerated * np.abs(light.coefficients).max()
    )
    redundant, reason = found.channels.within(tolerated) and grey_light, found.channels.reason("channels")
    cost = f"{found.evaluations:,} evaluations; adds {found.channels.total:.2g}"
    return 1 if decisions.prune("channels", redundant, reason, _smaller(3), cost) else 3


def _bands(found: Redundancy, degree: int, tolerated: float, decisions: _Decisions) -> int:
    """The lowest degree above which all bands are negligible."""
    lowest = min([*(d for d, deviation in enumerate(found.bands) if deviation.within(tolerated)), degree])
    shown = lowest if lowest < degree else max(0, degree - 1)
    share = found.bands[shown].total
    reason = f"bands above degree {shown} hold {share:.2g} of the coefficients"
    saving = f"{1.0 - sh.count(lowest) / sh.count(degree):.0%} of the bytes"
    cost = f"{found.evaluations:,} evaluations; adds {share:.2g}"
    pruned = decisions.prune("bands", lowest < degree, reason, saving, cost)
    return lowest if pruned else degree


def _degree_for(light: Light, found: Redundancy, degree: int, tolerated: float) -> int:
    """The lowest degree whose bands hold the radiance up to the tolerated error."""
    of_light = np.array([np.linalg.norm(light.coefficients[d**2 : (d + 1) ** 2], axis=0) for d in range(degree + 1)])
    bounds = of_light * found.by_band
    total = np.linalg.norm(bounds)
    for d in range(degree):
        if np.linalg.norm(bounds[d + 1 :].sum(axis=0)) <= tolerated * total:
            return d
    return degree


def _towards(mesh: Mesh, eye: Array) -> Views:
    """The direction from each vertex to the eye."""
    faces = horizons(mesh)

    def outgoing(vertices: Index) -> tuple[Array, int]:
        towards = eye - mesh.positions[vertices, None]
        return clamp_to_horizon(towards / np.linalg.norm(towards, axis=-1, keepdims=True), faces, vertices)

    return outgoing


def _subset(outgoing: Views, bins: Index) -> Views:
    def chosen(vertices: Index) -> tuple[Array, int]:
        directions, clamped = outgoing(vertices)
        return directions[:, bins], clamped

    return chosen


def _smaller(times: int) -> str:
    return f"{times} times smaller" if times > 1 else ""
