"""The media of a scene's parts as the kernels take them: scaled, laid out in flat arrays, with their blocks."""

import numpy as np
from numpy.typing import NDArray

from formats.scene import Medium, Part
from prt_bake.trainer.blocks import blocks_of
from prt_bake.trainer.media import Media

Array = NDArray[np.float64]


def prepare_media(parts: tuple[Part, ...], center: Array, scale: float) -> Media:
    """Media of the regions outside (clear) and inside each part, in lengths of the object's longest side."""
    count = len(parts) + 1
    sigma_t, albedo, phase_g = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    majorant, minorant = np.zeros(count), np.zeros(count)
    low, per_length = np.full((count, 3), -0.5), np.ones((count, 3))
    extinctions, albedos, blocks = _Cells(count), _Cells(count), _Blocks(count)
    for region, part in enumerate(parts, start=1):
        if part.medium is None:
            continue
        medium = part.medium
        phase_g[region] = medium.phase_g
        corners = np.array([[-0.5] * 3, [0.5] * 3])
        if medium.bounds is not None:
            corners = (medium.bounds - center) / scale
        low[region], per_length[region] = corners[0], 1.0 / (corners[1] - corners[0])
        extinction = np.asarray(medium.sigma_t, np.float64) * scale
        majorant[region], minorant[region] = extinction.max(), extinction.min()
        if extinction.ndim >= 3:
            # What the kernels look up is rounded to float32, so the blocks count that.
            extinction = extinctions.add(region, extinction)
            majorant[region], minorant[region] = extinction.max(), extinction.min()
            blocks.add(region, extinction, corners[1] - corners[0])
        else:
            sigma_t[region] = extinction
        if np.ndim(medium.albedo) >= 3:
            albedos.add(region, np.asarray(medium.albedo, np.float64))
        else:
            albedo[region] = medium.albedo
    return Media(
        majorant=majorant,
        minorant=minorant,
        chromatic=np.array([False] + [part.medium is not None and _differs(part.medium) for part in parts]),
        sigma_t=sigma_t,
        albedo=albedo,
        phase_g=phase_g,
        extinction_cells=extinctions.joined(),
        extinction_layout=extinctions.layout,
        albedo_cells=albedos.joined(),
        albedo_layout=albedos.layout,
        low=low,
        per_length=per_length,
        bounds_of_blocks=blocks.joined(),
        blocks=blocks.layout,
    )


def _differs(medium: Medium) -> bool:
    """Whether extinction differs between the channels anywhere."""
    values = np.asarray(medium.sigma_t)
    return values.ndim in (1, 4) and bool((values[..., :1] != values).any())


class _Cells:
    """Grids laid one after the other."""

    def __init__(self, regions: int) -> None:
        self.layout = np.zeros((regions, 5), np.int64)
        self._rows: list[NDArray[np.float32]] = []

    def add(self, region: int, grid: Array) -> Array:
        """Lay a grid [Z,Y,X] or [Z,Y,X,3] behind the others and return it as it was rounded."""
        rounded = np.ascontiguousarray(grid, np.float32)
        if rounded.ndim == 4 and (rounded[..., :1] == rounded).all():
            rounded = np.ascontiguousarray(rounded[..., 0])
        self.layout[region] = sum(map(len, self._rows)), 3 if rounded.ndim == 4 else 1, *rounded.shape[:3]
        self._rows.append(rounded.ravel())
        return rounded.astype(np.float64)

    def joined(self) -> NDArray[np.float32]:
        return np.concatenate(self._rows) if self._rows else np.zeros(1, np.float32)


class _Blocks:
    """The blocks of all grids, one after the other."""

    def __init__(self, regions: int) -> None:
        self.layout = np.ones((regions, 4), np.int64)
        self._rows: list[Array] = []

    def add(self, region: int, extinction: Array, side: Array) -> None:
        """Cut a grid over a box of `side` into blocks."""
        bounds, shape = blocks_of(extinction, side)
        self.layout[region] = sum(map(len, self._rows)), *shape
        self._rows.append(bounds)

    def joined(self) -> Array:
        return np.concatenate(self._rows) if self._rows else np.zeros((1, 2))
