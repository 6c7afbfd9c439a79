"""The error of an asset's coefficients compared with path-traced ones: the network's, the bake's, and both together.

The network's is the attribute `network_error` of the file: three numbers, the figure and the ends of its interval.
"""

import math
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from formats.hdf5_file import attribute
from formats.summary import summary

ATTRIBUTE = "network_error"


class ErrorInterval(NamedTuple):
    """A relative RMSE and the ends of its 95 % confidence interval, which are NaN if they are unknown."""

    value: float
    low: float = math.nan
    high: float = math.nan

    def __str__(self) -> str:
        return f"{self.value:.2%} " + (
            "(interval unknown)" if math.isnan(self.low) else f"({self.low:.2%} to {self.high:.2%})"
        )


@dataclass(frozen=True)
class TotalError:
    """The relative RMSE of an asset's coefficients a_lm; printed, it is one line, the figure of all first.

    Attributes:
        network: of the network compared with path tracing, up to degree 2 over the surface; None if it is unknown.
        bake: of the bake compared with what was baked, compression included; None if it is unknown.
        path_traced: whether a scene was baked, without a network.

    >>> print(TotalError(ErrorInterval(0.06, 0.05, 0.08), 0.01))
    6.08% (5.10% to 8.06%): the network is off by 6.00%, the bake is off by 1.00%
    """

    network: ErrorInterval | None
    bake: float | None
    path_traced: bool = False

    __repr__ = summary

    @property
    def total(self) -> ErrorInterval | None:
        """Both together, the root of the sum of their squares; None if one is unknown. The bake adds no interval."""
        network = ErrorInterval(0.0) if self.path_traced else self.network
        if network is None or self.bake is None:
            return None
        return ErrorInterval(*(math.hypot(part, self.bake) for part in network))

    def as_json(self) -> dict[str, Any]:
        """The figures: [value, low, high] of both together and of the network, and the bake's; None for unknown."""
        both, network = (
            None if error is None else [None if math.isnan(part) else part for part in error]
            for error in (self.total, self.network)
        )
        return {"total": both, "network": network, "bake": self.bake}

    def __str__(self) -> str:
        total: object = "unknown" if self.total is None else self.total
        network = "the network's error is unknown"
        if self.path_traced:
            total, network = _percent(self.bake), "path traced, without a network"
        elif self.network is not None:
            network = f"the network is off by {_percent(self.network.value)}"
        bake = "the bake's error is unknown" if self.bake is None else f"the bake is off by {_percent(self.bake)}"
        return f"{total}: {network}, {bake}"


def _percent(error: float | None) -> str:
    return "unknown" if error is None else f"{error:.2%}"


def read_network_error(file: Any) -> ErrorInterval | None:
    """The attribute of an open asset without faults; None if it has none."""
    return ErrorInterval(*map(float, attribute(file, ATTRIBUTE))) if ATTRIBUTE in file.attrs else None


def network_error_faults(file: Any) -> Iterator[str]:
    """Yield a sentence if the attribute of an open asset is not a figure and its interval."""
    if ATTRIBUTE not in file.attrs:
        return
    values = np.asarray(attribute(file, ATTRIBUTE))
    if values.shape == (3,) and values.dtype.kind == "f" and 0.0 <= values[0] < math.inf:
        low, high = values[1:]
        if 0.0 <= low <= high < math.inf or np.isnan([low, high]).all():
            return
    yield (
        f"the attribute {ATTRIBUTE} is {reprlib.repr(values.tolist())}; expected three numbers, an error from 0 on and "
        "the ends of its interval, which are NaN if unknown"
    )
