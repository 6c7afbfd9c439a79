"""Points of an object that the camera rays of a pass hit."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ObjectPoints(NamedTuple):
    """Points seen by the eye; with the seed of the pass the keys determine all random numbers.

    faces [N]; (u, v) barycentric [N,2]; unit directions to the eye, outgoing [N,3]; keys [N]: pixel · points + point.
    """

    faces: NDArray[np.int64]
    barycentric: Array
    outgoing: Array
    keys: NDArray[np.uint64]

    def subset(self, rows: NDArray[np.int64]) -> "ObjectPoints":
        """The points with the indices `rows`."""
        return ObjectPoints._make(part[rows] for part in self)
