"""Tables of incident directions, which a fused network computes once and then reads for every view bin."""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from itertools import pairwise
from threading import Lock
from typing import Any, NamedTuple

from numpy.typing import ArrayLike, NDArray
from torch import Tensor

MOST_TABLES = 12
"""Tables that are cached, those of the incident arrays used last."""


class LightTable(NamedTuple):
    """Precomputed values of R sets of D directions [R,D,3], float32.

    table: cosines and sines of their phases [R,D,2F], or their contributions to late layers [layers,R,D,width].
    """

    table: Tensor
    directions: Tensor


class CachedTables:
    """The tables of the incident arrays used last; safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._tables: OrderedDict[int, tuple[ArrayLike, LightTable]] = OrderedDict()

    def find(self, key: ArrayLike, compute: Callable[[], LightTable]) -> LightTable:
        """The table of the array object `key`, computed if it is not cached."""
        with self._lock:
            # The array is kept beside its table, so that no other array can get its id meanwhile.
            if id(key) not in self._tables:
                self._tables[id(key)] = key, compute()
                if len(self._tables) > MOST_TABLES:
                    self._tables.popitem(last=False)
            self._tables.move_to_end(id(key))
            return self._tables[id(key)][1]


def table_bounds(light: NDArray[Any], max_rows: int) -> Iterator[tuple[int, int]]:
    """(first, last) of ranges of the D directions of light [R,D,3], of nearly `max_rows` (rotation, direction) rows."""
    copies, directions = light.shape[:2]
    step = -(-directions // -(-directions // max(1, max_rows // copies)))
    return pairwise([*range(0, directions, step), directions])
