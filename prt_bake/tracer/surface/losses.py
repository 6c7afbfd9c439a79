"""What single scattering on a rough interface loses: the second bounce at a microfacet, where `sample_interface` ends.

The loss L(μ) of light that comes at cosine μ is 1 − E, with E the energy that is reflected or let through.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.jit.without_counts import called_function
from prt_bake.tracer.surface.interface import fresnel, masking, refract, visible_microfacet

CELLS = 48
"""Of the table over μ²; node j lies at (j / CELLS)⁴, since the losses change most at grazing angles."""
_STRATA = (64, 64)
_ALPHAS = 24
ETA, ROUGHNESS, MEAN, LOSS = 0, 1, 2, 3
CUMULATED = LOSS + CELLS + 1
ROW_SIZE = CUMULATED + CELLS + 1

Array = NDArray[np.float64]


def loss_tables(etas: list[float], alphas: tuple[float, float]) -> Array:
    """Losses [E,A,ROW_SIZE] for relative indices and GGX roughnesses from the least to the largest of `alphas`.

    A row holds eta, alpha, L̄, then L at the nodes of μ², and the integral of L up to each.
    """
    count = 1 if alphas[1] <= alphas[0] else _ALPHAS
    steps = np.linspace(alphas[0], alphas[1], count)
    return np.ascontiguousarray([[_row(float(eta), float(alpha)) for alpha in steps] for eta in etas])


def no_losses() -> Array:
    """The table of a scene in which no interface is compensated."""
    return np.zeros((0, 0, 0))


@lru_cache(maxsize=512)
def _row(eta: float, alpha: float) -> Array:
    row = np.zeros(ROW_SIZE)
    nodes = (np.arange(CELLS + 1) / CELLS) ** 4
    losses = row[LOSS:CUMULATED]
    losses[:] = np.maximum(0.0, 1.0 - _kept_at(eta, alpha, np.sqrt(np.maximum(nodes, 1e-12))).sum(axis=0))
    row[CUMULATED + 1 :] = np.cumsum(0.5 * (losses[1:] + losses[:-1]) * np.diff(nodes))
    row[ETA], row[ROUGHNESS], row[MEAN] = eta, alpha, row[-1]
    return row


@compiled()
def _kept_at(eta: float, alpha: float, cosines: Array) -> Array:
    """What single scattering keeps [2,N] of light that comes at each cosine: reflected, and let through.

    The visible microfacets of a grid on one side of the plane of incidence, finer where they are steep (u1 = 1 − v²).
    """
    rows, columns = _STRATA
    kept = np.zeros((2, len(cosines)))
    for j in range(len(cosines)):
        ix, iz = math.sqrt(1.0 - cosines[j] ** 2), cosines[j]
        for a in range(rows):
            for b in range(columns):
                v, u2 = (a + 0.5) / rows, 0.5 * (b + 0.5) / columns - 0.25
                mx, my, mz, cosine, reflectance = microfacet_seen(alpha, eta, ix, 0.0, iz, 1.0 - v * v, u2)
                up, down = kept_of(alpha, eta, ix, 0.0, iz, mx, my, mz, cosine)
                kept[0, j] += 2.0 * v * reflectance * up / (rows * columns)
                kept[1, j] += 2.0 * v * (1.0 - reflectance) * down / (rows * columns)
    return kept


def furnace_loss(alpha: float, eta: float) -> float:
    """The share of a white furnace that single scattering at a rough boundary loses, whatever the object's shape.

    All light that enters a white object comes back to the boundary, evenly spread, until it is let out or lost: with R
    and T of the outer side, T' = T / eta² and L' of the inner one, 1 − R − T T' / (T' + L'), all means over μ².
    """
    nodes, weights = np.polynomial.legendre.leggauss(32)
    cosines, weights = np.sqrt(0.5 * (nodes + 1.0)), 0.5 * weights
    reflected, through = _kept_at(eta, alpha, cosines) @ weights
    lost_inside = 1.0 - float((_kept_at(1.0 / eta, alpha, cosines) @ weights).sum())
    out = through / eta**2
    return float(1.0 - reflected - through * out / (out + max(0.0, lost_inside)))


@called_function()
def microfacet_seen(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, u1: Any, u2: Any) -> Any:
    """A visible microfacet's normal, its cosine to i, and its reflectance."""
    mx, my, mz = visible_microfacet(ix, iy, iz, alpha, u1, u2)
    cosine = max(0.0, ix * mx + iy * my + iz * mz)
    return mx, my, mz, cosine, fresnel(cosine, eta)


@called_function()
def kept_of(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, mx: Any, my: Any, mz: Any, cosine: Any) -> Any:
    """What single scattering keeps of the light that a microfacet reflects, and of what it lets through."""
    oz = 2.0 * cosine * mz - iz
    up = masking(oz, alpha) if oz > 0.0 else 0.0
    _x, _y, oz = refract(ix, iy, iz, mx, my, mz, cosine, eta)
    down = masking(oz, alpha) if oz < 0.0 else 0.0
    return up, down
