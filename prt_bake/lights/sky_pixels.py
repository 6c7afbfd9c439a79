"""Pixels of a picture that are no radiance, NaN, infinite or negative: refused, or mended, block by block of rows."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import ImageError
from formats.image.rows import Block, ImageRows

REMEDY = "repair the picture"


def checked(rows: ImageRows, remedy: str = REMEDY) -> ImageRows:
    """`rows` whose blocks raise ImageError (count, first place, `remedy`) where a pixel is not finite or below 0."""

    def blocks() -> Iterator[Block]:
        for _, block in rows.blocks():
            if not _sound(block):
                raise refusal(rows, remedy=remedy)
            yield block

    return replace(rows, open_blocks=blocks)


def mended(rows: ImageRows, say: Callable[[str], None]) -> ImageRows:
    """`rows` with NaN, negative and −∞ replaced by 0 and +∞ by the largest finite value of the picture (0 if there is
    none).

    Once the last block is through, `say` is told what was changed, if anything was. A picture with infinite pixels is
    read twice.
    """
    return replace(rows, open_blocks=lambda: _mended_blocks(rows, say))


def telling_black(rows: ImageRows, say: Callable[[str], None]) -> ImageRows:
    """`rows`; once the last block is through, `say` is told if nothing in them shines."""

    def blocks() -> Iterator[Block]:
        black = True
        for _, block in rows.blocks():
            black = black and not block.any()
            yield block
        if black:
            say("is black: it gives no light")

    return replace(rows, open_blocks=blocks)


def refusal(rows: ImageRows, negative: bool = False, remedy: str = REMEDY) -> ImageError:
    """The fault of a picture of whose pixels some are not finite or, unless `negative` will do, below 0."""
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
        f"({_told(counts)}), the first at {first}; {remedy}"
    )


def _mended_blocks(rows: ImageRows, say: Callable[[str], None]) -> Iterator[Block]:
    largest: float | None = None
    counts = dict.fromkeys(("NaN", "negative", "infinite"), 0)
    for _, block in rows.blocks():
        if _sound(block):
            yield block
            continue
        bright, dark = block == np.inf, ~(block >= 0)
        if largest is None and bright.any():
            largest = _largest(rows)
        _count(block[bright | dark], counts)
        repaired = block.astype(np.float32)
        repaired[dark] = 0.0
        repaired[bright] = largest or 0.0
        yield repaired
    infinite = counts.pop("infinite")
    deeds = [f"{_told(counts)} set to 0"] if any(counts.values()) else []
    if infinite:
        deeds.append(f"{infinite} infinite set to {largest:g}, the largest finite one")
    if deeds:
        say(f"mended {sum(counts.values()) + infinite} values: {', '.join(deeds)}")


def _sound(block: Block) -> bool:
    if (
        block.dtype == np.float16 and block.view(np.uint16).max() < _INFINITE_HALF
    ):  # extremes of halves are slow to find
        return True
    # A NaN is its own extreme, and passes neither comparison.
    return bool(block.min() >= 0 and block.max() < np.inf)


_INFINITE_HALF = 0x7C00
"""As a number, the bits of the half +∞: those of NaN and of all that is negative are more."""


def _largest(rows: ImageRows) -> float:
    return max(float(block.max(where=np.isfinite(block), initial=0)) for _, block in rows.blocks())


def _count(values: NDArray[np.floating[Any]], counts: dict[str, int]) -> None:
    counts["NaN"] += int(np.isnan(values).sum())
    counts["infinite"] += int((values == np.inf).sum())
    counts["negative"] += int((values < 0).sum())


def _told(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
