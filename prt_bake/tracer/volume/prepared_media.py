"""Builds `Media` from the parts of a scene: scaled extinctions, concatenated grids, local majorants."""

import numpy as np
from numpy.typing import NDArray

from formats.scene import Medium, Part
from prt_bake.tracer.volume.majorants import extinction_blocks, steep_extinction
from prt_bake.tracer.volume.media import (
    ALBEDO,
    ALBEDO_GRID,
    BLOCKS,
    BLOCKS_LOW,
    BLOCKS_PER_LENGTH,
    CHROMATIC,
    EXTINCTION_GRID,
    LOW,
    MAJORANT,
    MINORANT,
    PER_LENGTH,
    PHASE_G,
    REGION_SIZE,
    SIGMA_T,
    STEEP,
    Media,
)

Array = NDArray[np.float64]


def prepare_media(parts: tuple[Part, ...], center: Array, scale: float) -> Media:
    """Media of the outside (a vacuum) and of each part; `center` and `scale` define the kernels' coordinates."""
    regions = np.zeros((len(parts) + 1, REGION_SIZE))
    regions[:, PER_LENGTH : PER_LENGTH + 3] = 1.0
    extinctions, albedos, blocks = _Rows(), _Rows(), list[Array]()
    for row, part in zip(regions[1:], parts, strict=True):
        if part.medium is None:
            continue
        medium = part.medium
        corners = np.array([[-0.5] * 3, [0.5] * 3])
        if medium.bounds is not None:
            corners = (medium.bounds - center) / scale
        side = corners[1] - corners[0]
        row[LOW : LOW + 3], row[PER_LENGTH : PER_LENGTH + 3] = corners[0], 1.0 / side
        row[PHASE_G], row[CHROMATIC] = medium.phase_g, _differs(medium)
        extinction = np.asarray(medium.sigma_t, np.float64) * scale
        if extinction.ndim >= 3:
            # Kernels look up values rounded to float32, so the majorants must bound those.
            extinction = extinctions.add(row[EXTINCTION_GRID : EXTINCTION_GRID + 5], extinction)
            bounds, shape = extinction_blocks(extinction, side)
            # Blocks extend from the centre of the first voxel to that of the last.
            voxels = np.array(extinction.shape[2::-1])
            row[BLOCKS_LOW : BLOCKS_LOW + 3] = corners[0] + 0.5 * side / voxels
            row[BLOCKS_PER_LENGTH : BLOCKS_PER_LENGTH + 3] = shape / (side * np.maximum(1.0 - 1.0 / voxels, 1e-9))
            row[STEEP] = steep_extinction(extinction.shape, side)
            row[BLOCKS : BLOCKS + 4] = sum(map(len, blocks)), *shape
            blocks.append(bounds)
        else:
            row[SIGMA_T : SIGMA_T + 3] = extinction
        row[MAJORANT], row[MINORANT] = extinction.max(), extinction.min()
        if np.ndim(medium.albedo) >= 3:
            albedos.add(row[ALBEDO_GRID : ALBEDO_GRID + 5], np.asarray(medium.albedo, np.float64))
        else:
            row[ALBEDO : ALBEDO + 3] = medium.albedo
    return Media(
        regions=regions,
        extinction_cells=extinctions.joined(),
        albedo_cells=albedos.joined(),
        blocks=np.concatenate(blocks) if blocks else np.zeros((1, 2)),
    )


def _differs(medium: Medium) -> bool:
    """Whether extinction differs between the channels anywhere."""
    values = np.asarray(medium.sigma_t)
    return values.ndim in (1, 4) and bool((values[..., :1] != values).any())


class _Rows:
    """Concatenated grids."""

    def __init__(self) -> None:
        self._rows: list[NDArray[np.float32]] = []

    def add(self, described: Array, grid: Array) -> Array:
        """Append a grid [Z,Y,X] or [Z,Y,X,3], write its place and shape to `described`, and return it rounded."""
        rounded = np.ascontiguousarray(grid, np.float32)
        if rounded.ndim == 4 and (rounded[..., :1] == rounded).all():
            rounded = np.ascontiguousarray(rounded[..., 0])
        described[:] = sum(map(len, self._rows)), 3 if rounded.ndim == 4 else 1, *rounded.shape[:3]
        self._rows.append(rounded.ravel())
        return rounded.astype(np.float64)

    def joined(self) -> NDArray[np.float32]:
        return np.concatenate(self._rows) if self._rows else np.zeros(1, np.float32)
