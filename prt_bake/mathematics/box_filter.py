"""Box filter along one axis: the weights that average rows or columns of an image to those of a smaller image."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]


def box_filter(fine: int, coarse: int, measure: Callable[[Array, Array], Array]) -> "csr_array":
    """Weights [coarse, fine] that average `fine` equal cells of the unit interval over `coarse` equal cells.

    A weight is proportional to the size of the overlap. Each row sums to 1.

    measure: (ends [S], beginnings [S]) → sizes of these intervals in [0, 1].
    """
    from scipy.sparse import csr_array

    cuts = np.union1d(np.arange(fine + 1) * coarse, np.arange(coarse + 1) * fine)  # in parts of fine · coarse, exact
    begins, ends = cuts[:-1], cuts[1:]
    within, part = begins // fine, begins // coarse
    size = measure(ends / (fine * coarse), begins / (fine * coarse))
    size /= np.bincount(within, size)[within]
    return csr_array((size, (within, part)), (coarse, fine))


def zone(end: Array, begin: Array) -> Array:
    """Solid angle between two latitudes, up to a factor; latitudes are 0 at one pole and 1 at the other."""
    return np.asarray(np.sin(math.pi * 0.5 * (begin + end)) * np.sin(math.pi * 0.5 * (end - begin)))
