"""Radiance images, `.hdr` (Radiance file formats: https://radsite.lbl.gov/radiance/refer/filefmts.pdf).

Greg Ward, "Real Pixels", Graphics Gems II (1991): 4 bytes per pixel, three mantissas and a shared exponent. A pixel
(r, g, b, e) is (r, g, b)·2^(e−136) if e > 0, and black if e = 0. `formats.image.rgbe_header` reads the header, whose
EXPOSURE and COLORCORR divide the values.

No library: OpenCV (160 MB) rejects rows that run upward or from the right, decodes complete images only, and truncates
mantissas. Its error is up to 1/132 of a pixel's largest channel; here it is up to 1/256.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError, warn
from formats.image.gamut import Primaries
from formats.image.refusals import refuse_size
from formats.image.rgbe_header import RgbeHeader, read_header

_ROWS = 32
_MOST_PIXELS = 1 << 21
"""Pixels of a block of rows, unless a row has more."""
_LARGEST = 255 * 2.0**119  # mantissa 255 at the highest exponent


def read_rgbe(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], Primaries | None]:
    """Read a Radiance image as float32 [H,W,3], row 0 on top, and what it says about its primaries.

    Raises:
        ImageError: the file is not a Radiance image, is in XYZ colours, is stored by columns, or is truncated.
    """
    picture = open_rgbe_rows(path)
    image = np.concatenate(list(picture.blocks()))
    return image[:: -1 if picture.header.upward else 1], picture.header.primaries


@dataclass(frozen=True)
class RgbeRows:
    """A Radiance image, read in blocks of rows; `path` is the file."""

    path: str | os.PathLike[str]
    header: RgbeHeader

    def blocks(self) -> Iterator[NDArray[np.float32]]:
        """Yield the rows in file order, columns from the left, as float32 [R,W,3].

        Raises:
            ImageError: the file is truncated or damaged.
        """
        height, width = self.header.height, self.header.width
        rows = max(1, min(_ROWS, _MOST_PIXELS // width))
        divisors = np.array(self.header.divisors, np.float32)
        with open(self.path, "rb") as file:
            file.seek(self.header.end)
            content, at = b"", 0
            for first in range(0, height, rows):
                pixels = np.empty((min(rows, height - first), width, 4), np.uint8)
                # A row has at most a marker of 4 bytes, and a count for each byte.
                content = content[at:]
                content += file.read(max(0, len(pixels) * (4 + 8 * width) - len(content)))
                at = _decode_rows(content, pixels, first, self)
                scale = np.ldexp(np.float32(1), pixels[..., 3].astype(np.int32) - 136)
                scale[pixels[..., 3] == 0] = 0
                radiance = pixels[..., :3].astype(np.float32) * scale[..., None]
                if np.any(divisors != 1.0):
                    with np.errstate(over="ignore"):  # infinite pixels are reported by those who read them
                        radiance /= divisors
                yield radiance[:, ::-1] if self.header.leftward else radiance


def open_rgbe_rows(path: str | os.PathLike[str]) -> RgbeRows:
    """Read the header of a Radiance image; raises ImageError as `read_rgbe`."""
    header = read_header(path)
    # A coded row takes at least a marker of 4 bytes, and 2 bytes per run of 127: a shorter file is truncated.
    size, height, width = os.path.getsize(path), header.height, header.width
    if height * (width // 32 if 8 <= width < 32768 else 1) > size:
        raise ImageError(f"{path}: is truncated: {size} bytes cannot hold {width}x{height} pixels; copy it again")
    refuse_size(path, width, height)
    return RgbeRows(path, header)


def refuse_unstorable(path: str | os.PathLike[str], image: NDArray[np.floating]) -> None:
    """Raise ImageError for pixels that are not finite or above 1.7e38; negative ones are a warning."""
    linear = np.asarray(image, np.float64)
    invalid = ~(np.abs(linear) <= _LARGEST).all(axis=2)
    if invalid.any():
        row, column = np.argwhere(invalid)[0]
        raise ImageError(
            f"{path}: {invalid.sum()} pixels are not finite or above {_LARGEST:.2g}, the limit of .hdr; the first is "
            f"row {row}, column {column} ({linear[row, column].tolist()}); write .exr instead"
        )
    if negative := int((linear < 0).any(axis=2).sum()):
        warn(f"{path}: {negative} pixels are negative, down to {linear.min():.3g}; .hdr stores them as 0, .exr as is")


def write_rgbe(path: str | os.PathLike[str], image: NDArray[np.floating]) -> None:
    """Write radiance [H,W,3], rounded to 8 bits relative to the largest channel.

    Negative values and pixels below 2^-128 become black. The image is finite (`refuse_unstorable`).
    """
    linear = np.maximum(np.asarray(image, np.float64), 0.0)
    largest = linear.max(axis=2)
    exponent = np.frexp(largest)[1]
    exponent += np.rint(np.ldexp(largest, 8 - exponent)) > 255  # rounding up may need the next exponent
    pixels = np.zeros((*largest.shape, 4), np.uint8)
    bright = exponent > -128
    pixels[bright, :3] = np.rint(np.ldexp(linear[bright], 8 - exponent[bright, None]))
    pixels[bright, 3] = exponent[bright] + 128
    height, width = largest.shape
    with open(path, "wb") as file:
        file.write(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode("ascii"))
        # Plain pixels cannot be mistaken for run-length markers: each has a mantissa of at least 128.
        file.write(pixels.tobytes())


def _decode_rows(content: bytes, pixels: NDArray[np.uint8], first: int, picture: RgbeRows) -> int:
    """Decode rows [R,W,4] of the image, starting with row `first`, and return the offset of their end."""
    width, at = picture.header.width, 0
    may_be_coded, coded = 8 <= width < 32768, False
    for row in range(len(pixels)):
        try:
            if may_be_coded and content[at : at + 2] == b"\2\2" and content[at + 2] < 128:
                if int.from_bytes(content[at + 2 : at + 4]) != width:
                    raise ValueError
                at, coded = _coded_row(content, at + 4, pixels[row]), True
            elif coded and not any(content[at : at + 4 * width]):
                raise ValueError  # rows of zeros between coded rows are what an interrupted copy leaves
            else:
                at = _plain_row(content, at, pixels[row])
        except (IndexError, ValueError) as cause:
            where = f"row {first + row} of {picture.header.height}"
            raise ImageError(f"{picture.path}: is truncated or damaged in {where}; copy it again") from cause
    return at


def _coded_row(content: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Decode the four channels of a row in turn: runs (count + 128, value) and literals (count, values)."""
    width = len(row)
    for channel in range(4):
        decoded = bytearray()
        while len(decoded) < width:
            count = content[at]
            if count > 128:
                decoded += content[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                decoded += content[at + 1 : at + 1 + count]
                at += 1 + count
            if count == 0 or at > len(content):
                raise ValueError
        if len(decoded) != width:
            raise ValueError
        row[:, channel] = np.frombuffer(decoded, np.uint8)
    return at


def _plain_row(content: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Decode a row of plain pixels. (1, 1, 1, n) repeats the last pixel; consecutive markers are digits in base 256."""
    width = len(row)
    plain = np.frombuffer(content, np.uint8, min(4 * width, len(content) - at), at).reshape(-1, 4)
    if len(plain) == width and not (plain[:, :3] == 1).all(axis=1).any():
        row[:] = plain
        return at + 4 * width
    column, shift = 0, 0
    while column < width:
        pixel = content[at : at + 4]
        at += 4
        if len(pixel) < 4:
            raise ValueError
        if pixel[:3] == b"\1\1\1":
            count = pixel[3] << shift
            if column == 0 or column + count > width:
                raise ValueError
            row[column : column + count] = row[column - 1]
            column += count
            shift += 8
        else:
            row[column] = np.frombuffer(pixel, np.uint8)
            column += 1
            shift = 0
    return at
