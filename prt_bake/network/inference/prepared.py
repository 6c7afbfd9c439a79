"""Chooses the frozen form of a network for a device."""

import torch

from formats.errors import QueryError
from prt_bake.network.core import NetworkCore
from prt_bake.network.inference.fused import PRECISIONS, FusedNetwork


def prepared_for(network: NetworkCore, precision: str, device: str) -> FusedNetwork:
    """A frozen copy of the network: with GPU kernels on "cuda" if they support it, otherwise with fused layers.

    Raises QueryError on a precision other than "float32" and "bfloat16", and on a device that is not there.
    """
    if not _is_there(device):
        raise QueryError(
            f"device: expected 'cpu', or 'cuda' with a GPU that the installed torch can use, found {device!r}"
        )
    if device == "cuda" and precision in PRECISIONS:
        from prt_bake.network.inference.cuda import cuda_network

        return cuda_network(network, precision, device)
    return FusedNetwork(network, precision, device)


def _is_there(device: str) -> bool:
    try:
        return torch.device(device).type != "cuda" or torch.cuda.is_available()
    except RuntimeError:
        return False
