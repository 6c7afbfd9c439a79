"""Fused linear layer and activation for frozen networks.

On CPUs oneDNN's fused operator is called directly. Float32 `F.linear` goes to MKL, which reaches only half of the
vector units' speed on AMD processors (107 against 231 GFLOP/s on one Zen 5 core).
"""

from collections.abc import Callable

import torch
from torch import Tensor

Linear = Callable[[Tensor, Tensor, Tensor, str], Tensor]
"""(h, weight, bias, activation "relu", "silu" or "none") → activation(h @ weight.T + bias)."""


def linear_for(weight: Tensor) -> Linear:
    """The fastest version for weights of this device and dtype."""
    return onednn_linear if onednn_works(weight) else plain_linear


def plain_linear(h: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    """By torch's public functions."""
    result = torch.nn.functional.linear(h, weight, bias)
    if activation == "none":
        return result
    return result.relu_() if activation == "relu" else torch.nn.functional.silu(result, inplace=True)


def onednn_linear(h: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    """By oneDNN's fused operator."""
    name = {"silu": "swish"}.get(activation, activation)
    result: Tensor = torch.ops.mkldnn._linear_pointwise(h, weight, bias, name, [], "")
    return result


def onednn_works(weight: Tensor) -> bool:
    """Whether oneDNN's operator, which torch does not document, exists here and is correct for this dtype."""
    if weight.device.type != "cpu" or not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return False
    h = torch.linspace(-1.0, 1.0, 8 * weight.shape[1]).view(8, -1).to(weight.dtype)
    bias = torch.linspace(-0.5, 0.5, weight.shape[0]).to(weight.dtype)
    try:
        return all(
            torch.allclose(
                onednn_linear(h, weight, bias, activation).float(),
                plain_linear(h, weight, bias, activation).float(),
                rtol=0.02,
                atol=0.02,
            )
            for activation in ("relu", "silu", "none")
        )
    except (AttributeError, RuntimeError):
        return False
