"""Initial weights of linear layers."""

import torch
from torch import nn


@torch.no_grad()
def initialise(layer: nn.Module, gain: float, generator: torch.Generator) -> None:
    """Draw the weights of a linear layer with variance gain / inputs, and set its biases to 0 (He et al. 2015).

    With a gain of 2, a ReLU after the layer leaves the mean square of its inputs as it was.
    """
    assert isinstance(layer, nn.Linear)
    layer.weight.normal_(0.0, (gain / layer.in_features) ** 0.5, generator=generator)
    layer.bias.zero_()
