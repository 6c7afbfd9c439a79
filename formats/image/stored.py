"""The values that PNG and JPEG files store, read with Pillow, before they are taken as colours or as data."""

import io
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError, warn
from formats.image.png_chunks import PngChunks, read_chunks
from formats.image.refusals import refuse_other_kinds, refuse_size, refuse_truncated

if TYPE_CHECKING:
    from PIL import Image

_MOST_JPEG = 1024
"""Pixels of a byte of a JPEG, at most: blocks of 64 take at least a bit. What is missing would be read as grey."""
_ORIENTATION = 0x0112
_INTEROPERABILITY = 0xA005
_GAIN_MAPS = (b"ns.adobe.com/hdr-gain-map/", b"urn:iso:std:iso:ts:21496")
_UPRIGHT: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
"""What turns a picture upright, by its EXIF orientation (CIPA DC-008-2023, tag Orientation)."""


@dataclass(frozen=True, eq=False)
class Stored:
    """The stored values of a picture, upright.

    Attributes:
        values: uint8 or uint16 [H,W,C]: grey, grey and alpha, RGB or RGBA.
        chunks: what the chunks of a PNG say; of a JPEG, its profile alone.
        cmyk: whether the picture is stored in CMYK; the values are then an RGB without colour management.
        adobe_rgb: whether the EXIF says Adobe RGB, as cameras do that add no profile.
        gain_map: whether a JPEG has a gain map, which HDR displays multiply the values with.
    """

    values: NDArray[Any]
    chunks: PngChunks
    cmyk: bool
    adobe_rgb: bool
    gain_map: bool

    @property
    def highest(self) -> int:
        """The value of white: 255 or 65535."""
        return int(np.iinfo(self.values.dtype).max)


def read_stored(path: str | os.PathLike[str], kind: str) -> Stored:
    """Read a picture of the `kind` "PNG" or "JPEG".

    Raises:
        ImageError: the file is of another kind, too large, truncated or damaged.
    """
    refuse_other_kinds(path, kind)
    chunks = read_chunks(path) if kind == "PNG" else PngChunks()
    with _opened(path, kind, chunks.content) as picture:
        width, height = picture.size
        refuse_size(path, width, height)
        if kind == "JPEG":
            refuse_truncated(path, width, height, (width * height) // _MOST_JPEG)
            chunks.profile = picture.info.get("icc_profile")
        deep = chunks.bits == 16
        values = _values_of_16_bits(path, picture, chunks) if deep else np.asarray(picture.convert(_mode(picture)))
        (orientation, adobe_rgb), gain_map = _read_exif(picture), _has_gain_map(picture)
        cmyk = picture.mode == "CMYK"
        animated = kind == "PNG" and getattr(picture, "n_frames", 1) > 1
    if animated:
        warn(f"{path}: is an animation; its first picture is read")
    values = values if values.ndim == 3 else values[..., None]
    if chunks.clear is not None:
        values = _with_alpha(values, chunks.clear, chunks.bits)
    upright = _UPRIGHT.get(orientation)
    return Stored(values if upright is None else upright(values), chunks, cmyk, adobe_rgb, gain_map)


@contextmanager
def _opened(path: str | os.PathLike[str], kind: str, content: bytes) -> "Iterator[Image.Image]":
    """Open a picture, or the `content` that stands for it; any exception of Pillow becomes an ImageError."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large pictures, and of damaged metadata that is not read
            with Image.open(io.BytesIO(content) if content else path, formats=[kind]) as picture:
                yield picture
    except (ImageError, MemoryError):
        raise
    except Image.DecompressionBombError as cause:
        raise ImageError(f"{path}: has too many pixels; reduce it, or save it as .exr") from cause
    except Exception as cause:  # Pillow raises many kinds for damaged files
        raise ImageError(
            f"{path}: cannot be read as {kind}: it is truncated, damaged or of a rare sort; copy it again, or save it "
            "with 8 bits a channel"
        ) from cause


def _with_alpha(values: NDArray[Any], clear: tuple[int, ...], bits: int) -> NDArray[Any]:
    """Append an alpha to grey or RGB values [H,W,C]: 0 at the colour `clear`, else that of white."""
    white = int(np.iinfo(values.dtype).max)
    opaque = (values != np.array(clear) * (white // (2**bits - 1))).any(axis=2, keepdims=True)
    return np.concatenate([values, np.where(opaque, white, 0).astype(values.dtype)], axis=2)


def _read_exif(picture: "Image.Image") -> tuple[int, bool]:
    """Read the orientation, and whether the colours are Adobe RGB (CIPA DC-009, Interoperability index R03)."""
    orientation, index = 1, ""
    # Pillow raises many kinds for damaged metadata, which does not make a picture unreadable; 11.0 for a missing index.
    with suppress(Exception):
        exif = picture.getexif()
        orientation = int(exif.get(_ORIENTATION, 1))
        index = str(exif.get_ifd(_INTEROPERABILITY).get(1, ""))
    return orientation, index.startswith("R03")


def _has_gain_map(picture: "Image.Image") -> bool:
    """Whether a segment of a JPEG names a gain map: that of Adobe and Android (XMP), or that of ISO 21496-1."""
    segments = (bytes(content) for _, content in getattr(picture, "applist", ()))
    return any(name in content for content in segments for name in _GAIN_MAPS)


def _mode(picture: "Image.Image") -> str:
    """The mode of Pillow with the stored channels, 8 bits each."""
    other = {"1": "L", "P": "RGBA" if "transparency" in picture.info else "RGB", "PA": "RGBA", "CMYK": "RGB"}
    return other.get(picture.mode, picture.mode)


def _values_of_16_bits(path: str | os.PathLike[str], picture: "Image.Image", chunks: PngChunks) -> NDArray[Any]:
    """Read all 16 bits of a PNG. Pillow reads them of grey, and one byte of two of other channels."""
    if picture.mode.startswith("I"):
        return np.asarray(picture).astype(np.uint16)
    raw = str(picture.tile[0].args)  # type: ignore[attr-defined]
    if raw == "LA;16B":
        four_bytes = _decoded(path, chunks, "RGBA").astype(np.uint16)
        return four_bytes[..., ::2] * np.uint16(256) + four_bytes[..., 1::2]
    # The first byte of a big-endian number is the one that is kept, of a little-endian number it is the second.
    high, low = (_decoded(path, chunks, order).astype(np.uint16) for order in (raw, raw.replace("16B", "16L")))
    return high * np.uint16(256) + low


def _decoded(path: str | os.PathLike[str], chunks: PngChunks, raw: str) -> NDArray[Any]:
    """Decode a PNG as if its bytes were arranged as Pillow's raw mode `raw` says."""
    with _opened(path, "PNG", chunks.content) as picture:
        picture.tile = [tile._replace(args=raw) for tile in picture.tile]  # type: ignore[attr-defined]
        return np.array(picture)
