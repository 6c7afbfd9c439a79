"""A multiple-scattering lobe that compensates the energy loss of single scattering at a rough interface.

`sample_interface` ends a path at the second microfacet. With `energy_compensation` such a path continues along an
additional lobe instead, so that an event conserves energy exactly, whatever the precision of the table. The loss L(i)
is the probability of this. The lobe is built from L, as in Kulla and Conty 2017 ("Revisiting physically based shading
at Imageworks"), and is reciprocal up to the squared index ratio. The loss of the rarer side goes into the denser one.
Of the loss of the denser side, reciprocity fixes the part that is transmitted; the rest is reflected:

    k(i, o) = L(i) |o·n| L(o) / (π L̄)   times   1, ρ² or 1 − ρ² L̄_rarer / L̄

for rarer → denser, denser → rarer, and reflection in the denser medium. L̄ = ∫ L d(μ²) is that of the denser side, ρ
the rarer index over the denser one; L(i) and L(o) belong to the sides of i and o.

Reflection outside thus remains that of Walter et al. 2007, which pictures add separately. In a random walk over Smith's
microsurface (Heitz et al. 2016, "Multiple-scattering microfacet BSDFs with the Smith model") at eta 1.4, 92 % of the
loss on the rarer side goes inwards at alpha 0.3, 97 % at 0.6, 98 % at 1 (`tests/tracer/test_compensation.py`).
"""

import math
from typing import Any

from prt_bake.jit.kernel_functions import called_function
from prt_bake.mathematics.counter import uniform
from prt_bake.tracer.surface.interface import refract
from prt_bake.tracer.surface.losses import (
    CELLS,
    CUMULATIVE,
    ETA,
    LOSS,
    MEAN,
    ROUGHNESS,
    outgoing_masking,
    sample_microfacet,
)


@called_function()
def _table_position(losses: Any, alpha: Any, eta: Any) -> Any:
    """Row of the relative index, next lower roughness node, and interpolation weight of the node above."""
    row = 0
    for e in range(1, losses.shape[0]):
        if abs(losses[e, 0, ETA] - eta) < abs(losses[row, 0, ETA] - eta):
            row = e
    last = losses.shape[1] - 1
    if last == 0:
        return row, 0, 0.0
    low, high = losses[row, 0, ROUGHNESS], losses[row, last, ROUGHNESS]
    step = min(max((alpha - low) / (high - low), 0.0), 1.0) * last
    node = min(int(step), last - 1)
    return row, node, step - node


@called_function()
def _mean_loss(losses: Any, row: Any, node: Any, fraction: Any) -> Any:
    mean = losses[row, node, MEAN]
    if fraction > 0.0:
        mean += fraction * (losses[row, node + 1, MEAN] - mean)
    return mean


@called_function()
def _loss_at_node(table: Any, cosine: Any) -> Any:
    cell = min(int(CELLS * math.sqrt(cosine)), CELLS - 1)
    low, high = (cell / CELLS) ** 4, ((cell + 1) / CELLS) ** 4
    share = (cosine * cosine - low) / (high - low)
    return table[LOSS + cell] + share * (table[LOSS + cell + 1] - table[LOSS + cell])


@called_function()
def _loss(losses: Any, row: Any, node: Any, fraction: Any, cosine: Any) -> Any:
    loss = _loss_at_node(losses[row, node], cosine)
    if fraction > 0.0:
        loss += fraction * (_loss_at_node(losses[row, node + 1], cosine) - loss)
    return loss


@called_function()
def _share_through(losses: Any, eta: Any, row: Any, node: Any, fraction: Any) -> Any:
    """Transmitted share of the loss on this side."""
    here = _mean_loss(losses, row, node, fraction)
    if eta > 1.0 or here <= 0.0:
        return 1.0
    return min(1.0, eta * eta * _mean_loss(losses, row ^ 1, node, fraction) / here)


@called_function()
def returned_density(losses: Any, alpha: Any, eta: Any, iz: Any, oz: Any) -> Any:
    """f(i, o) |o·n| of the compensating lobe per solid angle of o, to be added to `rough_density`."""
    if iz <= 0.0 or oz == 0.0:
        return 0.0
    row, node, fraction = _table_position(losses, alpha, eta)
    through = _share_through(losses, eta, row, node, fraction)
    share = through if oz < 0.0 else 1.0 - through
    to = row ^ 1 if oz < 0.0 else row
    mean = _mean_loss(losses, to, node, fraction)
    if share <= 0.0 or mean <= 0.0:
        return 0.0
    lobe = abs(oz) * _loss(losses, to, node, fraction, abs(oz)) / (math.pi * mean)
    return share * _loss(losses, row, node, fraction, iz) * lobe


@called_function()
def _sample_lobe(losses: Any, row: Any, node: Any, fraction: Any, stream: Any) -> Any:
    """Sample a direction (x, y, z > 0) with density |z| L(z) / (π L̄)."""
    mean = _mean_loss(losses, row, node, fraction)
    if fraction > 0.0 and uniform(stream) * mean < fraction * losses[row, node + 1, MEAN]:
        node += 1
    table = losses[row, node]
    sought = uniform(stream) * table[MEAN]
    low, high = 0, CELLS
    while high - low > 1:
        middle = (low + high) // 2
        if table[CUMULATIVE + middle] <= sought:
            low = middle
        else:
            high = middle
    first, last = table[LOSS + low], table[LOSS + low + 1]
    width = ((low + 1) / CELLS) ** 4 - (low / CELLS) ** 4
    rest = (sought - table[CUMULATIVE + low]) / width
    # The root of a t + (b − a) t² / 2 = rest in a form that is accurate for a ≈ b and for 0.
    root = math.sqrt(max(0.0, first * first + 2.0 * (last - first) * rest))
    below = first + root
    share = min(1.0, 2.0 * rest / below) if below > 0.0 else 1.0
    squared = min(1.0, (low / CELLS) ** 4 + share * width)
    sine, angle = math.sqrt(1.0 - squared), 2.0 * math.pi * uniform(stream)
    return sine * math.cos(angle), sine * math.sin(angle), max(1e-9, math.sqrt(squared))


@called_function()
def sample_compensated(
    losses: Any, alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, transmit_only: Any, stream: Any
) -> Any:
    """`sample_interface` for a compensated rough interface: (ox, oy, oz, weight).

    The weight is 1. With `transmit_only` it is the total transmittance of the sampled microfacet.
    """
    mx, my, mz, cosine, reflectance = sample_microfacet(alpha, eta, ix, iy, iz, uniform(stream), uniform(stream))
    up, down = outgoing_masking(alpha, eta, ix, iy, iz, mx, my, mz, cosine)
    row, node, fraction = _table_position(losses, alpha, eta)
    through = _share_through(losses, eta, row, node, fraction)
    weight = 1.0
    if transmit_only:
        straight = (1.0 - reflectance) * down
        lost = reflectance * (1.0 - up) + (1.0 - reflectance) * (1.0 - down)
        weight = straight + lost * through
        single = uniform(stream) * weight < straight
        reflects, through = False, 1.0
    else:
        reflects = uniform(stream) < reflectance
        single = uniform(stream) < (up if reflects else down)
    if single and reflects:
        return 2.0 * cosine * mx - ix, 2.0 * cosine * my - iy, 2.0 * cosine * mz - iz, weight
    if single:
        ox, oy, oz = refract(ix, iy, iz, mx, my, mz, cosine, eta)
        return ox, oy, oz, weight
    if uniform(stream) < through:
        ox, oy, oz = _sample_lobe(losses, row ^ 1, node, fraction, stream)
        return ox, oy, -oz, weight
    ox, oy, oz = _sample_lobe(losses, row, node, fraction, stream)
    return ox, oy, oz, weight
