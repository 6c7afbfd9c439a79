"""Which vertices, views, bands and channels a bake evaluates, and which of them its asset keeps."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bakers.plan import PrunableItem
from formats.errors import QueryError
from prt_bake.baking.job.views import Views

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST_ROUNDING = 0.8
"""Largest share of the requested error that rounding may take up."""
SHARE_OF_ERROR = 0.25
"""Share of the requested error that each pruned item may add."""


@dataclass(frozen=True)
class Light:
    """The only light that an asset is made for."""

    coefficients: Array
    """[K,3] of radiance, of the bake's degree or a higher one."""
    name: str
    content_hash: str


@dataclass(frozen=True)
class Pruning:
    """What is baked, and what the asset keeps of it."""

    vertices: Index
    """Indices of the vertices that are baked."""
    copies: NDArray[np.int64]
    """[n,2]: a vertex, and the baked vertex that it duplicates."""
    views: str
    """"all", "one" (coefficients do not depend on the view) or "eye" (a single direction at each vertex)."""
    local: Array
    """Directions [B,3] of the baked view bins in the local frame."""
    outgoing: Views
    degree: int
    """Of the baked harmonics."""
    kept_degree: int
    channels: int
    light: Light | None = None
    tolerated: float = 0.0
    """Relative error that each pruned item may add."""
    signal: float = 0.0
    """Mean square coefficient in the pilot."""
    evaluations: int = 0
    pruned: list[PrunableItem] = field(default_factory=list)
    kept: list[PrunableItem] = field(default_factory=list)
    rounding: float = 0.0
    """Relative RMSE that the precision of the transport's arithmetic adds."""

    def left_for_projection(self, error: float) -> float:
        """The part of the requested error that remains for the projection, after rounding and the shares of the pruned
        items. Raises QueryError if rounding alone takes up too much.
        """
        if self.rounding > MOST_ROUNDING * error:
            raise QueryError(
                f"error: half precision alone adds {self.rounding:.2g}, allowed are {MOST_ROUNDING:.0%} of the "
                f"requested {error:g}; bake in float32 or request a larger error"
            )
        items = (self.views == "one") + (self.kept_degree < self.degree) + (self.channels == 1)
        return error * float(np.sqrt(1.0 - items * SHARE_OF_ERROR**2 - (self.rounding / error) ** 2))
