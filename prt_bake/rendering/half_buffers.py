"""A path-traced reference in two half buffers, which give the effect of its noise on any metric.

With the means A and B over n_A and n_B passes, the reference is R = (n_A A + n_B B) / N. The difference
e = (A − B) √(n_A n_B) / N has the variance of R's error and is uncorrelated with it. A smooth picture P and P + e
therefore differ by noise like R's own, with its distribution and its fireflies, without tracing a second picture.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from prt_bake.rendering.loop import Rendering

Array = NDArray[np.float64]


@dataclass
class HalfBuffers:
    """Sums over passes: radiance in half buffers [2,H,W,3], squared errors [H,W,3], coverage [H,W]; and the cost."""

    radiance: Array
    variance: Array
    coverage: Array
    passes: list[int] = field(default_factory=lambda: [0, 0])
    pictures: int = 0
    spp: int = 0
    walks: int = 0
    seconds: float = 0.0

    @classmethod
    def empty(cls, size: int) -> "HalfBuffers":
        """Sums of no passes."""
        return cls(np.zeros((2, size, size, 3)), np.zeros((size, size, 3)), np.zeros((size, size)))

    def add(self, picture: Rendering) -> None:
        """Add a picture to the half buffer with fewer passes."""
        half = int(self.passes[1] < self.passes[0])
        self.radiance[half] += picture.passes * picture.image.astype(np.float64)
        self.variance += (picture.passes * picture.standard_error.astype(np.float64)) ** 2
        self.coverage += picture.passes * picture.coverage.astype(np.float64)
        self.passes[half] += picture.passes
        self.pictures += 1
        self.spp += picture.spp
        self.walks += picture.walks
        self.seconds += picture.seconds

    @property
    def image(self) -> Array:
        """The reference R [H,W,3]."""
        return np.asarray(self.radiance.sum(axis=0) / sum(self.passes))

    @property
    def standard_error(self) -> Array:
        """Standard error of R [H,W,3], from the variance between passes."""
        return np.sqrt(self.variance) / sum(self.passes)

    @property
    def noise(self) -> Array:
        """The e of the module's docstring [H,W,3], which has the variance of R's error."""
        first, second = self.passes
        difference = self.radiance[0] / first - self.radiance[1] / second
        return np.asarray(difference * math.sqrt(first * second) / (first + second))
