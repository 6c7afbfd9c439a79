"""Chooses the frozen form of a network for a device."""

from prt_bake.network.core import NetworkCore
from prt_bake.network.inference.fused import PRECISIONS, FusedNetwork


def prepared_for(network: NetworkCore, precision: str, device: str) -> FusedNetwork:
    """A frozen copy of the network: with GPU kernels on "cuda" if they support it, otherwise with fused layers.

    Raises QueryError on a precision other than "float32" and "bfloat16".
    """
    if device == "cuda" and precision in PRECISIONS:
        from prt_bake.network.inference.cuda import cuda_network

        return cuda_network(network, precision, device)
    return FusedNetwork(network, precision, device)
