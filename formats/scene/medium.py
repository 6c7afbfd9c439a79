"""The medium of a part: numbers, grids, a measured material, or two substances mixed by a pattern."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError
from formats.scene.file import errors_at, expected, refuse_quoted_number
from formats.scene.grid import read_grid
from formats.scene.materials import Substance, find_material, single_scattering_albedo, to_scene_units
from formats.scene.schema import MediumTable, MixTable, ObjectTable
from formats.scene.solid_texture import blend_weight
from formats.scene.units import MILLIMETRES

MOST_MEAN_FREE_PATHS = 1e9
"""Along the longest side of a part; a shorter mean free path is below the resolution of float32 positions."""
_PADDING = 1e-3
"""Margin of a mixture's box around the part's, relative to the longest side of the part."""


@dataclass(frozen=True, eq=False)
class Medium:
    """A participating medium with the Henyey–Greenstein phase function.

    Attributes:
        sigma_t: extinction per scene unit, float64: a number [], RGB [3], or a grid [Z,Y,X] or [Z,Y,X,3].
        albedo: single-scattering albedo in [0,1], float64: RGB [3], or a grid [Z,Y,X] or [Z,Y,X,3].
        phase_g: mean cosine of the phase function.
        bounds: float64 [2,3], lowest and highest corner of the box of the grids; None without grids.
    """

    sigma_t: NDArray[np.float64]
    albedo: NDArray[np.float64]
    phase_g: float = 0.0
    bounds: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class MediumContext:
    """The location of a medium's table, and the part that the medium fills.

    Attributes:
        path: the scene file; grids are relative to its folder.
        key: the table, such as "inside.0.medium", for messages.
        bounds: float64 [2,3], the part's bounding box.
        object_table: names the unit of length.
    """

    path: Path
    key: str
    bounds: NDArray[np.float64]
    object_table: ObjectTable


def clear_medium() -> Medium:
    """Return a medium without scattering and absorption."""
    return Medium(sigma_t=np.zeros(()), albedo=np.ones(3))


def read_medium(table: MediumTable, context: MediumContext) -> Medium:
    """Return the medium of a table, with its grids loaded or its mixture evaluated.

    Raises:
        SceneError: an unknown material or unit of length, contradictory keys, an invalid grid or one without `bounds`,
            an extinction beyond `MOST_MEAN_FREE_PATHS`.
        StorageError: a grid is missing.
    """
    _refuse_contradictions(table, context, context.key)
    # Overflow gives infinity, which `_refuse_opaque` rejects like any other large extinction.
    with np.errstate(over="ignore", invalid="ignore"):
        medium = _mixture(table, table.mix, context) if table.mix is not None else _single_substance(table, context)
    _refuse_opaque(medium, table, context)
    return medium


def _single_substance(table: MediumTable, context: MediumContext) -> Medium:
    if table.material is not None:
        pure = _substance(table, context, context.key, table.phase_g)
        return Medium(pure.sigma_t, pure.albedo, table.phase_g)
    has_grid = isinstance(table.sigma_t, str) or isinstance(table.albedo, str)
    sigma_t = _quantity(table.sigma_t, context, "sigma_t", np.inf)
    albedo = _quantity(table.albedo, context, "albedo", 1.0)
    return Medium(sigma_t, albedo, table.phase_g, _box_of_grids(table, context) if has_grid else None)


def _box_of_grids(table: MediumTable, context: MediumContext) -> NDArray[np.float64]:
    where = f"{context.path}: {context.key}.bounds"
    if table.bounds is None:
        raise SceneError(f"{where}: is missing; a grid needs its box, such as bounds = [[-1, -1, -1], [1, 1, 1]]")
    return np.array(table.bounds, np.float64)


def _refuse_opaque(medium: Medium, table: MediumTable, context: MediumContext) -> None:
    largest = float(np.max(medium.sigma_t))
    paths = largest * float((context.bounds[1] - context.bounds[0]).max())
    if not paths <= MOST_MEAN_FREE_PATHS:
        key = "sigma_t" if table.material is None else "density"
        raise SceneError(
            f"{context.path}: {context.key}.{key}: an extinction of {largest:g} per scene unit makes the part "
            f"{paths:.3g} mean free paths long; expected at most {MOST_MEAN_FREE_PATHS:g}; check the unit of length"
        )


def _quantity(given: object, context: MediumContext, name: str, highest: float) -> NDArray[np.float64]:
    if isinstance(given, str):
        refuse_quoted_number(context.path, f"{context.key}.{name}", given)
        with errors_at(context.path, f"{context.key}.{name}"):
            return read_grid(context.path, f"{context.key}.{name}", given, highest)
    quantity = np.asarray(given, np.float64)
    return np.broadcast_to(quantity, 3).copy() if name == "albedo" else quantity


def _mixture(table: MediumTable, mix: MixTable, context: MediumContext) -> Medium:
    """Blend the scattering and absorption of two substances per cell, with the weight of the pattern."""
    for name in ("sigma_t", "albedo"):
        if isinstance(getattr(table, name), str):
            raise SceneError(f"{context.path}: {context.key}.{name}: a mixture needs numbers or a material, not a grid")
    _refuse_contradictions(mix, context, f"{context.key}.mix")
    first = _substance(table, context, context.key, table.phase_g)
    second = _substance(mix, context, f"{context.key}.mix", table.phase_g)
    bounds, points = _cells(context.bounds, mix.resolution)
    # Slab by slab, because the noise of the complete grid would need many times its memory.
    settings = mix.pattern, mix.feature, mix.seed, mix.octaves, mix.thresholds
    w = np.stack([blend_weight(slab, *settings) for slab in points])[..., None]
    sigma_s = (1.0 - w) * first.sigma_s + w * second.sigma_s
    sigma_t = (1.0 - w) * first.sigma_t + w * second.sigma_t
    grey = np.ptp(first.sigma_t) == 0 and np.ptp(second.sigma_t) == 0
    return Medium(
        sigma_t=np.ascontiguousarray(sigma_t[..., 0]) if grey else sigma_t,
        albedo=single_scattering_albedo(sigma_s, sigma_t),
        phase_g=table.phase_g,
        bounds=bounds,
    )


def _cells(box: NDArray[np.float64], resolution: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a box [2,3] slightly larger than `box`, and the centres [Z,Y,X,3] of its nearly cubic cells."""
    longest = float((box[1] - box[0]).max())
    low, high = box[0] - _PADDING * longest, box[1] + _PADDING * longest
    side = float((high - low).max()) / resolution
    counts = np.maximum(np.rint((high - low) / side).astype(int), 1)
    x, y, z = (low[k] + (np.arange(n) + 0.5) * ((high[k] - low[k]) / n) for k, n in enumerate(counts))
    points = np.empty((*counts[::-1], 3))
    points[..., 0], points[..., 1], points[..., 2] = x, y[:, None], z[:, None, None]
    return np.stack([low, high]), points


def _substance(table: MediumTable | MixTable, context: MediumContext, key: str, phase_g: float) -> Substance:
    """Return the substance of a table, from its numbers or its material."""
    if table.material is None:
        sigma_t = np.broadcast_to(np.asarray(table.sigma_t, np.float64), 3)
        return Substance(sigma_t, sigma_t * np.asarray(table.albedo, np.float64))
    try:
        material = find_material(table.material)
    except KeyError as cause:
        raise SceneError(
            f"{context.path}: {key}.material: unknown material {table.material!r}; {cause.args[0]}"
        ) from None
    return to_scene_units(material, phase_g, _unit_in_mm(context, table.material), table.density)


def _refuse_contradictions(table: MediumTable | MixTable, context: MediumContext, key: str) -> None:
    for name in ("sigma_t", "albedo"):
        given = getattr(table, name)
        if table.material is not None and given is not None:
            raise SceneError(
                f"{context.path}: {key}.{name}: the material {table.material!r} defines it already; remove one of them "
                f"(density scales the extinction of a material)"
            )
        if table.material is None and given is None:
            raise SceneError(
                f"{context.path}: {key}.{name}: is missing; expected {expected(f'{key}.{name}')}; or name a material"
            )
    if table.material is None and table.density != 1.0:
        raise SceneError(f"{context.path}: {key}.density: needs a material; without one, scale sigma_t itself")


def _unit_in_mm(context: MediumContext, material: str) -> float:
    length = context.object_table.length_in_mm
    if length is None:
        raise SceneError(
            f"{context.path}: object.unit: {material!r} is known per millimetre, but {context.object_table.unit!r} is "
            f"not a known unit of length; expected one of {', '.join(MILLIMETRES)}, or a key such as unit_in_mm = 10.0"
        )
    return length
