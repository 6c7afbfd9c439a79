"""Fits lobes to what a transport holds beyond the harmonics of its asset.

Around each node (a coarse view bin) the best of a set of Gaussians is chosen and improved by steps of Gauss and Newton.
What the lobes between the nodes leave is the rest for the next lobe (matching pursuit).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.lobes.fit_kernels import refine, subtract
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci
from prt_bake.mathematics.sphere import bin_weights

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_NOTHING = 1e-6
"""Share of a Gaussian's square beyond the harmonics from which it counts."""
_SWEEPS, _COHERENCE, _WIDTH = 4, 4.0, 4.0
"""Passes over the nodes; gain of a Gaussian with the axes of all its neighbours, and the sharpness of "alike"."""
_AXES = 200


class Field(NamedTuple):
    """One lobe at each of N nodes of n vertices: unit axes [n,N,3], sharpness [n,N], powers [n,N,3]."""

    axes: Array
    sharpness: Array
    powers: Array


class LobeFit:
    """Fits lobes at rings × sectors nodes to values in the directions of P sets [P,D,3].

    local [B,3]: the views, in the local frame; sets [B]: the set of each view.
    """

    def __init__(
        self, rings: int, sectors: int, local: Array, sets: Index, directions: Array, degree: int, most: float
    ) -> None:
        """most: the largest sharpness of a lobe. Lobes much wider than the harmonics are in them."""
        least = degree + 1.0
        self._limits = least, most
        self._sets, self._directions = sets, np.ascontiguousarray(directions.transpose(0, 2, 1))
        self._harmonics = np.ascontiguousarray(np.linalg.qr(sh.evaluate(directions, degree))[0].transpose(0, 2, 1))
        self._sample = self._sets, self._directions, self._harmonics
        self._nodes, self._shares = bin_weights(local, rings, sectors)
        self._around(rings * sectors)
        ring, sector = np.divmod(np.arange(rings * sectors), sectors)
        beside = [(ring, (sector + by) % sectors) for by in (-1, 1)]
        beside += [(np.clip(ring + by, 0, rings - 1), sector) for by in (-1, 1)]
        self._neighbours = np.stack([sectors * row + column for row, column in beside], axis=1)
        self._black = (ring + sector) % 2 == 0
        axes, sharpness = fibonacci(_AXES), least * 2.0 ** np.arange(max(1, math.ceil(math.log2(most / least))))
        self._alike = np.exp(_WIDTH * (axes @ axes.T - 1.0)).astype(np.float32)
        self._axes, self._sharpness = np.tile(axes, (len(sharpness), 1)), np.repeat(sharpness, _AXES)
        atoms = np.exp(self._sharpness * (directions @ self._axes.T - 1.0))
        raw = np.square(atoms).sum(axis=1)
        atoms -= self._harmonics.transpose(0, 2, 1) @ (self._harmonics @ atoms)
        self._atoms = atoms.astype(np.float32)
        squares = np.square(atoms).sum(axis=1)
        self._norms = np.stack([w @ squares[sets[v]] for v, w in zip(self._views, self._weights, strict=True)])
        # Harmonics of a high degree hold the widest Gaussians, of which only rounding is left.
        self._norms[:, (squares < _NOTHING * raw).any(axis=0)] = np.inf

    def _around(self, count: int) -> None:
        """The views around each node [N,q] and their weights."""
        matrix = np.zeros((len(self._nodes), count))
        np.add.at(matrix, (np.arange(len(self._nodes))[:, None], self._nodes), self._shares)
        most = int((matrix > 0.0).sum(axis=0).max())
        self._views = np.ascontiguousarray(np.argsort(-matrix.T, axis=1, kind="stable")[:, :most])
        self._weights = np.ascontiguousarray(np.take_along_axis(matrix.T, self._views, axis=1))

    def beyond_harmonics(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Values [n,B,D,3] less their best fit by the harmonics [n,B,3,D]."""
        rest = np.ascontiguousarray(np.asarray(values, np.float32).transpose(0, 1, 3, 2))
        for number in range(len(self._directions)):
            some, basis = self._sets == number, self._harmonics[number].astype(np.float32)
            part = rest[:, some]
            rest[:, some] = part - (part @ basis.T) @ basis
        return rest

    def add(self, rest: NDArray[np.float32]) -> Field:
        """The next lobe for the rest [n,B,3,D], which it is subtracted from."""
        best = self._best(rest.sum(axis=2))
        axes, sharpness = self._axes[best], self._sharpness[best]
        powers = np.zeros_like(axes)
        refine(axes, sharpness, powers, self._views, self._weights, self._sample, self._limits, rest)
        field = Field(axes, sharpness, powers)
        self.subtract(field, rest)
        return field

    def subtract(self, field: Field, rest: NDArray[np.float32], times: float = 1.0) -> None:
        """Subtract what lobes add beyond the harmonics, `times` times, from the rest [n,B,3,D]."""
        subtract(*field, self._nodes, self._shares, self._sample, times, rest)

    def _best(self, grey: NDArray[np.float32]) -> Index:
        """The best Gaussian at each node [n,N] for a grey rest [n,B,D]; one like its neighbours gains more."""
        products = np.empty((len(grey), len(self._sets), len(self._axes)), np.float32)
        for number, atoms in enumerate(self._atoms):
            some = self._sets == number
            products[:, some] = grey[:, some] @ atoms
        gains = np.empty((len(grey), *self._norms.shape), np.float32)
        for node, (views, weights) in enumerate(zip(self._views, self._weights, strict=True)):
            along = np.einsum("q,nqa->na", weights.astype(np.float32), products[:, views])
            gains[:, node] = along**2 / self._norms[node]
        by_width = gains.reshape(*gains.shape[:2], -1, _AXES)
        of_axis = by_width.max(axis=2)
        axes: Index = of_axis.argmax(axis=2)
        for sweep in range(_SWEEPS):
            nodes = np.flatnonzero(self._black if sweep % 2 else ~self._black)
            alike = self._alike[axes[:, self._neighbours[nodes]]].mean(axis=2)
            axes[:, nodes] = (of_axis[:, nodes] * (1.0 + _COHERENCE * alike)).argmax(axis=2)
        widths = np.take_along_axis(by_width, axes[..., None, None], axis=3).argmax(axis=2)[..., 0]
        return np.asarray(widths * _AXES + axes)
