"""Whether matrix work in bfloat16 pays: what a processor names and what it gains are two things.

Processors with matrix units (AMX) are several times as fast in it. Some that have the instructions without the units
take twice as long as in float32.
"""

import time
from functools import cache

import torch

_ROWS, _WIDTH = 4096, 256
"""A layer of a batch, about."""
_HOPELESS = 50.0
"""Times as slow: processors without the instructions take a thousand times as long, seconds a product."""
_REPEATS, _WORTH = 7, 1.3
"""How much faster it must be: what is rounded must be worth it, and processors are well on one side or the other."""


@cache
def bfloat16_pays(device_type: str) -> bool:
    """Whether a matrix product in bfloat16 is at least 1.3 times as fast as in float32; measured once, in 0.1 s.

    device_type: "cpu", or "cuda", where it is taken wherever the card has it.
    """
    if device_type != "cpu":
        return bool(torch.cuda.is_bf16_supported())
    return _gain() > _WORTH


def _gain() -> float:
    """Seconds in float32 over those in bfloat16, the least of a few each, in turns."""
    pairs = {kind: _operands(kind) for kind in (torch.float32, torch.bfloat16)}
    least = dict.fromkeys(pairs, float("inf"))
    with torch.no_grad():
        for _ in range(_REPEATS):
            for kind, (rows, weights) in pairs.items():
                began = time.perf_counter()
                torch.nn.functional.linear(rows, weights)
                least[kind] = min(least[kind], time.perf_counter() - began)
            if least[torch.bfloat16] > _HOPELESS * least[torch.float32]:
                break
    return least[torch.float32] / least[torch.bfloat16]


def _operands(kind: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones(_ROWS, _WIDTH, dtype=kind), torch.ones(_WIDTH, _WIDTH, dtype=kind)
