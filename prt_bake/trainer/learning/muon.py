"""Muon: an optimiser for the matrices of hidden layers, whose updates change all directions of a matrix alike.

The mean gradient of a matrix is mostly along a few directions. Muon replaces it by the nearest orthogonal matrix, so
that directions with small gradients are learnt, too. Sources: Jordan et al. 2024, "Muon: An optimizer for hidden layers
in neural networks"; the scale of the updates, which gives them the size of Adam's: Liu et al. 2025, "Muon is scalable
for LLM training".
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

_MOMENTUM = 0.95
_SCALE = 0.2
"""Root mean square of Adam's updates, in learning rates."""
_STEPS = 5
_COEFFICIENTS = 3.4445, -4.7750, 2.0315
"""Of the quintic iteration, whose singular values come near 1 in few steps rather than exactly to 1 in many."""


class Muon(torch.optim.Optimizer):
    """Muon for matrices, with Nesterov's momentum and decoupled weight decay."""

    def __init__(self, matrices: Iterable[Tensor], rate: float, decay: float) -> None:
        """`decay` times the rate is the share of the weights that a step takes away."""
        super().__init__(list(matrices), {"lr": rate, "weight_decay": decay})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Update all matrices that have a gradient."""
        for group in self.param_groups:
            rate, decay = group["lr"], group["weight_decay"]
            for weights in group["params"]:
                if weights.grad is None:
                    continue
                state = self.state[weights]
                if not state:
                    state["mean"] = torch.zeros_like(weights)
                mean = state["mean"]
                mean.lerp_(weights.grad, 1.0 - _MOMENTUM)
                update = orthogonal(weights.grad.lerp(mean, _MOMENTUM))
                weights.mul_(1.0 - rate * decay)
                weights.sub_(update * (rate * _SCALE * max(weights.shape) ** 0.5))


def orthogonal(matrix: Tensor) -> Tensor:
    """Nearly the orthogonal matrix next to `matrix` [M,N].

    Singular values above a three hundredth of its norm become 0.7 to 1.2, smaller ones grow up to 480-fold.
    Newton–Schulz iteration on the smaller side.
    """
    tall = matrix.shape[0] > matrix.shape[1]
    x: Tensor = matrix.T if tall else matrix
    x = x / (torch.linalg.matrix_norm(x) + 1e-30)
    a, b, c = _COEFFICIENTS
    for _ in range(_STEPS):
        squared = x @ x.T
        x = a * x + (b * squared + c * squared @ squared) @ x
    return x.T if tall else x
