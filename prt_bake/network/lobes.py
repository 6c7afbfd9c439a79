"""Lobes of a network: light that crosses an object almost unscattered leaves it as a narrow beam.

Behind a rough interface such light is a part of Ŝ: a few per cent of it in thick objects, most of it in clear ones,
within some ten degrees of one direction that moves with x and ωo. The late layers of a network are smooth in ωi and
can only blur it. So the layers before them say besides, for each view, where lobes point, how sharp they are and what
they carry, and Ŝ gets

    Σₖ Eₖ · 2κₖ / (1 − exp(−2κₖ)) · exp(κₖ (ωi·μₖ − 1))

added: spherical Gaussians (Wang et al. 2009, "All-frequency rendering of dynamic, spatially-varying reflectance") whose
mean over the sphere is Eₖ, so that what a lobe carries and how sharp it is are learnt apart.

Whoever wants coefficients up to a degree needs no directions to find those of lobes: 2κ/(1 − exp(−2κ)) exp(κ(c − 1)) is
Σₗ (2l + 1) Aₗ(κ) Pₗ(c) with Aₗ = I_{l+½}(κ)/I_{½}(κ), and its bands up to the degree are all that is asked for.
"""

from typing import NamedTuple

import torch
from torch import Tensor

LOBE_PARAMETERS = 7
"""That a lobe is made of: what it carries in three channels, the logarithm of its sharpness, its direction."""
_FAINT = -3.0
"""What a lobe carries at first: the softplus of it, 0.05 of the output scale."""
_SHARPNESS, _LEAST, _MOST = 3.4, 1.6, 5.5
"""Logarithms of sharpness: at first (10°), at least (26°) and at most (3.7°)."""
_BANDS_ABOVE = 16
"""From which the shares of bands are computed downwards: what is not known there is below 10⁻⁵ of them then."""


class Lobes(NamedTuple):
    """K lobes of each of N views, over the output scale.

    Attributes:
        axes: [N,K,3], unit vectors μ.
        sharpness: [N,K], κ.
        peaks: [N,K,3], what a lobe adds along its axis.
    """

    axes: Tensor
    sharpness: Tensor
    peaks: Tensor


class Bands(NamedTuple):
    """What K lobes of each of N views are up to a degree L.

    Attributes:
        axes: [N,K,3], unit vectors.
        weights: [N,K,L+1], of the Legendre polynomials of the cosine to the axis.
        peaks: [N,K,3], what their sum is multiplied by.
    """

    axes: Tensor
    weights: Tensor
    peaks: Tensor


def decode_lobes(told: Tensor, exits: Tensor) -> Lobes:
    """The lobes that numbers [N, LOBE_PARAMETERS·K] tell of views whose rays leave along exits [N,3]: zeros are faint lobes
    there.
    """
    each = told.float().reshape(len(told), -1, LOBE_PARAMETERS)
    carried = _softplus(each[..., :3] + _FAINT)
    sharpness = (each[..., 3] + _SHARPNESS).clamp(_LEAST, _MOST).exp()
    axes = torch.nn.functional.normalize(each[..., 4:] + exits.float()[:, None], dim=-1)
    return Lobes(axes, sharpness, carried * _peak(sharpness)[..., None])


def evaluate_lobes(lobes: Lobes, incident: Tensor, degree: int | None = None) -> Tensor:
    """What the lobes add [N,D,3] in directions incident [N,D,3]; of it the bands up to `degree` alone, if given."""
    if degree is not None:
        return evaluate_bands(lobe_bands(lobes, degree), incident)
    added = torch.zeros_like(incident, dtype=torch.float32)
    for axis, sharpness, peak in zip(*(part.unbind(dim=1) for part in lobes), strict=True):
        shape = torch.exp(sharpness[:, None] * (_cosine(axis, incident) - 1.0))
        added = added + shape[..., None] * peak[:, None]
    return added


def lobe_bands(lobes: Lobes, degree: int) -> Bands:
    """The bands up to a degree: Σₗ (2l + 1) Aₗ(κ) Pₗ over the value along the axis."""
    shares = torch.stack(_band_ratios(lobes.sharpness.double(), degree), dim=-1)
    weights = shares * (2.0 * torch.arange(degree + 1, device=shares.device) + 1.0)
    return Bands(lobes.axes, weights.float(), lobes.peaks / _peak(lobes.sharpness)[..., None])


def evaluate_bands(bands: Bands, incident: Tensor) -> Tensor:
    """What these bands add [N,D,3] in directions incident [N,D,3]."""
    added = torch.zeros_like(incident, dtype=torch.float32)
    for axis, weights, peak in zip(*(part.unbind(dim=1) for part in bands), strict=True):
        cosine = _cosine(axis, incident)
        summed, before, value = weights[:, :1], torch.ones_like(cosine), cosine
        for band in range(1, weights.shape[1]):
            summed = summed + weights[:, band, None] * value
            before, value = value, ((2 * band + 1) * cosine * value - band * before) / (band + 1)
        added = added + summed[..., None] * peak[:, None]
    return added


def _cosine(axis: Tensor, incident: Tensor) -> Tensor:
    """[N,D], of axes [N,3] and directions [N,D,3]; number by number, no products of matrices: a view's sums must not
    depend on how many others stand beside it.
    """
    x, y, z = incident.float().unbind(dim=-1)
    a, b, c = axis[:, None].unbind(dim=-1)
    return x * a + y * b + z * c


def _band_ratios(kappa: Tensor, degree: int) -> list[Tensor]:
    """A₀ … of a degree for sharpness κ [N].

    Aₗ/Aₗ₋₁ = 1/((2l + 1)/κ + Aₗ₊₁/Aₗ), from above downwards, where errors shrink, begun between the bounds of Amos
    (1974), "Computation of modified Bessel functions and their ratios".
    """
    last = degree + _BANDS_ABOVE
    ratio = kappa / (last + ((last + 0.5) ** 2 + kappa**2).sqrt())
    ratios: list[Tensor] = []
    for band in range(last - 1, 0, -1):
        ratio = 1.0 / ((2 * band + 1) / kappa + ratio)
        ratios.append(ratio)
    shares = [torch.ones_like(kappa)]
    for ratio in ratios[::-1][:degree]:
        shares.append(shares[-1] * ratio)
    return shares


def mean_square(lobes: Lobes) -> Tensor:
    """The mean over the sphere [N,3] of (Σ lobes)², exactly: few directions would hardly ever meet a lobe."""
    axes, sharpness, peaks = lobes
    weighed = sharpness[..., None] * axes
    joint = torch.linalg.vector_norm(weighed[:, :, None] + weighed[:, None], dim=-1).clamp(min=1e-3)
    pairs = torch.exp(joint - sharpness[:, :, None] - sharpness[:, None]) / _peak(joint)
    return torch.einsum("njc,nkc,njk->nc", peaks, peaks, pairs)


def _softplus(x: Tensor) -> Tensor:
    """As torch has it, but for the last bits: those of torch's depend on how many numbers stand beside one."""
    return torch.relu(x) + torch.log1p(torch.exp(-x.abs()))


def _peak(sharpness: Tensor) -> Tensor:
    """The value along the axis over the mean over the sphere."""
    return 2.0 * sharpness / -torch.expm1(-2.0 * sharpness)
