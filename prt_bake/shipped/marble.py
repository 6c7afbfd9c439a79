"""The shipped scene's marble: grids of sigma_t and albedo with veins at the zeros of a sum of random waves.

`python -m prt_bake.shipped.marble` writes `sigma_t.npy` and `albedo.npy` beside this file; a test compares them.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

BOUNDS = ((-0.5, -0.75, -0.7), (0.5, 1.05, 1.1))
"""Lowest and highest corner of the grids' box around Spot."""
SHAPE = (36, 36, 20)
SEED = 20

_STONE_SIGMA_T, _VEIN_SIGMA_T = 16.0, 40.0
_STONE_ALBEDO = np.array([0.990, 0.970, 0.900])
_VEIN_ALBEDO = np.array([0.72, 0.93, 0.86])
_VEIN_WIDTH = 0.3
_WAVES, _OCTAVES, _CYCLES_A_UNIT = 10, 2, 0.3


def veins() -> NDArray[np.float64]:
    """Return the weight of the vein in each cell [Z,Y,X], 0 to 1."""
    generator = np.random.default_rng(SEED)
    low, high = np.array(BOUNDS)
    axes = [
        low[k] + (np.arange(n) + 0.5) / n * (high[k] - low[k]) for k, n in ((2, SHAPE[0]), (1, SHAPE[1]), (0, SHAPE[2]))
    ]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    field = np.zeros(SHAPE)
    for octave in range(_OCTAVES):
        for _ in range(_WAVES):
            kx, ky, kz = generator.normal(size=3) * _CYCLES_A_UNIT * 2.0**octave
            phase = generator.uniform(0.0, 1.0)
            field += np.sin(2.0 * np.pi * (kx * x + ky * y + kz * z + phase)) / 2.0**octave
    field /= np.sqrt(np.mean(field**2))
    return np.exp(-((field / _VEIN_WIDTH / 2.0) ** 2))


def grids() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return sigma_t [Z,Y,X] per scene unit and albedo [Z,Y,X,3]."""
    weight = veins()
    sigma_t = _STONE_SIGMA_T + (_VEIN_SIGMA_T - _STONE_SIGMA_T) * weight
    albedo = _STONE_ALBEDO + (_VEIN_ALBEDO - _STONE_ALBEDO) * weight[..., None]
    return sigma_t.astype(np.float32), albedo.astype(np.float32)


def write(folder: Path) -> None:
    """Write both grids into a folder."""
    sigma_t, albedo = grids()
    np.save(folder / "sigma_t.npy", sigma_t)
    np.save(folder / "albedo.npy", albedo)


if __name__ == "__main__":
    write(Path(__file__).parent)
