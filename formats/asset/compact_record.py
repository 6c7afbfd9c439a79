"""Compact coefficients: integers, mostly zero, times a basis over view bins and a basis over harmonics.

coefficients[v,b,k,c] = step · Σ_p codes[p,v] · view[view_component[p],b] · channel[channel_component[p],k,c]
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.summary import summary

_BLOCK_VERTICES = 64


@dataclass(frozen=True)
class FactorisedViews:
    """A separable basis over view bins: every product of a function over rings and a function over sectors.

    Attributes:
        rings: float32 [I,rings].
        sectors: float32 [J,sectors]; function J·i + j is rings[i] at the ring times sectors[j] at the sector.
    """

    rings: NDArray[np.float32]
    sectors: NDArray[np.float32]

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The basis functions at the bins [I·J,B]."""
        return np.asarray(np.kron(self.rings.astype(np.float64), self.sectors.astype(np.float64)), np.float64)


@dataclass(frozen=True)
class LearnedViews:
    """A basis over view bins, quantised to integers with one scale per function.

    Attributes:
        codes: int32 [R,B].
        scale: float32 [R].
    """

    codes: NDArray[np.int32]
    scale: NDArray[np.float32]

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The basis functions at the bins [R,B]."""
        return self.codes * self.scale.astype(np.float64)[:, None]


@dataclass(frozen=True)
class AddedError:
    """The relative error that compression added: √(Σ|decoded − original|² / Σ|original|²) over valid vertices.

    Attributes:
        requested: the requested bound on `total`.
        total: over the complete object.
        percentile_95: 95th percentile of the same ratio per vertex.
        worst: its maximum over vertices.
        per_vertex: float32 [V], absolute: root mean square over B, K and C.
    """

    requested: float
    total: float
    percentile_95: float
    worst: float
    per_vertex: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class CompactCoefficients:
    """Coefficients [V,B,K,C] that are decoded on indexing: `compact[rows]` is a float32 array.

    The nonzero codes are stored vertex by vertex: those of vertex v are values[starts[v]:starts[v+1]].

    Attributes:
        step: quantisation step, the value of code 1.
        views: the basis over view bins, R functions.
        channels: float32 [J,K,C], the basis over harmonics and channels.
        view_component: int64 [P], index of the view function of each component.
        channel_component: int64 [P], index of the function over harmonics and channels of each component, ascending.
        starts: int64 [V+1].
        components: uint16 or uint32 [N], ascending within a vertex.
        values: int16 or int32 [N].
        added: the error of compression.
    """

    step: float
    views: FactorisedViews | LearnedViews
    channels: NDArray[np.float32]
    view_component: NDArray[np.int64]
    channel_component: NDArray[np.int64]
    starts: NDArray[np.int64]
    components: NDArray[np.unsignedinteger]
    values: NDArray[np.signedinteger]
    added: AddedError

    @cached_property
    def view_matrix(self) -> NDArray[np.float64]:
        """The view functions at the bins [R,B]."""
        return self.views.matrix

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Lengths of the axes V, B, K and C."""
        terms, channels = self.channels.shape[1:]
        return len(self.starts) - 1, self.view_matrix.shape[1], terms, channels

    @property
    def dtype(self) -> np.dtype[np.float32]:
        """The type of decoded coefficients."""
        return np.dtype(np.float32)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[np.float32]:
        """Index the first axis by an integer, a slice, an array of integers or bool, or `...`."""
        rows = np.arange(len(self))[key]
        decoded = np.zeros((rows.size, *self.shape[1:]), np.float32)
        for first in range(0, rows.size, _BLOCK_VERTICES):
            block = slice(first, first + _BLOCK_VERTICES)
            decoded[block] = self.decode(rows.reshape(-1)[block])
        return decoded.reshape(*rows.shape, *self.shape[1:])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self[:].astype(dtype or np.float32, copy=False)

    def decode(self, vertices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the coefficients [n,B,K,C] of some vertices [n]."""
        _, bins, terms, channels = self.shape
        functions, width = len(self.view_matrix), len(self.channels)
        index = self.view_component * width + self.channel_component
        core = np.empty((len(vertices), functions * width))
        for row, vertex in enumerate(vertices.tolist()):
            codes = slice(self.starts[vertex], self.starts[vertex + 1])
            core[row] = np.bincount(index[self.components[codes]], self.values[codes], functions * width)
        by_view = core.reshape(len(vertices), functions, width) @ self.channels.reshape(len(self.channels), -1).astype(
            np.float64
        )
        decoded = self.step * np.matmul(self.view_matrix.T, by_view)
        return np.asarray(decoded.reshape(len(vertices), bins, terms, channels))

    __repr__ = summary
