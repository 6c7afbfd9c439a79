"""Systematic resampling of exits on a GPU, as `prt_bake.trainer.samples.resampling`."""

from typing import Any

import torch
from torch import Tensor

from prt_bake.tracer.gpu.device_functions import cuda, device_function, kernel
from prt_bake.trainer.samples import resampling

_hilbert_index = device_function(resampling.hilbert_index)
_THREADS = 128


@kernel
def _hilbert_indices(directions: Any, index: Any) -> None:
    """Positions [N] of directions [N,3] along the Hilbert curve."""
    n = cuda.grid(1)
    if n < index.shape[0]:
        index[n] = _hilbert_index(directions[n, 0], directions[n, 1], directions[n, 2])


def resampled(directions: Tensor, throughput: Tensor, kept: int, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Directions and throughput [N,K,3] of K = `kept` rays that represent those [N,P,3] of P walks.

    offsets float64 [N,1], uniform in [0, 1), decide all draws. A query whose walks carry no light keeps any of them.
    """
    walks = directions.shape[1]
    index = torch.empty(throughput.shape[:2], dtype=torch.int32, device=directions.device)
    blocks = -(-index.numel() // _THREADS)
    _hilbert_indices[blocks, _THREADS](kernel_array(directions.view(-1, 3)), kernel_array(index.view(-1)))
    light = throughput.double().mean(dim=-1)
    order = index.argsort(dim=1, stable=True)
    cumulative = light.gather(1, order).cumsum(dim=1)
    total = cumulative[:, -1:]
    strata = (offsets + torch.arange(kept, device=light.device)) * (total / kept)
    chosen = order.gather(1, torch.searchsorted(cumulative, strata, right=True).clamp_(max=walks - 1))
    drawn = light.gather(1, chosen)
    # Rounding may draw the last walk although it is dark. Light that is not finite stays so, for the loss to show it.
    scale = torch.where((drawn > 0.0) | ~total.isfinite(), total / (walks * drawn), 0.0)
    rows = chosen[..., None].expand(-1, -1, 3)
    return directions.gather(1, rows), throughput.gather(1, rows) * scale[..., None].float()


def kernel_array(tensor: Tensor) -> Any:
    """The tensor as an array for kernels of numba; both share the memory."""
    return cuda.as_cuda_array(tensor) if tensor.is_cuda else tensor.numpy()
