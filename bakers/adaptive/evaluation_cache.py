"""What a transport has answered at the bins of a few vertices, so that it need not be asked there twice."""

from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

MOST_BYTES = 1 << 28


class Answers:
    """Rows of numbers by vertex and bin, under any number of names. What is recalled is what was given: the same bits.

    Copies in other processes begin empty.
    """

    def __init__(self, vertices: Index, bins: int, most_bytes: int = MOST_BYTES) -> None:
        """Remembers what is asked at these vertices [P], and at no others, up to so many bytes."""
        self._vertices, self._bins, self._most = np.sort(vertices), bins, most_bytes
        self._kept: dict[Hashable, _Rows] = {}
        self._lock = Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return Answers, (self._vertices, self._bins, self._most)

    def given(
        self, name: Hashable, vertices: Index, bins: Index, ask: Callable[[Index], NDArray[Any]]
    ) -> tuple[NDArray[Any], int]:
        """Rows [M,...] for bins [M] of vertices [M], from `ask` (places in M [m] → [m,...]) where they are not known;
        and how many were.
        """
        here, keys = self._keys(vertices, bins)
        known, found = self._recalled(name, keys)
        if not len(known):
            answered = ask(np.arange(len(vertices)))
            self._keep(name, keys, answered[here])
            return answered, 0
        whole = np.empty((len(vertices), *found.shape[1:]), found.dtype)
        whole[here[known]] = found
        if len(missing := np.setdiff1d(np.arange(len(vertices)), here[known])):
            whole[missing] = ask(missing)
            fresh = np.isin(here, missing)
            self._keep(name, keys[fresh], whole[here[fresh]])
        return whole, len(known)

    def _keys(self, vertices: Index, bins: Index) -> tuple[Index, Index]:
        """Places [m] in the list of those that are remembered, and where that is [m]."""
        place = np.searchsorted(self._vertices, vertices)
        place = np.minimum(place, max(len(self._vertices) - 1, 0))
        here = np.flatnonzero(self._vertices[place] == vertices) if len(self._vertices) else np.zeros(0, np.int64)
        return here, place[here] * self._bins + bins[here]

    def _recalled(self, name: Hashable, keys: Index) -> tuple[Index, NDArray[Any]]:
        """Which of the keys are known [k], and their rows [k,...]."""
        with self._lock:
            rows = self._kept.get(name)
            if rows is None:
                return np.zeros(0, np.int64), np.zeros(0)
            at = rows.at[keys]
            known = np.flatnonzero(at >= 0)
            return known, rows.values[at[known]]

    def _keep(self, name: Hashable, keys: Index, answered: NDArray[Any]) -> None:
        with self._lock:
            bytes_kept = sum(rows.values.nbytes for rows in self._kept.values())
            if not len(keys) or bytes_kept + 2 * answered.nbytes > self._most:
                return
            if name not in self._kept:
                empty = np.empty((0, *answered.shape[1:]), answered.dtype)
                self._kept[name] = _Rows(np.full(len(self._vertices) * self._bins, -1, np.int64), empty)
            self._kept[name].add(keys, answered)


class _Rows:
    """Rows of one name, and where each key has its own; −1 for keys that have none."""

    def __init__(self, at: Index, values: NDArray[Any]) -> None:
        self.at, self.values, self._used = at, values, 0

    def add(self, keys: Index, answered: NDArray[Any]) -> None:
        end = self._used + len(keys)
        if end > len(self.values):
            larger = np.empty((max(end, 2 * len(self.values)), *self.values.shape[1:]), self.values.dtype)
            larger[: self._used] = self.values[: self._used]
            self.values = larger
        self.values[self._used : end] = answered
        self.at[keys] = np.arange(self._used, end)
        self._used = end


NOTHING = Answers(np.zeros(0, np.int64), 0)
"""Remembers nothing."""
