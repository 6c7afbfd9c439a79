"""What fills a part of a scene: numbers, grids, measured materials, or two substances mixed by a pattern."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError
from formats.scene.file import expected, named_by
from formats.scene.grid import read_grid
from formats.scene.materials import MILLIMETRES, Substance, albedo_of, find_material, substance
from formats.scene.schema import MediumTable, MixTable, ObjectTable
from formats.scene.solid_texture import share

MOST_MEAN_FREE_PATHS = 1e9
"""Along the longest side of a part: beyond, one is shorter than a float32 position can tell."""
_PADDING = 1e-3
"""How far a mixture's box reaches beyond the part's, in the part's longest side."""


@dataclass(frozen=True, eq=False)
class Medium:
    """A participating medium with the phase function of Henyey and Greenstein.

    Attributes:
        sigma_t: extinction per scene unit, float64: one number [], one a channel [3], a grid [Z,Y,X] or [Z,Y,X,3].
        albedo: single-scattering albedo in [0,1], float64: [3], a grid [Z,Y,X] or [Z,Y,X,3].
        phase_g: mean cosine of the phase function.
        bounds: float64 [2,3], lowest and highest corner of the box that the grids share; None where there is no grid.
    """

    sigma_t: NDArray[np.float64]
    albedo: NDArray[np.float64]
    phase_g: float = 0.0
    bounds: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Place:
    """Where a table of a medium stands, and what it must know of the part that it fills.

    Attributes:
        path: the scene file, beside which grids are looked for.
        key: the table, for messages, as in "medium" or "inside.0.medium".
        bounds: float64 [2,3], the part's bounding box.
        object: the table that names the unit of length.
    """

    path: Path
    key: str
    bounds: NDArray[np.float64]
    object: ObjectTable


def clear_medium() -> Medium:
    """A medium that neither scatters nor absorbs."""
    return Medium(sigma_t=np.zeros(()), albedo=np.ones(3))


def read_medium(table: MediumTable, place: Place) -> Medium:
    """Return the medium that a table describes, with its grids loaded and its mixture baked.

    Raises:
        SceneError: an unknown material, a unit of length that is not known, keys that exclude one another, a grid that
            does not fit, lies elsewhere or has no `bounds`, an extinction beyond `MOST_MEAN_FREE_PATHS`.
        StorageError: a grid is missing.
    """
    _refuse_contradictions(table, place, place.key)
    # What is too large for float64 is infinite, and refused with all that is too large.
    with np.errstate(over="ignore", invalid="ignore"):
        medium = _mixed(table, table.mix, place) if table.mix is not None else _plain(table, place)
    _refuse_opaque(medium, table, place)
    return medium


def _plain(table: MediumTable, place: Place) -> Medium:
    """A medium of one substance."""
    if table.material is not None:
        pure = _substance(table, place, place.key, table.phase_g)
        return Medium(pure.sigma_t, pure.albedo, table.phase_g)
    has_grid = isinstance(table.sigma_t, str) or isinstance(table.albedo, str)
    sigma_t, albedo = _quantity(table.sigma_t, place, "sigma_t", np.inf), _quantity(table.albedo, place, "albedo", 1.0)
    return Medium(sigma_t, albedo, table.phase_g, _box_of_grids(table, place) if has_grid else None)


def _box_of_grids(table: MediumTable, place: Place) -> NDArray[np.float64]:
    where = f"{place.path}: {place.key}.bounds"
    if table.bounds is None:
        raise SceneError(f"{where}: is missing; a grid needs its box, as in bounds = [[-1, -1, -1], [1, 1, 1]]")
    return np.array(table.bounds, np.float64)


def _refuse_opaque(medium: Medium, table: MediumTable, place: Place) -> None:
    largest = float(np.max(medium.sigma_t))
    paths = largest * float((place.bounds[1] - place.bounds[0]).max())
    if not paths <= MOST_MEAN_FREE_PATHS:
        key = "sigma_t" if table.material is None else "density"
        raise SceneError(
            f"{place.path}: {place.key}.{key}: an extinction of {largest:g} per scene unit makes the part {paths:.3g} "
            f"mean free paths long; expected at most {MOST_MEAN_FREE_PATHS:g}: check the unit of length"
        )


def _quantity(given: object, place: Place, name: str, highest: float) -> NDArray[np.float64]:
    if isinstance(given, str):
        with named_by(place.path, f"{place.key}.{name}"):
            return read_grid(place.path, f"{place.key}.{name}", given, highest)
    quantity = np.asarray(given, np.float64)
    return np.broadcast_to(quantity, 3).copy() if name == "albedo" else quantity


def _mixed(table: MediumTable, mix: MixTable, place: Place) -> Medium:
    """Mix the scattering and absorption of two substances, cell by cell, in the share that the pattern says."""
    for name in ("sigma_t", "albedo"):
        if isinstance(getattr(table, name), str):
            raise SceneError(f"{place.path}: {place.key}.{name}: a mixture needs numbers or a material, not a grid")
    _refuse_contradictions(mix, place, f"{place.key}.mix")
    first = _substance(table, place, place.key, table.phase_g)
    second = _substance(mix, place, f"{place.key}.mix", table.phase_g)
    bounds, points = _cells(place.bounds, mix.resolution)
    # Slab by slab: the noise of a whole grid at once would need many times its memory.
    w = np.stack([share(slab, mix.pattern, mix.feature, mix.seed, mix.octaves, mix.thresholds) for slab in points])
    w = w[..., None]
    sigma_s = (1.0 - w) * first.sigma_s + w * second.sigma_s
    sigma_t = (1.0 - w) * first.sigma_t + w * second.sigma_t
    grey = np.ptp(first.sigma_t) == 0 and np.ptp(second.sigma_t) == 0
    return Medium(
        sigma_t=np.ascontiguousarray(sigma_t[..., 0]) if grey else sigma_t,
        albedo=albedo_of(sigma_s, sigma_t),
        phase_g=table.phase_g,
        bounds=bounds,
    )


def _cells(box: NDArray[np.float64], resolution: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a box [2,3] slightly larger than `box`, and the centres [Z,Y,X,3] of nearly cubic cells that fill it."""
    longest = float((box[1] - box[0]).max())
    low, high = box[0] - _PADDING * longest, box[1] + _PADDING * longest
    side = float((high - low).max()) / resolution
    counts = np.maximum(np.rint((high - low) / side).astype(int), 1)
    x, y, z = (low[k] + (np.arange(n) + 0.5) * ((high[k] - low[k]) / n) for k, n in enumerate(counts))
    points = np.empty((*counts[::-1], 3))
    points[..., 0], points[..., 1], points[..., 2] = x, y[:, None], z[:, None, None]
    return np.stack([low, high]), points


def _substance(table: MediumTable | MixTable, place: Place, key: str, phase_g: float) -> Substance:
    """Return what a table of numbers, or of a material, is made of."""
    if table.material is None:
        sigma_t = np.broadcast_to(np.asarray(table.sigma_t, np.float64), 3)
        return Substance(sigma_t, sigma_t * np.asarray(table.albedo, np.float64))
    try:
        material = find_material(table.material)
    except KeyError as cause:
        raise SceneError(
            f"{place.path}: {key}.material: unknown material {table.material!r}; {cause.args[0]}"
        ) from None
    return substance(material, phase_g, _unit_in_mm(place, table.material), table.density)


def _refuse_contradictions(table: MediumTable | MixTable, place: Place, key: str) -> None:
    for name in ("sigma_t", "albedo"):
        given = getattr(table, name)
        if table.material is not None and given is not None:
            raise SceneError(
                f"{place.path}: {key}.{name}: the material {table.material!r} says it already; remove one of them (a "
                f"material's extinction is scaled by density)"
            )
        if table.material is None and given is None:
            raise SceneError(
                f"{place.path}: {key}.{name}: is missing; expected {expected(f'{key}.{name}')}; or name a material"
            )
    if table.material is None and table.density != 1.0:
        raise SceneError(f"{place.path}: {key}.density: goes with a material; without one, scale sigma_t itself")


def _unit_in_mm(place: Place, material: str) -> float:
    known, given = MILLIMETRES.get(place.object.unit), place.object.unit_in_mm
    if known is not None and given is not None and known != given:
        raise SceneError(
            f"{place.path}: object.unit_in_mm: is {given:g}, but the unit {place.object.unit!r} has {known:g} "
            f"millimetres; remove one of them"
        )
    length = known if given is None else given
    if length is None:
        raise SceneError(
            f"{place.path}: object.unit: {material!r} is measured per millimetre, and {place.object.unit!r} is no "
            f"known unit of length; expected one of {', '.join(MILLIMETRES)}, or unit_in_mm = 10.0 beside it"
        )
    return length
