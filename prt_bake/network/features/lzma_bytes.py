"""Bytes compressed by LZMA as a tensor of a checkpoint."""

import lzma

import numpy as np
import torch
from torch import Tensor

from formats.errors import ModelError

_LZMA = ({"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME},)


def packed_bytes(content: bytes) -> Tensor:
    """The content, compressed: uint8 [bytes]."""
    compressed = lzma.compress(content, lzma.FORMAT_RAW, filters=_LZMA)
    return torch.from_numpy(np.frombuffer(compressed, np.uint8).copy())


def unpacked_bytes(packed: Tensor, size: int, what: str) -> bytes:
    """The inverse of `packed_bytes`, of known size; raises ModelError naming `what` if it is not that."""
    try:
        reader = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_LZMA)
        content = reader.decompress(packed.to(torch.uint8).numpy().tobytes(), max_length=size + 1)
    except lzma.LZMAError as fault:
        raise ModelError(f"interior: its {what} cannot be unpacked ({fault}); train the model again") from None
    if len(content) != size:
        raise ModelError(f"interior: its {what} hold {len(content)} bytes, expected {size}; train the model again")
    return content
