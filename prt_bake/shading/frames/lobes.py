"""Lobes in frames: their radiance at the shown vertices, which the kernels add to that of the harmonics.

What is linear between nodes is stored for each lobe as eight numbers: its power in RGB, the sum s of their absolute
values, s times the axis, and s times the logarithm of the sharpness (`prt_bake.lobes.interpolation`).
"""

import math
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from formats.asset.lobes import Lobes
from prt_bake.jit.compilation import compiled
from prt_bake.lobes.light import LobeLight, add_lobe
from prt_bake.shading.frames.batches import SPAN, make_scratch
from prt_bake.shading.frames.kernels import next_views

_NUMBERS = 8


class FrameLobes:
    """The lobes of an asset, under a light that turns."""

    def __init__(self, lobes: Lobes | None, threads: int) -> None:
        """lobes: None for an asset without lobes."""
        self._light: LobeLight | None = None
        self._turned: LobeLight | None = None
        self._rows = None if lobes is None else _linear_rows(lobes)
        self._grid = (1, 1) if lobes is None else (lobes.rings, lobes.sectors)
        self._beyond = np.zeros((0 if lobes is None else len(lobes.axes), 3), np.float32)
        self._scratch = make_scratch(threads)

    @property
    def lit(self) -> bool:
        """Whether there are lobes, and light that they see."""
        return self._rows is not None and self._light is not None

    def set_light(self, light: LobeLight | None) -> None:
        """Set what the lobes see, if anything."""
        self._light = self._turned = light

    def turn(self, rotation: NDArray[np.float64]) -> None:
        """Rotate the light that was set last by a rotation [3,3] of object space."""
        self._turned = None if self._light is None else self._light.turned(rotation)

    def draw(self, scene: Any, eye: Any, cull: bool, radiance: Any, threads: int) -> NDArray[np.float32]:
        """Radiance [V,3] of the lobes at the vertices that are shown, [0,3] without lobes; arguments of `kernels`."""
        if self._rows is None or self._turned is None:
            return self._beyond[:0]
        view = scene, eye, cull, self._grid, self._scratch
        _draw_lobes(self._rows, tuple(self._turned), *view, radiance, self._beyond, threads)
        return self._beyond


def _linear_rows(lobes: Lobes) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rows [V,N,8J] of all nodes, and [V,8J], their means over ring 0."""
    strength = np.abs(lobes.powers).sum(axis=-1, keepdims=True)
    parts = lobes.powers, strength, strength * lobes.axes, strength * np.log(lobes.sharpness)[..., None]
    rows = np.concatenate(parts, axis=-1, dtype=np.float32).reshape(*lobes.powers.shape[:2], -1)
    return rows, rows[:, : lobes.sectors].mean(axis=1, dtype=np.float64).astype(np.float32)


@compiled(parallel=True, error_model="numpy")
def _draw_lobes(
    stored: Any,
    light: Any,
    scene: Any,
    eye: Any,
    cull: Any,
    grid: Any,
    scratch: Any,
    radiance: Any,
    beyond: Any,
    threads: Any,
) -> None:
    """Set beyond [V,3] at the vertices that are shown. stored: from `_linear_rows`."""
    rows, poles = stored
    lanes, size = scene[1].shape[0], rows.shape[2]
    for t in prange(threads):
        lane, row, total, mean = SPAN * t, np.zeros(size, np.float32), np.zeros(3), np.zeros(3)
        while lane < lanes:
            count, lane = next_views(t, lane, threads, scene, eye, cull, grid, scratch, radiance)
            batch, bins, weights = scratch[0][t], scratch[2][t], scratch[3][t]
            for n in range(count):
                v = batch[n]
                a, b, c, d = rows[v, bins[0, n]], rows[v, bins[1, n]], rows[v, bins[2, n]], rows[v, bins[3, n]]
                w_a, w_b, w_c, w_d = weights[0, n], weights[1, n], weights[2, n], weights[3, n]
                for i in range(size):
                    row[i] = w_a * a[i] + w_b * b[i] + w_c * c[i] + w_d * d[i]
                if weights[4, n] > 0.0:
                    for i in range(size):
                        row[i] += weights[4, n] * poles[v, i]
                total[:] = 0.0
                for first in range(0, size, _NUMBERS):
                    _add_row(row, first, light, mean, total)
                for channel in range(3):
                    beyond[v, channel] = total[channel]


@compiled(error_model="numpy")
def _add_row(row: Any, first: Any, light: Any, mean: Any, total: Any) -> None:
    strength, x, y, z = row[first + 3], row[first + 4], row[first + 5], row[first + 6]
    length = math.sqrt(x * x + y * y + z * z)
    if strength <= 0.0 or length <= 0.0:
        return
    turn = light[8]
    x, y, z = x / length, y / length, z / length
    axis = (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )
    add_lobe(light, axis, math.exp(row[first + 7] / strength), row[first : first + 3], mean, total)
