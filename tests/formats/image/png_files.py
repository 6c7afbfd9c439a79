"""PNG files with any chunks."""

import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from formats.image.png import to_linear

CODES = np.random.default_rng(6).integers(0, 256, (7, 9, 3), dtype=np.uint8)
SRGB = to_linear(CODES / 255.0).astype(np.float32)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def numbers(*values: float) -> bytes:
    """Hundred-thousandths, as gAMA and cHRM store them."""
    return struct.pack(f">{len(values)}I", *(round(100_000 * value) for value in values))


def write(path: Path, *chunks: bytes, codes: np.ndarray = CODES) -> Path:
    """Write a PNG with further chunks after its header."""
    Image.fromarray(codes).save(path)
    content = path.read_bytes()
    path.write_bytes(content[:33] + b"".join(chunks) + content[33:])
    return path
