"""Description and faults of an image, most often a lat-long sky, read in blocks of rows."""

from pathlib import Path
from typing import Any

import numpy as np

from formats.errors import ImageError, warn
from formats.image.files import read_command
from formats.image.gamut import convert, matrix_to_rec709
from formats.image.rows import ImageRows, open_linear
from prt_bake.lights.skies.pixels import checked
from prt_bake.lights.skies.shape import refuse_cube_maps, report_stretching


def describe(path: Path) -> dict[str, Any]:
    """Return the layer of an `.exr`, the size, mean and largest radiance (Rec.709), and counts of unusable values."""
    opened, primaries = open_linear(path)
    matrix = matrix_to_rec709(path, primaries)
    largest, infinite, negative, total, count = 0.0, 0, 0, np.zeros(3), np.zeros(3, np.int64)
    for _, block in opened.blocks():
        finite = np.isfinite(block)
        total += block.sum(axis=(0, 1), dtype=np.float64, where=finite)
        count += finite.sum(axis=(0, 1))
        shown = convert(block, matrix)
        largest = max(largest, float(shown.max(where=np.isfinite(shown), initial=0)))
        infinite += int((~finite).sum())
        negative += int((block < 0).sum())
    mean = total / np.maximum(count, 1)
    layers = {"colours of": opened.layer, "other layers": list(opened.other_layers)} if opened.layer else {}
    return {
        "can be": _uses(opened),
        **layers,
        "width": opened.width,
        "height": opened.height,
        "mean radiance": (mean if matrix is None else matrix @ mean).tolist(),
        "largest radiance": largest,
        "values not finite": infinite,
        "values negative": negative,
        **({"command": command} if (command := read_command(path)) else {}),
    }


def _uses(opened: ImageRows) -> str:
    others = "a texture of a scene, a picture to compare"
    remarks: list[str] = []
    try:
        refuse_cube_maps(opened)
        report_stretching(opened, remarks.append)
    except ImageError:
        return f"{others}; as a light this cube map must be converted to a lat-long picture"
    if remarks:
        return f"{others}; a sky is twice as wide as high"
    return f"a sky (--light), {others}"


def find_faults(path: Path) -> list[str]:
    """Raise FormatError for a cube map by its header, or for pixels that are NaN, infinite or negative (first block).

    Else return no faults.
    """
    remedy = "repair the picture, or give --mend to `prtbake shade`, `view`, `render` or `light`"
    opened, primaries = open_linear(path)
    if opened.cube:  # not by its shape, which a texture may have
        refuse_cube_maps(opened)
    matrix_to_rec709(path, primaries)  # for its warning
    for _ in checked(opened, remedy, lambda sentence: warn(f"{path}: {sentence}")).blocks():
        pass
    return []
