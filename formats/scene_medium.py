"""What fills a part of a scene: extinction and albedo, as numbers or as grids over a box."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError
from formats.scene_grid import read_grid
from formats.scene_schema import MediumTable


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


def clear_medium() -> Medium:
    """A medium that neither scatters nor absorbs."""
    return Medium(sigma_t=np.zeros(()), albedo=np.ones(3))


def read_medium(table: MediumTable, scene_path: Path, key: str) -> Medium:
    """Return the medium that a table describes, with its grids loaded.

    Args:
        table: the table as checked.
        scene_path: the scene file, beside which grids are looked for.
        key: where in the scene file the table stands, for messages, as in "medium" or "inside.0.medium".

    Raises:
        SceneError: a grid that does not fit, or one without `bounds`.
        StorageError: a grid is missing.
    """
    has_grid = isinstance(table.sigma_t, str) or isinstance(table.albedo, str)
    if has_grid and table.bounds is None:
        raise SceneError(
            f"{scene_path}: {key}.bounds: is missing; a grid needs its box, as in bounds = [[-1, -1, -1], [1, 1, 1]]"
        )
    return Medium(
        sigma_t=_sigma_t(table, scene_path, key),
        albedo=_albedo(table, scene_path, key),
        phase_g=table.phase_g,
        bounds=np.array(table.bounds, np.float64) if has_grid else None,
    )


def _sigma_t(table: MediumTable, scene_path: Path, key: str) -> NDArray[np.float64]:
    if isinstance(table.sigma_t, str):
        return read_grid(scene_path, f"{key}.sigma_t", table.sigma_t, highest=np.inf)
    return np.array(table.sigma_t, np.float64)


def _albedo(table: MediumTable, scene_path: Path, key: str) -> NDArray[np.float64]:
    if isinstance(table.albedo, str):
        return read_grid(scene_path, f"{key}.albedo", table.albedo, highest=1.0)
    return np.broadcast_to(np.asarray(table.albedo, np.float64), 3).copy()
