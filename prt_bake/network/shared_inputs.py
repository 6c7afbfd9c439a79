"""Linear layers whose inputs belong in part to a view, and in part to each of its incident directions."""

from typing import Any

import torch
from torch import Tensor


def linear_of_parts(layer: Any, parts: list[Tensor]) -> Tensor:
    """The linear layer of the concatenated parts, [N,1,·] or [N,D,·]; multiplies parts shared by the D once.

    The other parts are multiplied one by one, since concatenating them takes longer.
    """
    if all(part.shape[1] == 1 for part in parts):
        return torch.as_tensor(layer(torch.cat(parts, dim=-1)))
    columns = layer.weight.split([part.shape[-1] for part in parts], dim=1)
    shared = [(part, weights) for part, weights in zip(parts, columns, strict=True) if part.shape[1] == 1]
    separate = [(part, weights) for part, weights in zip(parts, columns, strict=True) if part.shape[1] > 1]
    total: Tensor = layer.bias
    for part, weights in separate:
        total = torch.addmm(total, part.flatten(0, 1), weights.T)
    total = total.view(*separate[0][0].shape[:2], -1)
    for part, weights in shared:
        total = total + torch.nn.functional.linear(part, weights)
    return total
