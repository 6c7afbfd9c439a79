"""The low bands of a network: the coefficients a_lm to degree 2 of a view, predicted by layers of their own.

Bakes to degree 2 need these alone. The layers that see ωi learn them slowly, since most of what they fit is finer. The
mean of T · Y_lm(ω_exit) over the paths of a query is an unbiased estimate of its a_lm, so these layers fit nine numbers
of each channel by least squares, without sampled directions.

Few directions suffice to evaluate them: Ŝ up to degree 2 is Σ a_lm Y_lm(ωi).

Layers of the same kind correct the values of the layers that see ωi: Σ c_lm Y_lm(ωi) is added to them, where c_lm are
the low bands less the coefficients of these values. So Ŝ has nearly the same coefficients in all uses of a network.
"""

import math

import torch
from torch import Tensor, nn

from prt_bake.network.settings import LEAST_LAYERS, NetworkSettings

LOW_DEGREE = 2
LOW_COUNT = (LOW_DEGREE + 1) ** 2
_CHANNELS = 3


class LowBands(nn.Module):
    """Layers from the features of a view to its coefficients: SiLU, and the first output again before the third."""

    def __init__(self, inputs: int, width: int, layers: int, generator: torch.Generator) -> None:
        """Initial weights by He et al. 2015, drawn by `generator`; the initial coefficients are small."""
        super().__init__()
        self.hidden = nn.ModuleList(nn.Linear(n, m) for m, n in low_shapes(inputs, width, layers)[:-1])
        self.output = nn.Linear(width, LOW_COUNT * _CHANNELS)
        for layer in (*self.hidden, self.output):
            assert isinstance(layer, nn.Linear)
            gain = 0.1 if layer is self.output else 2.0
            with torch.no_grad():
                layer.weight.normal_(0.0, (gain / layer.in_features) ** 0.5, generator=generator)
                layer.bias.zero_()

    def forward(self, features: Tensor) -> Tensor:
        """Coefficients [N,9,3] over the output scale, float32, from features [N,inputs]."""
        silu = torch.nn.functional.silu
        first = h = silu(self.hidden[0](features.to(self.output.weight.dtype)))
        h = silu(self.hidden[1](h))
        h = silu(self.hidden[2](torch.cat((h, first), dim=-1)))
        for layer in self.hidden[LEAST_LAYERS:]:
            h = silu(layer(h))
        coefficients: Tensor = self.output(h).float()
        return coefficients.reshape(-1, LOW_COUNT, _CHANNELS)


def low_bands_of(settings: NetworkSettings, generator: torch.Generator) -> LowBands | None:
    """New low bands of a network; None if its settings leave them out."""
    if not settings.low_width:
        return None
    return LowBands(settings.view_inputs, settings.low_width, settings.low_layers, generator)


def correction_of(settings: NetworkSettings, generator: torch.Generator) -> LowBands | None:
    """New layers that correct the values of a network; None if its settings leave them out."""
    if not settings.correction_width:
        return None
    return LowBands(correction_inputs(settings), settings.correction_width, LEAST_LAYERS, generator)


def correction_inputs(settings: NetworkSettings) -> int:
    """Inputs of the layers that correct the values: the features of a view, and what the trunk makes of them."""
    return settings.view_inputs + settings.width


def low_shapes(inputs: int, width: int, layers: int) -> tuple[tuple[int, int], ...]:
    """(outputs, inputs) of the hidden `layers` and of the output."""
    more = ((width, width),) * (layers - LEAST_LAYERS)
    return ((width, inputs), (width, width), (width, 2 * width), *more, (LOW_COUNT * _CHANNELS, width))


def low_harmonics(directions: Tensor) -> Tensor:
    """Y_lm [...,9] of unit vectors [...,3] to degree 2, float32, in the order of `prt_bake.mathematics.sh`."""
    x, y, z = directions.float().unbind(dim=-1)
    first, second = math.sqrt(0.75 / math.pi), math.sqrt(3.75 / math.pi)
    constant = torch.full_like(x, math.sqrt(0.25 / math.pi))
    zonal = 0.25 * math.sqrt(5.0 / math.pi) * (3.0 * z * z - 1.0)
    mixed = 0.5 * second * (x * x - y * y)
    bands = constant, first * y, first * z, first * x, second * x * y, second * y * z, zonal, second * x * z, mixed
    return torch.stack(bands, dim=-1)


def low_radiance(coefficients: Tensor, harmonics: Tensor, degree: int) -> Tensor:
    """Σ a_lm Y_lm(ωi) [N,D,3] up to `degree`, of coefficients [N,9,3] and harmonics [N,D,9] of the directions.

    No matrix product: its rounding of one view would depend on how many others are in the batch.
    """
    total = harmonics[..., :1] * coefficients[:, None, 0]
    for number in range(1, (degree + 1) ** 2):
        total.addcmul_(harmonics[..., number, None], coefficients[:, None, number])
    return total
