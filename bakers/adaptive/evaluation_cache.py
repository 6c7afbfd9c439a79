"""Caches values of a transport at the bins of a few vertices."""

from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

MOST_BYTES = 1 << 28


class EvaluationCache:
    """Rows of numbers by name, vertex and bin. A cached row is returned bit for bit.

    Copies in other processes start empty.
    """

    def __init__(self, vertices: Index, bins: int, most_bytes: int = MOST_BYTES) -> None:
        """Caches values at these vertices [P] only, up to `most_bytes`."""
        self._vertices, self._bins, self._most = np.sort(vertices), bins, most_bytes
        self._tables: dict[Hashable, _Table] = {}
        self._lock = Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return EvaluationCache, (self._vertices, self._bins, self._most)

    def get(
        self, name: Hashable, vertices: Index, bins: Index, evaluate: Callable[[Index], NDArray[Any]]
    ) -> tuple[NDArray[Any], int]:
        """Rows [M,...] for bins [M] of vertices [M], and how many of them were cached.

        Args:
            name: what the rows hold; rows of different names are kept apart.
            vertices, bins: [M].
            evaluate: called once, with the places [m] in `vertices` whose rows are missing; returns these rows [m,...].
        """
        here, keys = self._keys(vertices, bins)
        known, found = self._find(name, keys)
        if not len(known):
            values = evaluate(np.arange(len(vertices)))
            self._store(name, keys, values[here])
            return values, 0
        result = np.empty((len(vertices), *found.shape[1:]), found.dtype)
        result[here[known]] = found
        if len(missing := np.setdiff1d(np.arange(len(vertices)), here[known])):
            result[missing] = evaluate(missing)
            fresh = np.isin(here, missing)
            self._store(name, keys[fresh], result[here[fresh]])
        return result, len(known)

    def _keys(self, vertices: Index, bins: Index) -> tuple[Index, Index]:
        """Places [m] in the list whose vertices are cached, and their keys [m]."""
        place = np.searchsorted(self._vertices, vertices)
        place = np.minimum(place, max(len(self._vertices) - 1, 0))
        here = np.flatnonzero(self._vertices[place] == vertices) if len(self._vertices) else np.zeros(0, np.int64)
        return here, place[here] * self._bins + bins[here]

    def _find(self, name: Hashable, keys: Index) -> tuple[Index, NDArray[Any]]:
        """Indices of the cached keys [k], and their rows [k,...]."""
        with self._lock:
            table = self._tables.get(name)
            if table is None:
                return np.zeros(0, np.int64), np.zeros(0)
            at = table.at[keys]
            known = np.flatnonzero(at >= 0)
            return known, table.values[at[known]]

    def _store(self, name: Hashable, keys: Index, values: NDArray[Any]) -> None:
        with self._lock:
            stored_bytes = sum(table.values.nbytes for table in self._tables.values())
            if not len(keys) or stored_bytes + 2 * values.nbytes > self._most:
                return
            if name not in self._tables:
                empty = np.empty((0, *values.shape[1:]), values.dtype)
                self._tables[name] = _Table(np.full(len(self._vertices) * self._bins, -1, np.int64), empty)
            self._tables[name].add(keys, values)


class _Table:
    """Rows of one name, and the index of each key's row; −1 for keys without one."""

    def __init__(self, at: Index, values: NDArray[Any]) -> None:
        self.at, self.values, self._used = at, values, 0

    def add(self, keys: Index, values: NDArray[Any]) -> None:
        end = self._used + len(keys)
        if end > len(self.values):
            larger = np.empty((max(end, 2 * len(self.values)), *self.values.shape[1:]), self.values.dtype)
            larger[: self._used] = self.values[: self._used]
            self.values = larger
        self.values[self._used : end] = values
        self.at[keys] = np.arange(self._used, end)
        self._used = end


NO_CACHE = EvaluationCache(np.zeros(0, np.int64), 0)
"""Caches nothing."""
