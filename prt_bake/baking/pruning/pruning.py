"""What a scene needs of a bake: which vertices, views, bands and channels, and what can be left out of it unseen.

Each item has its reason, its saving and its cost, and can be switched off. What a look at a few vertices says of all of
them is held against every vertex when it is baked (`prt_bake.baking.output.pruned_sink`); where it does not hold, the
bake is begun anew without that item.
"""

import hashlib
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bakers.adaptive.view_levels import view_levels
from bakers.evaluation import values_at
from bakers.horizon import bend_to_horizon
from bakers.plan import Item
from bakers.transport import way_in
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import drawn, pair_turns
from prt_bake.baking.job.pruning_record import SHARE_OF_ERROR, Light, Needs
from prt_bake.baking.job.views import Views, horizons, views_of
from prt_bake.baking.pruning.hidden_vertices import seen_from_eye, seen_from_outside
from prt_bake.baking.pruning.rounding import rounding_of
from prt_bake.geometry.camera import refuse_eye_in_object
from prt_bake.mathematics import sh, sphere

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ITEMS = ("unseen", "duplicates", "views", "bands", "channels")
ALWAYS_TOLERATED = 2.0**-12
"""Relative error that an item may add where none was asked for: half of what float16 rounds off."""
WORST = 4.0
"""Times what is tolerated of the object, that may be off at a single vertex."""
DIRECTIONS, VIEWS, FEWEST, MOST, ONE_OF = 128, 11, 3, 24, 64
WORTH = 0.1, 64
"""What a look may take, of so many directions a bin."""
_LOOK_STREAM = 5


@dataclass(frozen=True)
class Look:
    """What a few vertices show, over the root mean square coefficient: of all of them, and the worst vertex."""

    views: tuple[float, float]
    bands: list[tuple[float, float]]
    """What bands above each degree hold."""
    channels: tuple[float, float]
    by_band: Array
    """Root of the sum of squares of each band [L+1,3], mean over vertices and views."""
    signal: float
    evaluations: int


def as_light(light: "Light | ArrayLike | None", degree: int) -> Light | None:
    """A light from its coefficients [K,3], of `degree` or a higher one; raises QueryError for another shape."""
    if light is None:
        return None
    given = light if isinstance(light, Light) else None
    coefficients = np.asarray(light.coefficients if isinstance(light, Light) else light, np.float64)
    count = sh.count(degree)
    if coefficients.ndim != 2 or coefficients.shape[1] != 3 or len(coefficients) < count:
        raise QueryError(f"for_light: shape {list(coefficients.shape)}, expected [{count}, 3] or more rows")
    if not np.isfinite(coefficients).all():
        raise QueryError("for_light: some of its coefficients are not finite")
    if given is not None:
        return replace(given, coefficients=coefficients[:count])
    digest = hashlib.sha256(np.ascontiguousarray(coefficients[:count], "<f8").tobytes()).hexdigest()
    return Light(coefficients[:count], "a light", digest)


def as_point(eye: ArrayLike) -> Array:
    """A point [3]; raises QueryError for anything else."""
    point = np.asarray(eye, np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise QueryError(f"for_eye: expected three finite numbers, found {point.tolist()}")
    return point


def needs_of(
    transport: Any,
    mesh: Mesh,
    degree: int,
    rings: int,
    sectors: int,
    error: float | None,
    seed: int,
    leave_out: Collection[str],
    light: Light | None = None,
    eye: Array | None = None,
) -> Needs:
    """What the bake of `mesh` needs where the items `leave_out` may be left out. Raises QueryError for other items, and
    for an eye on the object or in it.
    """
    unknown = sorted(set(leave_out) - set(ITEMS))
    if unknown:
        raise QueryError(f"leave out: {', '.join(unknown)} is nothing that could be; possible are {', '.join(ITEMS)}")
    tolerated = ALWAYS_TOLERATED if error is None else SHARE_OF_ERROR * error
    left_out, kept = list[Item](), list[Item]()

    def judge(name: str, good: bool, reason: str, saving: str, cost: str) -> bool:
        asked = name in leave_out
        told = reason if asked or not good else f"{reason}; switched off"
        (left_out if asked and good else kept).append(Item(name, told, saving if asked and good else "", cost))
        return asked and good

    vertices = _vertices(mesh, eye, leave_out, judge)
    copies = _copies(mesh, vertices, judge) if "duplicates" in leave_out else np.zeros((0, 2), np.int64)
    vertices = np.setdiff1d(vertices, copies[:, 0])
    views, local, outgoing = "all", sphere.view_bins(rings, sectors), views_of(mesh, rings, sectors)[1]
    kept_degree, channels, signal, spent = degree, 3, 0.0, 0
    wanted = {"views", "bands", "channels"} & set(leave_out)
    if eye is not None:
        views, local, outgoing = "eye", np.array([[0.0, 0.0, 1.0]]), _towards(mesh, eye)
        left_out.append(
            Item("other views", f"asked for the eye at {eye.tolist()} alone", _less(rings * sectors), "nothing")
        )
    some, size = _few(local), max(DIRECTIONS, 6 * sh.count(degree))
    many = len(vertices) * len(local) * WORTH[1]
    if wanted and light is None and _looked_at(vertices) * len(some) * size > WORTH[0] * many:
        kept.append(Item("views, bands, channels", "so small a bake is not worth a look", "", "nothing"))
    elif (wanted or light is not None) and way_in(transport) != "coefficients":
        look = looked_at(transport, mesh, vertices, degree, outgoing, some, size, seed)
        signal, spent, cost = look.signal, look.evaluations, f"{look.evaluations:,} evaluations"
        if views == "all" and rings * sectors > VIEWS:
            off, worst = look.views
            fine = off <= tolerated and worst <= WORST * tolerated
            reason = f"views differ by {off:.2g} of the coefficients, {worst:.2g} at the worst vertex seen"
            if judge("views", fine, reason, _less(rings * sectors), f"{cost}; adds {off:.2g}"):
                views, local, outgoing = "one", local[some], _of_bins(outgoing, some)
        if light is not None:
            needed = _degree_for(light, look, degree, tolerated)
            left_out.append(
                Item(
                    "other lights",
                    f"asked for {light.name} alone",
                    f"{_less(sh.count(degree))} of the bytes; harmonics of degree {needed} of {degree}",
                    cost,
                )
            )
            degree = kept_degree = needed
        else:
            kept_degree = _bands(look, degree, tolerated, cost, judge)
        off, worst = look.channels
        reason = f"channels differ by {off:.2g} of the coefficients, {worst:.2g} at the worst vertex seen"
        grey = light is None or bool(
            np.ptp(light.coefficients, axis=1).max() <= tolerated * np.abs(light.coefficients).max()
        )
        fine = off <= tolerated and worst <= WORST * tolerated and grey
        channels = 1 if judge("channels", fine, reason, _less(3), f"{cost}; adds {off:.2g}") else 3
    elif wanted:
        kept.append(Item("views, bands, channels", "walks are too noisy to tell", "", "nothing"))
    rounding, more = rounding_of(transport, mesh, views_of(mesh, rings, sectors)[1], rings * sectors, degree, seed)
    return Needs(
        vertices,
        copies,
        views,
        local,
        outgoing,
        degree,
        kept_degree,
        channels,
        light,
        tolerated,
        signal,
        spent + more,
        left_out,
        kept,
        rounding,
    )


@np.errstate(invalid="ignore", over="ignore")
def looked_at(
    transport: Any, mesh: Mesh, vertices: Index, degree: int, outgoing: Views, some: Index, size: int, seed: int
) -> Look:
    """Ŝ at a few vertices and at the bins `some` [b], all those of a vertex lit from the same `size` directions."""
    chosen = vertices[np.sort(drawn(seed + 4, len(vertices), _looked_at(vertices)))]
    towards = np.stack([outgoing(int(v), int(v) + 1)[0][0, some] for v in chosen])
    directions = sphere.fibonacci(size)
    harmonics = sh.evaluate(directions, degree)
    fit = np.linalg.solve(harmonics.T @ harmonics, harmonics.T)
    incident = directions @ pair_turns(seed, size, _LOOK_STREAM, chosen).transpose(0, 2, 1)
    rows = np.repeat(np.arange(len(chosen)), len(some))
    values = values_at(transport, incident, rows, mesh.positions[chosen][rows], towards.reshape(-1, 3))
    a = (fit @ values.astype(np.float64)).reshape(len(chosen), len(some), -1, 3)
    a = a[np.isfinite(a).all(axis=(1, 2, 3))]
    if not len(a):
        nothing = np.inf, np.inf
        return Look(nothing, [nothing] * (degree + 1), nothing, np.ones((degree + 1, 3)), 0.0, len(rows) * size)
    squares = (a**2).sum(axis=(1, 2, 3))
    bands = [a[:, :, (d + 1) ** 2 :] for d in range(degree + 1)]
    of_band = [np.sqrt((a[:, :, d**2 : (d + 1) ** 2] ** 2).sum(axis=2).mean(axis=(0, 1))) for d in range(degree + 1)]
    return Look(
        _relative(a - a.mean(axis=1, keepdims=True), squares),
        [_relative(band, squares) for band in bands],
        _relative(a - a.mean(axis=3, keepdims=True), squares),
        np.array(of_band),
        float((a**2).mean()),
        len(rows) * size,
    )


def _looked_at(vertices: Index) -> int:
    return min(int(np.clip(len(vertices) // ONE_OF, FEWEST, MOST)), len(vertices))


def _relative(off: Array, squares: Array) -> tuple[float, float]:
    """The root of Σ off² over Σ squares, and the largest over single vertices."""
    each = (off**2).sum(axis=(1, 2, 3))
    if not squares.sum() > 0.0:
        return 0.0, 0.0
    worst = np.divide(each, squares, out=np.zeros_like(each), where=squares > 0.0)
    return float(np.sqrt(each.sum() / squares.sum())), float(np.sqrt(worst.max()))


def _vertices(mesh: Mesh, eye: Array | None, leave_out: Collection[str], judge: Any) -> Index:
    everything = np.arange(len(mesh.positions))
    if eye is not None:
        refuse_eye_in_object(mesh, eye)
        seen = seen_from_eye(mesh, eye)
    elif "unseen" in leave_out:
        seen = seen_from_outside(mesh)
    else:
        return everything
    hidden = int((~seen).sum())
    if hidden == len(seen):
        raise QueryError("the eye sees nothing of the object; nothing would be baked")
    whose = "no eye outside can see" if eye is None else "the eye does not see"
    if eye is None:
        judge(
            "unseen",
            hidden > 0,
            f"{hidden} of {len(seen)} vertices {whose}",
            f"{hidden / len(seen):.1%} of it all",
            "rays",
        )
    return everything[seen]


def _copies(mesh: Mesh, vertices: Index, judge: Any) -> NDArray[np.int64]:
    """[n,2]: a vertex, and the first one at the same place with the same normal."""
    rows = np.concatenate([mesh.positions, mesh.normals], axis=1)[vertices]
    _unique, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    same = first[inverse.reshape(-1)]
    twice = np.flatnonzero(same != np.arange(len(vertices)))
    merged = 0 if mesh.source_vertex is None else len(np.unique(mesh.source_vertex[mesh.source_vertex >= 0]))
    before = 0 if mesh.source_vertex is None else int((mesh.source_vertex >= 0).sum()) - merged
    reason = f"{len(twice)} of {len(vertices)} vertices are at the place of another, with its normal"
    reason += f"; {before} were merged when the mesh was read" if before else ""
    judge("duplicates", len(twice) > 0, reason, f"{len(twice) / len(vertices):.1%} of the work", "nothing")
    return np.stack([vertices[twice], vertices[same[twice]]], axis=1)


def _bands(look: Look, degree: int, tolerated: float, cost: str, judge: Any) -> int:
    """The lowest degree above which there is nothing."""
    fits = [d for d, (off, worst) in enumerate(look.bands) if off <= tolerated and worst <= WORST * tolerated]
    lowest = min([*fits, degree])
    shown = lowest if lowest < degree else max(0, degree - 1)
    off = look.bands[shown][0]
    reason = f"bands above degree {shown} hold {off:.2g} of the coefficients"
    saving = f"{1.0 - sh.count(lowest) / sh.count(degree):.0%} of the bytes"
    return lowest if judge("bands", lowest < degree, reason, saving, f"{cost}; adds {off:.2g}") else degree


def _degree_for(light: Light, look: Look, degree: int, tolerated: float) -> int:
    """The lowest degree whose bands hold all of the radiance but what is tolerated."""
    of_light = np.array([np.linalg.norm(light.coefficients[d**2 : (d + 1) ** 2], axis=0) for d in range(degree + 1)])
    most = of_light * look.by_band
    whole = np.linalg.norm(most)
    for d in range(degree):
        if np.linalg.norm(most[d + 1 :].sum(axis=0)) <= tolerated * whole:
            return d
    return degree


def _towards(mesh: Mesh, eye: Array) -> Views:
    """One direction at each vertex, to the eye."""
    around = horizons(mesh)

    def outgoing(first: int, last: int) -> tuple[Array, int]:
        towards = eye - mesh.positions[first:last, None]
        return bend_to_horizon(towards / np.linalg.norm(towards, axis=-1, keepdims=True), around, first)

    return outgoing


def _of_bins(outgoing: Views, bins: Index) -> Views:
    def some(first: int, last: int) -> tuple[Array, int]:
        directions, bent = outgoing(first, last)
        return directions[:, bins], bent

    return some


def _few(local: Array) -> Index:
    """A few bins spread over all of them."""
    levels = view_levels(local)
    return np.sort(np.concatenate([level.bins for level in levels])[:VIEWS])


def _less(times: int) -> str:
    return f"{times} times smaller" if times > 1 else ""
