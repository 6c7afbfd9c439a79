"""The light that lobes see: skies averaged with Gaussians of all sharpnesses, and suns in closed form.

A lobe adds to the radiance its power times the mean of the light beyond the harmonics, weighted by its Gaussian. The
harmonics are taken from the sky before it is averaged; for suns they are taken from the Gaussian.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.scene.lights import DirectionalLight
from prt_bake.jit.compilation import compiled
from prt_bake.jit.threads import in_threads
from prt_bake.lights.lighting import Lighting, Sky, in_disc
from prt_bake.lights.skies.prefiltered import add_bilinear, prefilter, radiance, texel_directions, to_square
from prt_bake.lights.sun_detection import WIDEST, split_lighting
from prt_bake.lobes.gaussians import beyond_harmonics
from prt_bake.mathematics import sh

Array = NDArray[np.float64]

_CELLS = 128
_OCTAVE = 2
"""Levels for each doubling of the sharpness."""
_TEXELS_A_WIDTH = 14.0
"""Texels along a side of a level over the root of its sharpness: four for each width of the Gaussian."""
_FEWEST = 16
_REACH = 10.0
"""Gaussians end at exp(−10)."""
_BLOCK = 8
"""Cells along a side of a block, which is left out where a Gaussian does not reach it."""


class LobeLight(NamedTuple):
    """Averages of skies, and suns.

    Averages are maps on the equal-area octahedron, one after the other: texels float32 [T,3]; sizes, starts [L], the
    texels along a side of each level and its first one; first, log₂ of the sharpness of level 0. Without skies L = 0.
    Suns: directions [S,3], irradiance [S,3] and the sharpness of their discs [S]. turn [3,3]: object space to the frame
    of the maps and the suns.
    """

    texels: NDArray[np.float32]
    sizes: NDArray[np.int64]
    starts: NDArray[np.int64]
    first: float
    directions: Array
    irradiance: Array
    discs: Array
    degree: int
    turn: Array

    def holds(self, least: float, most: float) -> bool:
        """Whether lobes of a sharpness from `least` to `most` are within its levels, or one level beside them."""
        beside = 1.0 / _OCTAVE
        last = self.first + (len(self.sizes) - 1) / _OCTAVE
        within = self.first - beside <= math.log2(least) and math.log2(most) <= last + beside
        return within or not len(self.sizes)

    def turned(self, rotation: Array) -> "LobeLight":
        """The light under a rotation [3,3] of object space."""
        return self._replace(turn=self.turn @ rotation.T)

    def skies_alone(self) -> "LobeLight":
        """The light without its suns."""
        return self._with_suns(slice(0))

    def sun_alone(self, number: int) -> "LobeLight":
        """One of the suns, without anything else."""
        empty = self._replace(texels=self.texels[:0], sizes=self.sizes[:0], starts=self.starts[:0])
        return empty._with_suns(slice(number, number + 1))

    def _with_suns(self, some: slice) -> "LobeLight":
        return self._replace(directions=self.directions[some], irradiance=self.irradiance[some], discs=self.discs[some])


def lobe_light(lighting: Lighting, degree: int, least: float, most: float) -> LobeLight:
    """A lighting for lobes of a sharpness from `least` to `most`, beside harmonics up to `degree`."""
    split = split_lighting(lighting)
    wide = [sun for sun in split.suns if sun.angular_diameter > WIDEST]
    suns = [sun for sun in split.suns if sun.angular_diameter <= WIDEST]
    first = math.floor(_OCTAVE * math.log2(least)) / _OCTAVE
    texels, sizes = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
    if split.skies or wide:
        count = math.ceil(_OCTAVE * (math.log2(most) - first)) + 1
        texels, sizes = _averages(_detail(split.skies, wide, degree), 2.0 ** (first + np.arange(count) / _OCTAVE))
    return LobeLight(
        texels,
        sizes,
        np.cumsum(sizes**2) - sizes**2,
        first,
        np.array([sun.direction for sun in suns]).reshape(-1, 3),
        np.array([sun.irradiance for sun in suns]).reshape(-1, 3),
        np.array([4.0 / max(math.radians(sun.angular_diameter) / 2.0, 1e-6) ** 2 for sun in suns]),
        degree,
        np.eye(3),
    )


def lobe_radiance(light: LobeLight, axes: Array, sharpness: Array, powers: Array) -> Array:
    """Radiance [n,3] of lobes: axes [n,J,3], sharpness [n,J], 0 without a lobe, and powers [n,J,3]."""
    total = np.zeros((len(axes), 3))
    _add_lobes(tuple(light), np.ascontiguousarray(axes @ light.turn.T), sharpness, powers, np.zeros(3), total)
    return total


def _detail(skies: Sequence[Sky], discs: Sequence[DirectionalLight], degree: int) -> Array:
    """Mean radiance [m,m,3] of the cells of an octahedron, less its harmonics."""
    towards = texel_directions(_CELLS).reshape(-1, 3)
    cell = 4.0 * math.pi / len(towards)
    cells = np.zeros(towards.shape)
    for sky in skies:
        cells += radiance(prefilter(sky.image, sky.to_object, cell), towards, np.full(len(towards), cell))
    for sun in discs:
        inside = in_disc(sun, towards)
        cells[inside] += sun.irradiance / (cell * inside.sum())
    basis = np.linalg.qr(sh.evaluate(towards, degree))[0]
    return np.asarray(cells - basis @ (basis.T @ cells)).reshape(_CELLS, _CELLS, 3)


def _averages(detail: Array, sharpness: Array) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Averages of cells [m,m,3] with Gaussians of each sharpness [L]: texels of all levels, and their sizes."""
    sizes = np.maximum(np.ceil(_TEXELS_A_WIDTH * np.sqrt(sharpness)), _FEWEST).astype(np.int64)
    ends = np.cumsum(sizes**2)
    texels = np.empty((int((sizes**2).sum()), 3), np.float32)
    for level in reversed(range(len(sizes))):
        size = int(sizes[level])
        while len(detail) // 2 >= size:
            detail = 0.25 * (detail[::2, ::2] + detail[1::2, ::2] + detail[::2, 1::2] + detail[1::2, 1::2])
        axes, towards = texel_directions(size).reshape(-1, 3), texel_directions(len(detail))
        part = texels[ends[level] - size**2 : ends[level]]
        in_threads(_average, len(axes), axes, sharpness[level], towards, *_blocks(towards), detail, part)
    return texels, sizes


def _blocks(towards: Array) -> tuple[Array, Array]:
    """The middles [b,b,3] of blocks of cells [m,m,3], and the largest angles [b,b] of their cells from them."""
    count = len(towards) // _BLOCK
    cells = towards.reshape(count, _BLOCK, count, _BLOCK, 3)
    middles = cells.sum(axis=(1, 3))
    middles /= np.linalg.norm(middles, axis=-1, keepdims=True)
    cosines = np.einsum("ipjqc,ijc->ijpq", cells, middles).min(axis=(2, 3))
    return middles, np.arccos(np.minimum(cosines, 1.0))


@compiled(nogil=True, error_model="numpy")
def _average(
    first: Any, stop: Any, axes: Any, sharpness: Any, towards: Any, middles: Any, radii: Any, detail: Any, means: Any
) -> None:
    reach = math.acos(max(1.0 - _REACH / sharpness, -1.0))
    for n in range(first, stop):
        x, y, z = axes[n]
        total = red = green = blue = 0.0
        for block in range(radii.size):
            i, j = block // radii.shape[1], block % radii.shape[1]
            cosine = x * middles[i, j, 0] + y * middles[i, j, 1] + z * middles[i, j, 2]
            farthest = reach + radii[i, j]
            if farthest < math.pi and cosine < math.cos(farthest):
                continue
            for row in range(_BLOCK * i, _BLOCK * i + _BLOCK):
                for column in range(_BLOCK * j, _BLOCK * j + _BLOCK):
                    cosine = x * towards[row, column, 0] + y * towards[row, column, 1] + z * towards[row, column, 2]
                    weight = math.exp(sharpness * (cosine - 1.0))
                    total += weight
                    red += weight * detail[row, column, 0]
                    green += weight * detail[row, column, 1]
                    blue += weight * detail[row, column, 2]
        means[n, 0], means[n, 1], means[n, 2] = red / total, green / total, blue / total


@compiled(error_model="numpy")
def _add_lobes(light: Any, axes: Any, sharpness: Any, powers: Any, mean: Any, total: Any) -> None:
    for n in range(axes.shape[0]):
        for j in range(axes.shape[1]):
            if sharpness[n, j] > 0.0:
                axis = axes[n, j, 0], axes[n, j, 1], axes[n, j, 2]
                add_lobe(light, axis, sharpness[n, j], powers[n, j], mean, total[n])


@compiled(error_model="numpy")
def add_lobe(light: Any, axis: Any, sharpness: Any, power: Any, mean: Any, total: Any) -> None:
    """Add to total [3] the radiance of a lobe under a `LobeLight`, in whose frame its axis is. mean [3]: scratch."""
    texels, sizes, starts, first, directions, irradiance, discs, degree, _turn = light
    last = len(sizes) - 1
    if last >= 0:
        u, v = to_square(axis[0], axis[1], axis[2])
        level = min(max(_OCTAVE * (math.log2(sharpness) - first), 0.0), float(last))
        low = min(int(level), last)
        high, share = min(low + 1, last), level - low
        mean[:] = 0.0
        add_bilinear(texels, starts[low], sizes[low], u, v, 1.0 - share, mean)
        if share > 0.0:
            add_bilinear(texels, starts[high], sizes[high], u, v, share, mean)
        for c in range(3):
            total[c] += power[c] * mean[c]
    for s in range(directions.shape[0]):
        cosine = axis[0] * directions[s, 0] + axis[1] * directions[s, 1] + axis[2] * directions[s, 2]
        blurred = 1.0 / (1.0 / sharpness + 1.0 / discs[s])
        value = beyond_harmonics(cosine, blurred, degree)
        for c in range(3):
            total[c] += power[c] * value * irradiance[s, c]
