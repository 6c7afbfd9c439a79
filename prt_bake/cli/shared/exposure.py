"""Whether a picture is exposed well: a remark on objects that clip, and on dark ones."""

import math

import numpy as np
from numpy.typing import NDArray

MOST_CLIPPED = 0.05
"""Share of the object above white from which it is remarked."""
DARKEST = 0.04
"""99th percentile of the object, white being 1, below which it is remarked: a fifth of white in sRGB."""


def exposure_remark(image: NDArray[np.floating], coverage: NDArray[np.floating], exposure: float = 0.0) -> str | None:
    """A sentence on the exposure of the object in a picture that clips at 1; None if it is well exposed or not visible.

    Args:
        image: linear radiance [H,W,3].
        coverage: share of each pixel that the object covers [H,W].
        exposure: stops that the picture is multiplied by.

    >>> import numpy as np
    >>> exposure_remark(np.full((2, 2, 3), 3.0), np.ones((2, 2)))
    '100% of the object is brighter than white and is clipped; --exposure -2 shows it, or --tone-map agx'
    """
    covered = coverage >= 0.99
    if not covered.any():
        return None
    brightest = image[covered].max(axis=-1) * 2.0**exposure
    clipped, level = float((brightest > 1.0).mean()), float(np.percentile(brightest, 99))
    if clipped > MOST_CLIPPED:
        return (
            f"{clipped:.0%} of the object is brighter than white and is clipped; "
            f"--exposure {_stops(exposure, level)} shows it, or --tone-map agx"
        )
    if 0.0 < level < DARKEST:
        return f"the object is dark; --exposure {_stops(exposure, level)} brightens it"
    return None


def _stops(exposure: float, level: float) -> str:
    """The exposure, in half stops, at which `level` is just below white."""
    return f"{math.floor(2.0 * (exposure - math.log2(level))) / 2.0:g}"
