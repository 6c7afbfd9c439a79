"""OpenEXR files byte by byte (https://openexr.com/en/latest/OpenEXRFileLayout.html): subsampled channels and levels.

The `OpenEXR` binding writes neither correctly.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

Window = tuple[int, int, int, int]
Sampling = tuple[int, int]

_TYPES = {"uint32": 0, "float16": 1, "float32": 2}
_NONE, _ZIP = 0, 3
_ROWS = {_NONE: 1, _ZIP: 16}


def thinned(image: np.ndarray, sampling: dict[str, Sampling]) -> dict[str, np.ndarray]:
    """Every n-th column and m-th row of the channels of an image [H,W,C]; sampling: (n, m) by channel."""
    return {name: image[::m, ::n, i] for i, (name, (n, m)) in enumerate(sampling.items())}


def spread(image: np.ndarray, sampling: dict[str, Sampling]) -> np.ndarray:
    """What `thinned` keeps, each value over its pixels."""
    thin = thinned(image, sampling)
    return np.stack([thin[name].repeat(m, axis=0).repeat(n, axis=1) for name, (n, m) in sampling.items()], axis=2)


def write_subsampled(
    path: Path,
    channels: dict[str, np.ndarray],
    sampling: dict[str, Sampling],
    data: Window,
    display: Window | None = None,
    zipped: bool = False,
) -> None:
    """Write scan lines; channels hold the stored pixels of the data window (left, top, right, bottom)."""
    compression = _ZIP if zipped else _NONE
    names, chunks = sorted(channels), []
    for top in range(data[1], data[3] + 1, _ROWS[compression]):
        rows = range(top, min(top + _ROWS[compression], data[3] + 1))
        stored = b"".join(
            channels[name][(row - data[1]) // sampling[name][1]].tobytes()
            for row in rows
            for name in names
            if row % sampling[name][1] == 0
        )
        content = _deflated(stored) if zipped else stored
        chunks.append(struct.pack("<2i", top, len(content)) + content)
    kinds = {name: (channels[name].dtype.name, sampling[name]) for name in names}
    _write(path, 0, _header(kinds, compression, data, display or data), chunks)


def write_levels(path: Path, image: np.ndarray, ripmap: bool) -> None:
    """Write an image [H,W,3] as one tile, with ever smaller levels: those of a mipmap halve both sides together."""
    height, width = image.shape[:2]
    chunks = []
    for x, y in _levels(width, height, ripmap):
        level = image[:: 1 << y, :: 1 << x][: max(1, height >> y), : max(1, width >> x)]
        content = np.ascontiguousarray(level[..., ::-1].swapaxes(1, 2)).tobytes()  # rows of B, G and R
        chunks.append(struct.pack("<5i", 0, 0, x, y, len(content)) + content)
    kinds = dict.fromkeys("BGR", (image.dtype.name, (1, 1)))
    tiles = struct.pack("<2IB", width, height, 2 if ripmap else 1)
    window = (0, 0, width - 1, height - 1)
    _write(path, 0x200, _header(kinds, _NONE, window, window) + _attribute("tiles", "tiledesc", tiles), chunks)


def _levels(width: int, height: int, ripmap: bool) -> Iterator[tuple[int, int]]:
    if not ripmap:
        yield from ((level, level) for level in range(max(width, height).bit_length()))
        return
    yield from ((x, y) for y in range(height.bit_length()) for x in range(width.bit_length()))


def _header(kinds: dict[str, tuple[str, Sampling]], compression: int, data: Window, display: Window) -> bytes:
    channels = b"".join(
        name.encode() + b"\0" + struct.pack("<iB3x2i", _TYPES[kind], 0, *distances)
        for name, (kind, distances) in kinds.items()
    )
    return b"".join(
        (
            _attribute("channels", "chlist", channels + b"\0"),
            _attribute("compression", "compression", bytes([compression])),
            _attribute("dataWindow", "box2i", struct.pack("<4i", *data)),
            _attribute("displayWindow", "box2i", struct.pack("<4i", *display)),
            _attribute("lineOrder", "lineOrder", b"\0"),
            _attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
            _attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
            _attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
        )
    )


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value


def _deflated(stored: bytes) -> bytes:
    values = np.frombuffer(stored, np.uint8)
    halves = np.concatenate([values[::2], values[1::2]]).astype(np.int64)
    differences = np.concatenate([halves[:1], (np.diff(halves) + 128) % 256]).astype(np.uint8)
    content = zlib.compress(differences.tobytes())
    return content if len(content) < len(stored) else stored


def _write(path: Path, flags: int, header: bytes, chunks: list[bytes]) -> None:
    head = b"\x76\x2f\x31\x01" + struct.pack("<i", 2 | flags) + header + b"\0"
    starts = len(head) + 8 * len(chunks) + np.cumsum([0] + [len(chunk) for chunk in chunks[:-1]])
    path.write_bytes(head + starts.astype("<u8").tobytes() + b"".join(chunks))
