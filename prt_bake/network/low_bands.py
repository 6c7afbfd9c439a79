"""The low bands of a network: the coefficients a_lm to degree 2 of a view, predicted by layers of their own.

Bakes to degree 2 need these alone. The layers that see ωi learn them slowly, since most of what they fit is finer. The
mean of T · Y_lm(ω_exit) over the paths of a query is an unbiased estimate of its a_lm, so these layers fit nine numbers
of each channel by least squares, without sampled directions.

They also predict weights w_jl of lobes about axes v_j of the view, such as the normal: Σ_j w_jl Y_lm(v_j) is added to
bands 1 and 2. These lobes turn with the surface, so that they need not be learned for every normal.

Few directions suffice to evaluate them: Ŝ up to degree 2 is Σ a_lm Y_lm(ωi).

Layers of the same kind correct the values of the layers that see ωi: Σ c_lm Y_lm(ωi) is added to them, where c_lm are
the low bands less the coefficients of these values. So Ŝ has nearly the same coefficients in all uses of a network.
"""

import math

import torch
from torch import Tensor, nn

from prt_bake.network.initial_weights import initialise
from prt_bake.network.settings import AXIS_LENGTH, LEAST_LAYERS, NetworkSettings

LOW_DEGREE = 2
LOW_COUNT = (LOW_DEGREE + 1) ** 2
_CHANNELS = 3


class LowBands(nn.Module):
    """Layers from the features of a view to its coefficients: SiLU, and the first output again before the third.

    The output is added to lobes about axes that are among the features.
    """

    axis_columns: Tensor

    def __init__(
        self, inputs: int, width: int, layers: int, generator: torch.Generator, axes: tuple[int, ...] = ()
    ) -> None:
        """Initial weights by He et al. 2015, drawn by `generator`; the initial coefficients are small.

        axes: the first of the three features of each axis, whose unit is AXIS_LENGTH.
        """
        super().__init__()
        *hidden, output = low_shapes(inputs, width, layers, len(axes))
        self.hidden = nn.ModuleList(nn.Linear(n, m) for m, n in hidden)
        self.output = nn.Linear(width, output[0])
        columns = torch.arange(3)[:, None] + torch.tensor(axes, dtype=torch.int64)
        self.register_buffer("axis_columns", columns.flatten(), persistent=False)
        for layer in (*self.hidden, self.output):
            initialise(layer, 0.1 if layer is self.output else 2.0, generator)

    def forward(self, features: Tensor) -> Tensor:
        """Coefficients [N,9,3] over the output scale, float32, from features [N,inputs]."""
        silu = torch.nn.functional.silu
        first = h = silu(self.hidden[0](features.to(self.output.weight.dtype)))
        h = silu(self.hidden[1](h))
        h = silu(self.hidden[2](torch.cat((h, first), dim=-1)))
        for layer in self.hidden[LEAST_LAYERS:]:
            h = silu(layer(h))
        output: Tensor = self.output(h).float()
        coefficients = output[:, : LOW_COUNT * _CHANNELS].reshape(-1, LOW_COUNT, _CHANNELS)
        if not len(self.axis_columns):
            return coefficients
        axes = features.index_select(1, self.axis_columns).float().reshape(len(features), 3, -1) / AXIS_LENGTH
        weights = output[:, LOW_COUNT * _CHANNELS :].reshape(len(features), LOW_DEGREE, -1, _CHANNELS)
        return coefficients + _lobes(axes, weights)


def _lobes(axes: Tensor, weights: Tensor) -> Tensor:
    """Σ_j w_jl |v_j|^l Y_lm(v_j / |v_j|) [N,9,3], 0 in band 0, of axes v [N,3,J] and weights w [N,2,J,3]."""
    xyz = axes.unbind(dim=1)
    first = torch.stack(_first_band(*xyz), dim=1) @ weights[:, 0]
    second = torch.stack(_second_band(*xyz), dim=1) @ weights[:, 1]
    return torch.cat((torch.zeros_like(first[:, :1]), first, second), dim=1)


def low_bands_of(settings: NetworkSettings, generator: torch.Generator) -> LowBands | None:
    """New low bands of a network; None if its settings leave them out."""
    if not settings.low_width:
        return None
    return LowBands(settings.view_inputs, settings.low_width, settings.low_layers, generator, settings.axis_columns)


def correction_of(settings: NetworkSettings, generator: torch.Generator) -> LowBands | None:
    """New layers that correct the values of a network; None if its settings leave them out."""
    if not settings.correction_width:
        return None
    inputs, axes = correction_inputs(settings), settings.axis_columns
    return LowBands(inputs, settings.correction_width, LEAST_LAYERS, generator, axes)


def correction_inputs(settings: NetworkSettings) -> int:
    """Inputs of the layers that correct the values: the features of a view, and what the trunk makes of them."""
    return settings.view_inputs + settings.width


def low_shapes(inputs: int, width: int, layers: int, axes: int = 0) -> tuple[tuple[int, int], ...]:
    """(outputs, inputs) of the hidden `layers`, and of the output with lobes about `axes`."""
    more = ((width, width),) * (layers - LEAST_LAYERS)
    output = _CHANNELS * (LOW_COUNT + LOW_DEGREE * axes)
    return ((width, inputs), (width, width), (width, 2 * width), *more, (output, width))


def low_harmonics(directions: Tensor) -> Tensor:
    """Y_lm [...,9] of unit vectors [...,3] to degree 2, float32, in the order of `prt_bake.mathematics.sh`."""
    x, y, z = directions.float().unbind(dim=-1)
    constant = torch.full_like(x, math.sqrt(0.25 / math.pi))
    return torch.stack((constant, *_first_band(x, y, z), *_second_band(x, y, z)), dim=-1)


def _first_band(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
    scale = math.sqrt(0.75 / math.pi)
    return scale * y, scale * z, scale * x


def _second_band(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
    scale = math.sqrt(3.75 / math.pi)
    zonal = 0.25 * math.sqrt(5.0 / math.pi) * (2.0 * z * z - x * x - y * y)
    return scale * x * y, scale * y * z, zonal, scale * x * z, 0.5 * scale * (x * x - y * y)


def low_radiance(coefficients: Tensor, harmonics: Tensor, degree: int) -> Tensor:
    """Σ a_lm Y_lm(ωi) [N,D,3] up to `degree`, of coefficients [N,9,3] and harmonics [N,D,9] of the directions.

    No matrix product: its rounding of one view would depend on how many others are in the batch.
    """
    total = harmonics[..., :1] * coefficients[:, None, 0]
    for number in range(1, (degree + 1) ** 2):
        total.addcmul_(harmonics[..., number, None], coefficients[:, None, number])
    return total
