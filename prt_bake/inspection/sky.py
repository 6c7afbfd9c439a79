"""Description and faults of a lat-long sky, read in blocks of rows."""

from pathlib import Path
from typing import Any

import numpy as np

from formats.image.rows import open_image
from prt_bake.lights.skies.pixels import checked


def describe(path: Path) -> dict[str, Any]:
    """Return the size, the mean and largest radiance, and counts of unusable values."""
    opened = open_image(path)
    largest, infinite, negative, total, count = 0.0, 0, 0, np.zeros(3), np.zeros(3, np.int64)
    for _, block in opened.blocks():
        finite = np.isfinite(block)
        total += block.sum(axis=(0, 1), dtype=np.float64, where=finite)
        count += finite.sum(axis=(0, 1))
        largest = max(largest, float(block.max(where=finite, initial=0)))
        infinite += int((~finite).sum())
        negative += int((block < 0).sum())
    return {
        "width": opened.width,
        "height": opened.height,
        "mean radiance": (total / np.maximum(count, 1)).tolist(),
        "largest radiance": largest,
        "values not finite": infinite,
        "values negative": negative,
    }


def find_faults(path: Path) -> list[str]:
    """Raise FormatError at the first block with pixels that are NaN, infinite or negative; else return no faults."""
    remedy = "repair the picture, or give --mend to `prtbake shade`, `view`, `render` or `light`"
    for _ in checked(open_image(path), remedy).blocks():
        pass
    return []
