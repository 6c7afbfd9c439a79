"""Fourier features [cos 2πGu, sin 2πGu] of positions and directions (Tancik et al. 2020)."""

import torch
from torch import Tensor


def encode_directions(directions: Tensor, form: str) -> Tensor:
    """Unit vectors [...,3] as network inputs, in float64.

    form "cartesian": the vectors themselves [...,3]; "spherical": (θ/π, φ/2π) [...,2] about z, φ in [0, 2π).
    """
    d = directions.double()
    if form == "cartesian":
        return d
    theta = torch.atan2(torch.linalg.vector_norm(d[..., :2], dim=-1), d[..., 2])
    phi = torch.atan2(d[..., 1], d[..., 0]) % (2.0 * torch.pi)
    return torch.stack((theta / torch.pi, phi / (2.0 * torch.pi)), dim=-1)


def fourier_features(u: Tensor, frequencies: Tensor, mean: float = 0.0) -> Tensor:
    """[cos 2πGu, sin 2πGu] [..., 2F] in float32 of float64 inputs u [...,K]; G is `frequencies` [F,K].

    `mean` is the mean of G. Its share of the phase is the same for all frequencies and is reduced to a fraction of a
    cycle in float64. Float32 then holds only the deviations from it, and the features are exact to a few 10⁻⁶.
    Autocast is switched off: in half precision a phase of several cycles would lose a tenth of a radian.
    """
    with torch.autocast(u.device.type, enabled=False):
        cycles = u.float() @ (frequencies.double() - mean).float().T
        if mean:
            cycles = cycles + ((u.sum(dim=-1, keepdim=True) * mean) % 1.0).float()
        phase = (2.0 * torch.pi) * cycles
        return torch.cat((phase.cos(), phase.sin()), dim=-1)
