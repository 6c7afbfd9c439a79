"""Refusals before an image is decoded: files of another kind, named as what they are, and sizes that no image has."""

import os

from formats.errors import ImageError

LONGEST_SIDE = 1 << 18
MOST_PIXELS = 1 << 31
_OF_SUFFIX = {".png": "PNG", ".jpg": "JPEG", ".exr": "OpenEXR", ".hdr": "Radiance"}
_STARTS = (
    (0, b"\x89PNG\r\n\x1a\n", "PNG"),
    (0, b"\xff\xd8\xff", "JPEG"),
    (0, b"\x76\x2f\x31\x01", "OpenEXR"),
    (0, b"#?", "Radiance"),
    (0, b"II*\0", "TIFF"),
    (0, b"MM\0*", "TIFF"),
    (8, b"WEBP", "WebP"),
    (4, b"ftypavif", "AVIF"),
    (4, b"ftyp", "HEIF"),
    (4, b"jP  ", "JPEG 2000"),
    (4, b"JXL ", "JPEG XL"),
    (0, b"\xff\x0a", "JPEG XL"),
    (0, b"GIF8", "GIF"),
    (0, b"BM", "BMP"),
    (0, b"8BPS", "Photoshop"),
    (0, b"DDS ", "DDS"),
    (0, b"\xabKTX", "KTX"),
)
"""Offset, bytes and kind."""
_TEXTS = (
    (b"version https://git-lfs", "a pointer of Git LFS; run `git lfs pull`"),
    (b"<", "a web page; download it again"),
)


def refuse_other_kinds(path: str | os.PathLike[str], expected: str) -> None:
    """Raise ImageError, with what the file holds, if it does not begin as the kind `expected`.

    `expected` is PNG, JPEG, OpenEXR or Radiance.
    """
    with open(path, "rb") as file:
        start = file.read(32)
    found = next((kind for at, magic, kind in _STARTS if start[at:].startswith(magic)), None)
    if found == expected:
        return
    suffix = next((suffix for suffix, kind in _OF_SUFFIX.items() if kind == found), None)
    if suffix:
        raise ImageError(f"{path}: is a picture of the kind {found}, not {expected}; rename it to {suffix}")
    if found:
        raise ImageError(f"{path}: is a picture of the kind {found}, which is not read; convert it to {expected}")
    for begin, what in _TEXTS:
        if start.lstrip().startswith(begin):
            raise ImageError(f"{path}: is not {expected}, but {what}")
    magic = next(magic for _, magic, kind in _STARTS if kind == expected)
    begin = start[: len(magic)]
    raise ImageError(f"{path}: is not {expected}: expected {magic!r} at its start, found {begin!r}; copy it again")


def refuse_size(path: str | os.PathLike[str], width: int, height: int) -> None:
    """Raise ImageError if an image has no pixels, more than MOST_PIXELS, or a side longer than LONGEST_SIDE.

    A damaged header is thus refused before memory is allocated.
    """
    if width < 1 or height < 1:
        raise ImageError(f"{path}: the image is empty: {width}x{height} pixels; save it again")
    if max(width, height) > LONGEST_SIDE or width * height > MOST_PIXELS:
        raise ImageError(
            f"{path}: expected at most {LONGEST_SIDE} pixels along a side and {MOST_PIXELS} in all, found "
            f"{width}x{height}; the header is damaged, or the image has to be reduced"
        )


def refuse_truncated(path: str | os.PathLike[str], width: int, height: int, expected: int) -> None:
    """Raise ImageError if a file has fewer bytes than `expected`."""
    size = os.path.getsize(path)
    if size < expected:
        raise ImageError(f"{path}: is truncated: {size} bytes cannot hold {width}x{height} pixels; copy it again")
