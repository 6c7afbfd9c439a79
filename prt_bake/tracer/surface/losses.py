"""Energy loss of single scattering at a rough interface, which ends paths at the second microfacet.

The loss at cosine μ is L(μ) = 1 − E(μ), with E the directional albedo for reflection and transmission together.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.kernel_functions import called_function
from prt_bake.mathematics.fresnel import fresnel
from prt_bake.tracer.surface.interface import masking, refract, visible_microfacet

CELLS = 48
"""Cells of the table over μ². Node j is at (j / CELLS)⁴, since the loss varies most at grazing angles."""
_STRATA = (64, 64)
_ALPHAS = 24
ETA, ROUGHNESS, MEAN, LOSS = 0, 1, 2, 3
CUMULATIVE = LOSS + CELLS + 1
ROW_SIZE = CUMULATIVE + CELLS + 1

Array = NDArray[np.float64]


def loss_tables(etas: list[float], alphas: tuple[float, float]) -> Array:
    """Tables [E,A,ROW_SIZE] for relative indices and GGX roughnesses between the two `alphas`.

    A row holds eta, alpha, L̄, L at the nodes of μ², and the integral of L up to each node.
    """
    count = 1 if alphas[1] <= alphas[0] else _ALPHAS
    steps = np.linspace(alphas[0], alphas[1], count)
    return np.ascontiguousarray([[_row(float(eta), float(alpha)) for alpha in steps] for eta in etas])


def no_losses() -> Array:
    """The table of a scene without compensated interfaces."""
    return np.zeros((0, 0, 0))


@lru_cache(maxsize=512)
def _row(eta: float, alpha: float) -> Array:
    row = np.zeros(ROW_SIZE)
    nodes = (np.arange(CELLS + 1) / CELLS) ** 4
    losses = row[LOSS:CUMULATIVE]
    losses[:] = np.maximum(0.0, 1.0 - _directional_albedo(eta, alpha, np.sqrt(np.maximum(nodes, 1e-12))).sum(axis=0))
    row[CUMULATIVE + 1 :] = np.cumsum(0.5 * (losses[1:] + losses[:-1]) * np.diff(nodes))
    row[ETA], row[ROUGHNESS], row[MEAN] = eta, alpha, row[-1]
    return row


@compiled()
def _directional_albedo(eta: float, alpha: float, cosines: Array) -> Array:
    """Directional albedo [2,N] of single scattering at each cosine: reflected, transmitted.

    Quadrature over visible normals on one side of the plane of incidence, finer for steep ones (u1 = 1 − v²).
    """
    rows, columns = _STRATA
    albedo = np.zeros((2, len(cosines)))
    for j in range(len(cosines)):
        ix, iz = math.sqrt(1.0 - cosines[j] ** 2), cosines[j]
        for a in range(rows):
            for b in range(columns):
                v, u2 = (a + 0.5) / rows, 0.5 * (b + 0.5) / columns - 0.25
                mx, my, mz, cosine, reflectance = sample_microfacet(alpha, eta, ix, 0.0, iz, 1.0 - v * v, u2)
                up, down = outgoing_masking(alpha, eta, ix, 0.0, iz, mx, my, mz, cosine)
                albedo[0, j] += 2.0 * v * reflectance * up / (rows * columns)
                albedo[1, j] += 2.0 * v * (1.0 - reflectance) * down / (rows * columns)
    return albedo


def furnace_loss(alpha: float, eta: float) -> float:
    """Energy that single scattering at a rough boundary loses in a white furnace, for any shape of the object.

    Light inside a white object returns to the boundary, diffusely, until it is transmitted or lost. With R and T of the
    outer side, T' = T / eta² and L' of the inner side, the loss is 1 − R − T T' / (T' + L'); all are means over μ².
    """
    nodes, weights = np.polynomial.legendre.leggauss(32)
    cosines, weights = np.sqrt(0.5 * (nodes + 1.0)), 0.5 * weights
    reflected, through = _directional_albedo(eta, alpha, cosines) @ weights
    lost_inside = 1.0 - float((_directional_albedo(1.0 / eta, alpha, cosines) @ weights).sum())
    out = through / eta**2
    return float(1.0 - reflected - through * out / (out + max(0.0, lost_inside)))


@called_function()
def sample_microfacet(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, u1: Any, u2: Any) -> Any:
    """Sample a visible microfacet: its normal, its cosine to i, and its Fresnel reflectance."""
    mx, my, mz = visible_microfacet(ix, iy, iz, alpha, u1, u2)
    cosine = max(0.0, ix * mx + iy * my + iz * mz)
    return mx, my, mz, cosine, fresnel(cosine, eta)


@called_function()
def outgoing_masking(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, mx: Any, my: Any, mz: Any, cosine: Any) -> Any:
    """Smith masking G1 of the directions that a microfacet reflects and refracts to; 0 on the wrong side."""
    oz = 2.0 * cosine * mz - iz
    up = masking(oz, alpha) if oz > 0.0 else 0.0
    _x, _y, oz = refract(ix, iy, iz, mx, my, mz, cosine, eta)
    down = masking(oz, alpha) if oz < 0.0 else 0.0
    return up, down
