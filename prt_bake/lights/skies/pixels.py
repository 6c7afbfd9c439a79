"""Bad pixels of skies (NaN, infinite or negative), refused or repaired in blocks of rows."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError
from formats.image.rows import Block, ImageRows

REMEDY = "repair the picture"
_LOSS = 1e-3
"""Share of the median of a picture below which a negative value is a loss of compression, not a fault."""
_INFINITE_HALF = 0x7C00
"""Bits of the float16 +∞. As integers, the bits of NaN and of all negative values are larger."""
_INFINITE_FLOAT = 0x7F80
"""The upper half of the bits of the float32 +∞."""


def checked(rows: ImageRows, remedy: str = REMEDY, say: Callable[[str], None] | None = None) -> ImageRows:
    """`rows` whose blocks raise ImageError (count, first bad pixel, `remedy`) if a pixel is not finite or negative.

    Negative values down to a thousandth of the median, which lossy compression leaves, become 0. `say` is called
    with their number after the last block. A picture with negative values is read twice.
    """

    def blocks() -> Iterator[Block]:
        tolerated, count = 0.0, 0
        for _, block in rows.blocks():
            if _is_radiance(block):
                yield block
                continue
            tolerated = tolerated or _LOSS * _median(rows)
            negative = block < 0
            if not (np.isfinite(block).all() and block.min() >= -tolerated):
                raise bad_pixels_error(rows, remedy=remedy)
            count += int(negative.sum())
            yield np.where(negative, 0, block)
        if count and say:
            say(f"{count} values are negative, by less than {_LOSS:g} of the median, and are set to 0")

    return replace(rows, open_blocks=blocks)


def repaired(rows: ImageRows, say: Callable[[str], None]) -> ImageRows:
    """`rows` with NaN, negative and −∞ set to 0, and +∞ set to the largest finite value of the picture (0 if none).

    `say` is called with the changes, if there are any, after the last block. A picture with infinite pixels is read
    twice.
    """
    return replace(rows, open_blocks=lambda: _repaired_blocks(rows, say))


def reporting_black(rows: ImageRows, say: Callable[[str], None]) -> ImageRows:
    """`rows` that call `say` after the last block if all pixels are 0."""

    def blocks() -> Iterator[Block]:
        black = True
        for _, block in rows.blocks():
            black = black and not block.any()
            yield block
        if black:
            say("is black: it gives no light")

    return replace(rows, open_blocks=blocks)


def bad_pixels_error(rows: ImageRows, negative: bool = False, remedy: str = REMEDY) -> ImageError:
    """The error for a picture with pixels that are not finite or, unless `negative` is allowed, below 0."""
    bad, first, counts = 0, "", dict.fromkeys(("NaN", "infinite", "negative"), 0)
    for start, block in rows.blocks():
        wrong = ~np.isfinite(block) | ((block < 0) & (not negative))
        pixels = wrong.any(axis=-1)
        if not first and pixels.any():
            row, column = (int(index) for index in np.argwhere(pixels)[0])
            value = ", ".join(f"{channel:g}" for channel in block[row, column].tolist())
            first = f"row {start + row}, column {column}: ({value})"
        bad += int(pixels.sum())
        _count(block[wrong], counts)
    expected = "finite values" + ("" if negative else " of 0 or more")
    return ImageError(
        f"{rows.path}: expected {expected}, found {bad} of {rows.height * rows.width} pixels with others "
        f"({_listed(counts)}), the first at {first}; {remedy}"
    )


def _repaired_blocks(rows: ImageRows, say: Callable[[str], None]) -> Iterator[Block]:
    largest: float | None = None
    counts = dict.fromkeys(("NaN", "negative", "infinite"), 0)
    for _, block in rows.blocks():
        if _is_radiance(block):
            yield block
            continue
        infinite, invalid = block == np.inf, ~(block >= 0)
        if largest is None and infinite.any():
            largest = _largest_finite(rows)
        _count(block[infinite | invalid], counts)
        fixed = block.astype(np.float32)
        fixed[invalid] = 0.0
        fixed[infinite] = largest or 0.0
        yield fixed
    infinite_count = counts.pop("infinite")
    changes = [f"{_listed(counts)} set to 0"] if any(counts.values()) else []
    if infinite_count:
        changes.append(f"{infinite_count} infinite set to {largest:g}, the largest finite one")
    if changes:
        say(f"repaired {sum(counts.values()) + infinite_count} values: {', '.join(changes)}")


def _is_radiance(block: Block) -> bool:
    # min and max of float16 are slow: compare the bits first.
    if block.dtype == np.float16 and block.view(np.uint16).max() < _INFINITE_HALF:
        return True
    # NaN propagates to min and max, and fails both comparisons.
    return bool(block.min() >= 0 and block.max() < np.inf)


def _median(rows: ImageRows) -> float:
    """The median of the positive finite values, to 0.4 % (rounded down); 0 if there are none.

    Values are counted by the upper half of their float32 bits, so that the memory does not grow with the picture.
    """
    counts = np.zeros(_INFINITE_FLOAT, np.int64)
    for _, block in rows.blocks():
        bits = block[(block > 0) & (block < np.inf)].astype(np.float32).view(np.uint32) >> 16
        counts += np.bincount(bits, minlength=_INFINITE_FLOAT)
    below = np.cumsum(counts)
    middle = np.searchsorted(below, (below[-1] + 1) // 2)
    return float(np.uint32(middle << 16).view(np.float32)) if below[-1] else 0.0


def _largest_finite(rows: ImageRows) -> float:
    return max(float(block.max(where=np.isfinite(block), initial=0)) for _, block in rows.blocks())


def _count(values: NDArray[np.floating[Any]], counts: dict[str, int]) -> None:
    counts["NaN"] += int(np.isnan(values).sum())
    counts["infinite"] += int((values == np.inf).sum())
    counts["negative"] += int((values < 0).sum())


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
