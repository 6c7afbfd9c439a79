"""Animated pictures, APNG, WebP or GIF, and numbered sequences of pictures: linear frames in, sRGB out as in PNG.

Frames are taken one by one and let go: an animation of any length is written in the memory of a few frames (a GIF
keeps one byte a pixel of each). All are lossless but GIF, which has 256 colours a frame. APNG:
https://www.w3.org/TR/png-3/#apng-frame-based-animation.

Pillow writes WebP, GIF and the chunks of APNG. The loop over an APNG's frames is own code, since Pillow's keeps all
frames: 100 of 512² take 249 MB instead of 87.
"""

import itertools
import os
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import ImageError
from formats.image.files import write_image
from formats.image.png import encoded

SUFFIXES = (".png", ".webp", ".gif")
_SECONDS = (0.01, 60.0)
_MOST_PIXELS = {".png": 2**31 - 1, ".webp": 16383, ".gif": 65535}
"""Along a side."""
_GIF_BYTES = 1 << 30
_SIGNATURE = b"\x89PNG\r\n\x1a\n"

Frame = NDArray[np.floating]


def write_animation(
    path: str | os.PathLike[str], frames: Iterable[Frame], *, exposure: float = 0.0, seconds_a_frame: float = 0.04
) -> int:
    """Write linear frames [H,W,3] as an animation that runs for ever, whole or not at all; returns how many they were.

    `.png` (APNG), `.webp` or `.gif` by the suffix. Frames are multiplied by 2^exposure, clipped to [0,1] and encoded as
    sRGB. Times are kept to a millisecond, to 10 of them in a GIF. WebP and GIF draw equal frames in a row as one that
    stays longer.

    Raises:
        ImageError: another suffix, no frame, frames of another shape than the first's or with NaN, a size or a time
            that the kind of file cannot hold.
        StorageError: the disk is full or not writable.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ImageError(
            f"{path}: animations are written as {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, not {suffix!r}"
        )
    low, high = _SECONDS
    if not low <= seconds_a_frame <= high:
        raise ImageError(f"{path}: {seconds_a_frame:g} seconds a frame where {low:g} to {high:g} are expected")
    milliseconds = round(1000.0 * seconds_a_frame)
    counted = _Counted(_encoded(path, frames, exposure, suffix))
    with replacing(path) as part, open(part, "r+b") as file:
        first = next(counted, None)
        if first is None:
            raise ImageError(f"{path}: an animation without frames; hand in at least one")
        shown = itertools.chain([first], counted)
        if suffix == ".png":
            _write_apng(file, shown, milliseconds)
        else:
            _write_by_pillow(file, shown, milliseconds, suffix)
    return counted.count


def write_sequence(pattern: str | os.PathLike[str], frames: Iterable[Frame], *, exposure: float = 0.0) -> list[Path]:
    """Write linear frames [H,W,3] as numbered pictures (`write_image`), the first as number 0; returns their paths.

    pattern: a name with one number in it as `turn_%03d.png`. Each picture appears whole; those before a fault stay.

    Raises:
        ImageError: no such number in the name, no frame, or as `write_image`.
        StorageError: as `write_image`.
    """
    folder, name = os.path.split(os.fspath(pattern))
    if len(re.findall(r"%0\d+d|%d", name)) != 1 or name.count("%") != 1:
        raise ImageError(f"{pattern}: expected a name with one number in it, such as turn_%03d.png")
    written = []
    for number, frame in enumerate(frames):
        path = Path(folder, name % number)
        _refuse_nan(path, frame, number)
        write_image(path, frame, exposure=exposure)
        written.append(path)
    if not written:
        raise ImageError(f"{pattern}: a sequence without frames; hand in at least one")
    return written


class _Counted(Iterator[NDArray[np.uint8]]):
    """Frames, and how many have been taken."""

    def __init__(self, frames: Iterator[NDArray[np.uint8]]) -> None:
        self._frames = frames
        self.count = 0

    def __next__(self) -> NDArray[np.uint8]:
        frame = next(self._frames)
        self.count += 1
        return frame


def _encoded(
    path: str | os.PathLike[str], frames: Iterable[Frame], exposure: float, suffix: str
) -> Iterator[NDArray[np.uint8]]:
    """Frames in 8 bits of sRGB, each checked against the first."""
    shape: tuple[int, ...] | None = None
    for number, frame in enumerate(frames):
        found = np.shape(frame)
        if len(found) != 3 or found[2] != 3 or 0 in found:
            raise ImageError(f"{path}: frame {number}: expected shape [H,W,3], found {list(found)}")
        if shape is not None and found != shape:
            raise ImageError(f"{path}: frame {number} is {found[1]}x{found[0]}, the first {shape[1]}x{shape[0]}")
        if max(found) > _MOST_PIXELS[suffix]:
            raise ImageError(
                f"{path}: {found[1]}x{found[0]}: a {suffix} holds at most {_MOST_PIXELS[suffix]} along a side"
            )
        if suffix == ".gif" and (number + 1) * found[0] * found[1] > _GIF_BYTES:
            raise ImageError(f"{path}: more than 2^30 pixels in {number + 1} frames; write a .webp or a .png")
        _refuse_nan(path, frame, number)
        shape = found
        yield encoded(frame, exposure)


def _refuse_nan(path: str | os.PathLike[str], frame: Frame, number: int) -> None:
    wrong = np.isnan(frame).reshape(len(frame), -1)
    if wrong.any():
        raise ImageError(f"{path}: frame {number}: pixels are NaN, the first in row {int(wrong.any(axis=1).argmax())}")


def _write_by_pillow(file: IO[bytes], frames: Iterator[NDArray[np.uint8]], milliseconds: int, suffix: str) -> None:
    from PIL import Image

    def pictures() -> Iterator[Any]:
        for frame in frames:
            picture = Image.fromarray(frame)
            yield picture.quantize(256) if suffix == ".gif" else picture

    made = pictures()
    options: dict[str, Any] = {"lossless": True, "method": 2} if suffix == ".webp" else {"optimize": False}
    next(made).save(
        file, suffix[1:].upper(), save_all=True, append_images=made, duration=milliseconds, loop=0, **options
    )


def _write_apng(file: IO[bytes], frames: Iterator[NDArray[np.uint8]], milliseconds: int) -> None:
    """Each frame is a PNG whose image chunks are numbered; the count of frames is filled in at the end."""
    from PIL import Image
    from PIL.PngImagePlugin import getchunks, putchunk

    file.write(_SIGNATURE)
    number = count = 0
    place = 0
    for count, frame in enumerate(frames, start=1):
        height, width = frame.shape[:2]
        chunks = [(kind, body) for kind, body, _checksum in getchunks(Image.fromarray(frame))]
        if count == 1:
            putchunk(file, *next(chunk for chunk in chunks if chunk[0] == b"IHDR"))
            place = file.tell()
            putchunk(file, b"acTL", struct.pack(">II", 1, 0))
        putchunk(file, b"fcTL", struct.pack(">IIIIIHHBB", number, width, height, 0, 0, milliseconds, 1000, 0, 0))
        number += 1
        for body in (body for kind, body in chunks if kind == b"IDAT"):
            if count == 1:
                putchunk(file, b"IDAT", body)
            else:
                putchunk(file, b"fdAT", struct.pack(">I", number), body)
                number += 1
    putchunk(file, b"IEND")
    file.seek(place)
    putchunk(file, b"acTL", struct.pack(">II", count, 0))
