"""Which vertices, views, bands and channels a bake evaluates, and which of them its asset keeps."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bakers.plan import Item
from formats.errors import QueryError
from prt_bake.baking.job.views import Views

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST_ROUNDING = 0.8
"""Of an error asked for, what rounding may take up."""
SHARE_OF_ERROR = 0.25
"""Of the error asked for, what each item may add."""


@dataclass(frozen=True)
class Light:
    """A light that an asset is made for."""

    coefficients: Array
    """[K,3] of radiance, of the bake's degree or a higher one."""
    name: str
    content_hash: str


@dataclass(frozen=True)
class Needs:
    """What is baked, and what the asset keeps of it."""

    vertices: Index
    """Numbers of those that are baked."""
    copies: NDArray[np.int64]
    """[n,2]: a vertex, and the baked one that it is the same as."""
    views: str
    """"all", "one" (the view does not matter) or "eye" (a single direction at each vertex)."""
    local: Array
    """Where the baked bins lie in the local frame [B,3]."""
    outgoing: Views
    degree: int
    """That is baked."""
    kept_degree: int
    channels: int
    light: Light | None = None
    tolerated: float = 0.0
    signal: float = 0.0
    """Mean square coefficient that the look saw."""
    evaluations: int = 0
    left_out: list[Item] = field(default_factory=list)
    kept: list[Item] = field(default_factory=list)
    rounding: float = 0.0
    """Relative RMSE that the precision of the transport's arithmetic adds."""

    def left_for_projection(self, error: float) -> float:
        """Of an error asked for, what remains for the projection beside rounding, and where each item left out may add
        its share. Raises QueryError where rounding alone is too much.
        """
        if self.rounding > MOST_ROUNDING * error:
            raise QueryError(
                f"error: rounding alone adds {self.rounding:.2g}, too much of the {error:g} asked for; bake in float32"
            )
        items = (self.views == "one") + (self.kept_degree < self.degree) + (self.channels == 1)
        return error * float(np.sqrt(1.0 - items * SHARE_OF_ERROR**2 - (self.rounding / error) ** 2))
