"""Whether matrix products in bfloat16 are worth it on this machine.

Supporting bfloat16 and being faster in it are different things: processors with matrix units (AMX) are several times as
fast, while some that have the instructions without the units take twice as long as in float32.
"""

import time
from functools import cache

import torch

_ROWS, _WIDTH = 4096, 256
"""Size of the timed product, similar to a layer on a training batch."""
_HOPELESS = 50.0
"""Slowdown at which timing stops: processors without the instructions are a thousand times slower."""
_REPEATS, _LEAST_SPEEDUP = 7, 1.3
"""Least speedup that justifies the rounding. Processors are clearly above or below it."""


@cache
def bfloat16_is_faster(device_type: str) -> bool:
    """Whether matrix products in bfloat16 are at least 1.3 times as fast as in float32.

    device_type: "cpu" is measured once, in 0.1 s. "cuda" counts as faster if the GPU supports bfloat16.
    """
    if device_type != "cpu":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return _speedup() > _LEAST_SPEEDUP


def _speedup() -> float:
    """Time in float32 over time in bfloat16: the least of several alternating measurements of each."""
    operands = {kind: _operands(kind) for kind in (torch.float32, torch.bfloat16)}
    least = dict.fromkeys(operands, float("inf"))
    with torch.no_grad():
        for _ in range(_REPEATS):
            for kind, (rows, weights) in operands.items():
                began = time.perf_counter()
                torch.nn.functional.linear(rows, weights)
                least[kind] = min(least[kind], time.perf_counter() - began)
            if least[torch.bfloat16] > _HOPELESS * least[torch.float32]:
                break
    return least[torch.float32] / least[torch.bfloat16]


def _operands(kind: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones(_ROWS, _WIDTH, dtype=kind), torch.ones(_WIDTH, _WIDTH, dtype=kind)
