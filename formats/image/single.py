"""Pictures in single precision."""

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError


def single_precision(picture: NDArray[np.floating], name: str) -> NDArray[np.float32]:
    """Return a picture as float32. Raises QueryError if a value is beyond its range, 3.4e38, or is not a number."""
    with np.errstate(over="ignore"):
        found = picture.astype(np.float32)
    wrong = int((~np.isfinite(found)).any(axis=-1).sum())
    if wrong:
        raise QueryError(
            f"{name}: expected radiance within ±{np.finfo(np.float32).max:.4g}, which float32 holds, found "
            f"{wrong} pixels beyond; use weaker lights"
        )
    return found
