"""An independent reader of half-float OpenEXR files of scan lines with ZIP compression: struct and zlib."""

import struct
import zlib
from pathlib import Path

import numpy as np

_ROWS = 16
"""Of a block of ZIP compression."""


def read_halves(path: Path) -> np.ndarray:
    """The channels R, G and B [H,W,3] of the data window, row 0 at the top."""
    content = path.read_bytes()
    assert struct.unpack_from("<II", content) == (20000630, 2)
    attributes, at = {}, 8
    while content[at]:
        name, kind = content[at:].split(b"\0", 2)[:2]
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<I", content, at)
        attributes[name.decode()] = content[at + 4 : at + 4 + size]
        at += 4 + size
    assert attributes["compression"] == b"\3"
    assert attributes["lineOrder"] == b"\0"
    channel = struct.pack("<IIII", 1, 0, 1, 1)  # half, every pixel
    assert attributes["channels"] == b"B\0" + channel + b"G\0" + channel + b"R\0" + channel + b"\0"
    left, top, right, bottom = struct.unpack("<iiii", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    image = np.zeros((height, 3, width), "<f2")
    blocks = -(-height // _ROWS)
    for offset in struct.unpack_from(f"<{blocks}Q", content, at + 1):
        row, size = struct.unpack_from("<iI", content, offset)
        rows = image[row - top : row - top + _ROWS]
        packed = content[offset + 8 : offset + 8 + size]
        rows[...] = np.frombuffer(packed if size == rows.nbytes else _unpacked(packed), "<f2").reshape(rows.shape)
    return image[:, ::-1].transpose(0, 2, 1)


def _unpacked(packed: bytes) -> bytes:
    """Undo deflate, differences of bytes, and the split into even and odd bytes."""
    steps = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
    steps[1:] -= 128
    split = np.cumsum(steps).astype(np.uint8)
    result = np.empty_like(split)
    half = (len(split) + 1) // 2
    result[0::2], result[1::2] = split[:half], split[half:]
    return result.tobytes()
