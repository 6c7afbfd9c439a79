"""The queries that a run has traced, kept to be learned from again: their views, and a_lm of all their walks.

A query takes 82 bytes, so that the queries of an hour on a few cores stay below a gigabyte.
"""

import threading
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from prt_bake.mathematics import sh
from prt_bake.network.low_bands import LOW_COUNT, LOW_DEGREE

_LEAST_PEAK = 1e-30
CAPACITY = 1 << 23


class Traced(NamedTuple):
    """Queries: views float32 [N,6] as in rows, and coefficients float16 [N,27] over peaks float32 [N,1]."""

    views: Tensor
    peaks: Tensor
    relative: Tensor

    def coefficients(self, chosen: Any) -> Tensor:
        """The mean T · Y_lm [M,9,3], float32, of the walks of each of the queries `chosen`."""
        return (self.relative[chosen].float() * self.peaks[chosen]).view(-1, LOW_COUNT, 3)


class TracedQueries:
    """The latest queries of a run, on the device that traced them; may be used from several threads."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        """No queries. Blocks of the oldest ones are forgotten beyond `capacity` queries."""
        self._capacity = capacity
        self._blocks: list[Traced] = []
        self._next = 0
        self._lock = threading.Lock()

    def add(self, first: int, views: Any, coefficients: Any) -> None:
        """Append queries first … first + N − 1: views [N,6] as in rows, and the mean T · Y_lm [N,27] of their walks.

        Queries that were added before are ignored: a renderer may trace a block again after resuming.
        """
        views, coefficients = torch.as_tensor(views).float().clone(), torch.as_tensor(coefficients)
        peaks = coefficients.abs().amax(dim=1, keepdim=True).clamp(min=_LEAST_PEAK)
        block = Traced(views, peaks.float(), (coefficients / peaks).half())
        with self._lock:
            if first < self._next:
                return
            self._blocks.append(block)
            self._next = first + len(views)
            while sum(len(each.views) for each in self._blocks[1:]) >= self._capacity:
                del self._blocks[0]

    def joined(self) -> Traced | None:
        """All queries that are kept; None if there are none."""
        with self._lock:
            if len(self._blocks) > 1:
                joined = (torch.cat(parts)[-self._capacity :] for parts in zip(*self._blocks, strict=True))
                self._blocks = [Traced._make(joined)]
            return self._blocks[0] if self._blocks else None

    def state(self) -> dict[str, Any]:
        """State to continue from."""
        kept = self.joined()
        return {"next": self._next, "parts": [] if kept is None else [part.cpu() for part in kept]}

    def restore(self, state: dict[str, Any], device: torch.device | str = "cpu") -> None:
        """Continue from `state` on a device."""
        self._next = int(state["next"])
        self._blocks = [Traced._make(part.to(device) for part in state["parts"])] if state["parts"] else []


def mean_coefficients(directions: NDArray[Any], throughput: NDArray[Any]) -> NDArray[np.float64]:
    """The mean T · Y_lm(ω) [N,27] over the exits of P walks: directions and throughput [N,P,3]."""
    count, walks = directions.shape[:2]
    basis = sh.evaluate(directions.reshape(-1, 3), LOW_DEGREE).reshape(count, walks, LOW_COUNT)
    return np.asarray(basis.transpose(0, 2, 1) @ throughput / walks).reshape(count, -1)
