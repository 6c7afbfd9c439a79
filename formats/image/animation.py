"""Animations: APNG (https://www.w3.org/TR/png-3/#apng-frame-based-animation), WebP, GIF, MP4, and numbered images.

Linear frames are encoded as sRGB. Frames are consumed one by one, so an animation of any length takes the memory of a
few frames; GIF keeps one byte per pixel of each. APNG and WebP are lossless, GIF has 256 colours per frame.

Pillow writes WebP, GIF and the chunks of APNG. The loop over the frames of an APNG is here, because Pillow's keeps all
frames: 100 of 512² take 249 MB instead of 87. The program ffmpeg writes MP4.
"""

import itertools
import os
import re
import shutil
import struct
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.errors import ImageError
from formats.image.files import write_image
from formats.image.png import encode_srgb

SUFFIXES = (".png", ".webp", ".gif", ".mp4")
_SECONDS_RANGE = (0.01, 60.0)
_MAX_SIDE = {".png": 2**31 - 1, ".webp": 16383, ".gif": 65535, ".mp4": 16384}
"""Most pixels along a side."""
_GIF_MAX_BYTES = 1 << 30
_SIGNATURE = b"\x89PNG\r\n\x1a\n"

Frame = NDArray[np.floating]


def write_animation(
    path: str | os.PathLike[str], frames: Iterable[Frame], *, exposure: float = 0.0, seconds_a_frame: float = 0.04
) -> int:
    """Write linear frames [H,W,3] as an endless animation, atomically, and return their number.

    Args:
        path: the file: `.png` (APNG), `.webp`, `.gif`, or `.mp4` (H.264 by the program ffmpeg).
        frames: consumed one by one.
        exposure: in stops. Frames are multiplied by 2^exposure, clipped to [0,1] and encoded as sRGB.
        seconds_a_frame: rounded to a millisecond, in a GIF to 10 ms. WebP and GIF merge equal consecutive frames.

    Raises:
        ImageError: an unknown suffix, no frame, frames with NaN or of different shapes, a size or a time that the
            format cannot store.
        StorageError: the disk is full or read-only.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ImageError(
            f"{path}: expected an animation {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, found {suffix!r}"
        )
    low, high = _SECONDS_RANGE
    if not low <= seconds_a_frame <= high:
        raise ImageError(f"{path}: seconds a frame: expected {low:g} to {high:g}, found {seconds_a_frame:g}")
    milliseconds = round(1000.0 * seconds_a_frame)
    count = 0

    def counted() -> Iterator[NDArray[np.uint8]]:
        nonlocal count
        for frame in _encode(path, frames, exposure, suffix):
            count += 1
            yield frame

    encoded = counted()
    refuse_unavailable(path)
    with replacing(path) as part, open(part, "r+b") as file:
        first = next(encoded, None)
        if first is None:
            raise ImageError(f"{path}: the animation has no frames; expected at least one")
        all_frames = itertools.chain([first], encoded)
        if suffix == ".png":
            _write_apng(file, all_frames, milliseconds)
        elif suffix == ".mp4":
            _write_mp4(path, part, all_frames, milliseconds)
        else:
            _write_with_pillow(file, all_frames, milliseconds, suffix)
    return count


def refuse_unavailable(path: str | os.PathLike[str], width: int = 2, height: int = 2) -> None:
    """Raise ImageError if the program or the size that an animation needs is missing, before frames are made."""
    if Path(path).suffix.lower() != ".mp4":
        return
    if shutil.which("ffmpeg") is None:
        raise ImageError(f"{path}: the program ffmpeg, which writes .mp4, was not found; install it, or write .webp")
    if width % 2 or height % 2:
        raise ImageError(f"{path}: expected an even width and height in an .mp4, found {width}x{height} pixels")


def write_sequence(pattern: str | os.PathLike[str], frames: Iterable[Frame], *, exposure: float = 0.0) -> list[Path]:
    """Write linear frames [H,W,3] as images numbered from 0, and return their paths.

    Args:
        pattern: a path with one number in its file name, such as `turn_%03d.png`; the suffix as in `write_image`.
        frames: consumed one by one. Each image is written atomically; after an error the earlier ones stay.
        exposure: in stops, as in `write_image`.

    Raises:
        ImageError: no number in the name, no frame, or as `write_image`.
        StorageError: as `write_image`.
    """
    numbered(pattern, 0)
    written = []
    for number, frame in enumerate(frames):
        path = numbered(pattern, number)
        _refuse_nan(path, frame, number)
        write_image(path, frame, exposure=exposure)
        written.append(path)
    if not written:
        raise ImageError(f"{pattern}: the sequence has no frames; expected at least one")
    return written


def numbered(pattern: str | os.PathLike[str], number: int) -> Path:
    """Return the path of a numbered image; raises ImageError for a pattern without one number in the file name."""
    folder, name = os.path.split(os.fspath(pattern))
    if len(re.findall(r"%0\d+d|%d", name)) != 1 or name.count("%") != 1:
        raise ImageError(f"{pattern}: expected a name with one number in it, such as turn_%03d.png")
    return Path(folder, name % number)


def _encode(
    path: str | os.PathLike[str], frames: Iterable[Frame], exposure: float, suffix: str
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames as 8-bit sRGB, after checking each."""
    shape: tuple[int, ...] | None = None
    for number, frame in enumerate(frames):
        found = np.shape(frame)
        if len(found) != 3 or found[2] != 3 or 0 in found:
            raise ImageError(f"{path}: frame {number}: expected shape [H,W,3], found {list(found)}")
        if shape is not None and found != shape:
            size, first_size = f"{found[1]}x{found[0]}", f"{shape[1]}x{shape[0]}"
            raise ImageError(f"{path}: frame {number}: expected {first_size} pixels as in frame 0, found {size}")
        if max(found) > _MAX_SIDE[suffix]:
            raise ImageError(
                f"{path}: {found[1]}x{found[0]} pixels; expected at most {_MAX_SIDE[suffix]} along a side in a {suffix}"
            )
        if suffix == ".gif" and (number + 1) * found[0] * found[1] > _GIF_MAX_BYTES:
            raise ImageError(f"{path}: {number + 1} frames have more than 2^30 pixels; write .webp or .png instead")
        refuse_unavailable(path, found[1], found[0])
        _refuse_nan(path, frame, number)
        shape = found
        yield encode_srgb(frame, exposure)


def _refuse_nan(path: str | os.PathLike[str], frame: Frame, number: int) -> None:
    rows = np.isnan(frame).reshape(len(frame), -1).any(axis=1)
    if rows.any():
        raise ImageError(f"{path}: frame {number}: pixels are NaN, the first in row {int(rows.argmax())}")


def _write_with_pillow(file: IO[bytes], frames: Iterator[NDArray[np.uint8]], milliseconds: int, suffix: str) -> None:
    from PIL import Image

    def pictures() -> Iterator[Any]:
        for frame in frames:
            picture = Image.fromarray(frame)
            yield picture.quantize(256) if suffix == ".gif" else picture

    remaining = pictures()
    options: dict[str, Any] = {"lossless": True, "method": 2} if suffix == ".webp" else {"optimize": False}
    next(remaining).save(
        file, suffix[1:].upper(), save_all=True, append_images=remaining, duration=milliseconds, loop=0, **options
    )


def _write_mp4(
    path: str | os.PathLike[str], part: Path, frames: Iterator[NDArray[np.uint8]], milliseconds: int
) -> None:
    """Pipe the frames through ffmpeg: H.264 in Rec.709, which every player knows, at a quality without visible loss."""
    first = next(frames)
    height, width = first.shape[:2]
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -framerate 1000/{milliseconds} -i -"
    colour = "-vf scale=out_color_matrix=bt709 -colorspace bt709 -color_primaries bt709 -color_trc iec61966-2-1"
    coding = f"-c:v libx264 -crf 16 -pix_fmt yuv420p {colour} -movflags +faststart -f mp4 -y"
    command = ["ffmpeg", "-loglevel", "error", *source.split(), *coding.split(), str(part)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        assert ffmpeg.stderr is not None
        try:
            for frame in itertools.chain([first], frames):
                ffmpeg.stdin.write(frame.tobytes())
            ffmpeg.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg ended and says why
        except BaseException:
            ffmpeg.kill()
            raise
        said = ffmpeg.stderr.read().decode(errors="replace").strip()
        if ffmpeg.wait() != 0:
            reason = said.splitlines()[-1] if said else f"exit code {ffmpeg.returncode}"
            raise ImageError(f"{path}: ffmpeg could not write it ({reason}); write .webp instead")


def _write_apng(file: IO[bytes], frames: Iterator[NDArray[np.uint8]], milliseconds: int) -> None:
    """Write each frame as a PNG with numbered image chunks, and fill in the number of frames at the end."""
    from PIL import Image
    from PIL.PngImagePlugin import getchunks, putchunk

    file.write(_SIGNATURE)
    number = count = count_offset = 0
    for count, frame in enumerate(frames, start=1):
        height, width = frame.shape[:2]
        chunks = [(kind, body) for kind, body, _checksum in getchunks(Image.fromarray(frame))]
        if count == 1:
            putchunk(file, *next(chunk for chunk in chunks if chunk[0] == b"IHDR"))
            count_offset = file.tell()
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
    file.seek(count_offset)
    putchunk(file, b"acTL", struct.pack(">II", count, 0))
