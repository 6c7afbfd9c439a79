"""Lobes of a network: narrow beams of light that crosses an object almost unscattered.

Behind a rough interface this light is a part of Ŝ: a few per cent in thick objects, most of it in clear ones. It stays
within about ten degrees of one direction, which moves with x and ωo. The late layers of a network are smooth in ωi and
can only blur it. The trunk therefore also predicts, for each view, the axes μₖ, sharpness κₖ and means Eₖ of lobes, and

    Σₖ Eₖ · 2κₖ / (1 − exp(−2κₖ)) · exp(κₖ (ωi·μₖ − 1))

is added to Ŝ. These are spherical Gaussians (Wang et al. 2009, "All-frequency rendering of dynamic, spatially-varying
reflectance") with mean Eₖ over the sphere, so that energy and sharpness are learned independently.

Spherical harmonic coefficients of lobes need no directions: 2κ/(1 − exp(−2κ)) exp(κ(c − 1)) = Σₗ (2l + 1) Aₗ(κ) Pₗ(c)
with Aₗ = I_{l+½}(κ)/I_{½}(κ). Only the bands up to the requested degree are evaluated.
"""

from typing import NamedTuple

import torch
from torch import Tensor

LOBE_PARAMETERS = 7
"""Parameters of a lobe: mean in three channels (before the softplus), logarithm of the sharpness, direction."""
_INITIAL_MEAN = -3.0
"""The initial mean before the softplus, which makes it 0.05 of the output scale."""
_INITIAL_LOG_SHARPNESS, _MIN_LOG_SHARPNESS, _MAX_LOG_SHARPNESS = 3.4, 1.6, 5.5
"""Logarithms of the sharpness: widths of 10°, 26° and 3.7°."""
_EXTRA_BANDS = 16
"""Bands above the degree at which the downward recurrence of Aₗ starts: its error is then below 10⁻⁵."""


class Lobes(NamedTuple):
    """K lobes of each of N views, over the output scale.

    Attributes:
        axes: [N,K,3], unit vectors μ.
        sharpness: [N,K], κ.
        peaks: [N,K,3], values along the axes.
    """

    axes: Tensor
    sharpness: Tensor
    peaks: Tensor


class Bands(NamedTuple):
    """K lobes of each of N views, limited to degree L.

    Attributes:
        axes: [N,K,3], unit vectors.
        weights: [N,K,L+1], weights of the Legendre polynomials of the cosine to the axis.
        peaks: [N,K,3], factors of their sums.
    """

    axes: Tensor
    weights: Tensor
    peaks: Tensor


def decode_lobes(parameters: Tensor, exits: Tensor) -> Lobes:
    """The lobes of parameters [N, LOBE_PARAMETERS·K], for views whose rays leave the object along exits [N,3].

    Parameters of 0 give faint lobes along the exits.
    """
    each = parameters.float().reshape(len(parameters), -1, LOBE_PARAMETERS)
    mean = _softplus(each[..., :3] + _INITIAL_MEAN)
    sharpness = (each[..., 3] + _INITIAL_LOG_SHARPNESS).clamp(_MIN_LOG_SHARPNESS, _MAX_LOG_SHARPNESS).exp()
    axes = torch.nn.functional.normalize(each[..., 4:] + exits.float()[:, None], dim=-1)
    return Lobes(axes, sharpness, mean * _peak(sharpness)[..., None])


def evaluate_lobes(lobes: Lobes, incident: Tensor, degree: int | None = None) -> Tensor:
    """The sum of the lobes [N,D,3] in directions incident [N,D,3]; only their bands up to `degree` if it is given."""
    if degree is not None:
        return evaluate_bands(lobe_bands(lobes, degree), incident)
    total = torch.zeros_like(incident, dtype=torch.float32)
    for axis, sharpness, peak in zip(*(part.unbind(dim=1) for part in lobes), strict=True):
        shape = torch.exp(sharpness[:, None] * (_cosine(axis, incident) - 1.0))
        total = total + shape[..., None] * peak[:, None]
    return total


def lobe_bands(lobes: Lobes, degree: int) -> Bands:
    """The bands of lobes up to a degree: weights (2l + 1) Aₗ(κ)."""
    ratios = torch.stack(_bessel_ratios(lobes.sharpness.double(), degree), dim=-1)
    weights = ratios * (2.0 * torch.arange(degree + 1, device=ratios.device) + 1.0)
    return Bands(lobes.axes, weights.float(), lobes.peaks / _peak(lobes.sharpness)[..., None])


def evaluate_bands(bands: Bands, incident: Tensor) -> Tensor:
    """The sum of the bands [N,D,3] in directions incident [N,D,3]."""
    total = torch.zeros_like(incident, dtype=torch.float32)
    for axis, weights, peak in zip(*(part.unbind(dim=1) for part in bands), strict=True):
        cosine = _cosine(axis, incident)
        series, previous, value = weights[:, :1], torch.ones_like(cosine), cosine
        for band in range(1, weights.shape[1]):
            series = series + weights[:, band, None] * value
            previous, value = value, ((2 * band + 1) * cosine * value - band * previous) / (band + 1)
        total = total + series[..., None] * peak[:, None]
    return total


def _cosine(axis: Tensor, incident: Tensor) -> Tensor:
    """Cosines [N,D] of axes [N,3] and directions [N,D,3].

    No matrix product: its rounding of one view would depend on how many others are in the batch.
    """
    x, y, z = incident.float().unbind(dim=-1)
    a, b, c = axis[:, None].unbind(dim=-1)
    return x * a + y * b + z * c


def _bessel_ratios(kappa: Tensor, degree: int) -> list[Tensor]:
    """A₀ … A_degree for sharpness κ [N].

    The recurrence Aₗ/Aₗ₋₁ = 1/((2l + 1)/κ + Aₗ₊₁/Aₗ) runs downward, which is stable. It starts between the bounds of
    Amos (1974), "Computation of modified Bessel functions and their ratios".
    """
    last = degree + _EXTRA_BANDS
    ratio = kappa / (last + ((last + 0.5) ** 2 + kappa**2).sqrt())
    ratios: list[Tensor] = []
    for band in range(last - 1, 0, -1):
        ratio = 1.0 / ((2 * band + 1) / kappa + ratio)
        ratios.append(ratio)
    values = [torch.ones_like(kappa)]
    for ratio in ratios[::-1][:degree]:
        values.append(values[-1] * ratio)
    return values


def mean_square(lobes: Lobes) -> Tensor:
    """The mean over the sphere [N,3] of (Σ lobes)², in closed form: few sampled directions would hit a lobe."""
    axes, sharpness, peaks = lobes
    scaled = sharpness[..., None] * axes
    joint = torch.linalg.vector_norm(scaled[:, :, None] + scaled[:, None], dim=-1).clamp(min=1e-3)
    pairs = torch.exp(joint - sharpness[:, :, None] - sharpness[:, None]) / _peak(joint)
    return torch.einsum("njc,nkc,njk->nc", peaks, peaks, pairs)


def _softplus(x: Tensor) -> Tensor:
    """As torch's softplus, whose last bits depend on how many numbers are in the batch; these do not."""
    return torch.relu(x) + torch.log1p(torch.exp(-x.abs()))


def _peak(sharpness: Tensor) -> Tensor:
    """The ratio of a lobe's value along its axis to its mean over the sphere."""
    return 2.0 * sharpness / -torch.expm1(-2.0 * sharpness)
