"""How large an image may be, so that a damaged header is refused before memory is allocated."""

import os

from formats.errors import ImageError

LONGEST_SIDE = 1 << 18
MOST_PIXELS = 1 << 31


def refuse_size(path: str | os.PathLike[str], width: int, height: int) -> None:
    """Raise ImageError if an image has no pixels, more than MOST_PIXELS, or a side longer than LONGEST_SIDE."""
    if width < 1 or height < 1:
        raise ImageError(f"{path}: the image is empty: {width}x{height} pixels; save it again")
    if max(width, height) > LONGEST_SIDE or width * height > MOST_PIXELS:
        raise ImageError(
            f"{path}: expected at most {LONGEST_SIDE} pixels along a side and {MOST_PIXELS} in all, found "
            f"{width}x{height}; the header is damaged, or the image has to be reduced"
        )
