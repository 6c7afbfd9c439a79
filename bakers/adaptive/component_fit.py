"""A few functions of ωi for each of some lattices, and what is made of them."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from bakers.adaptive.lattice_pools import Pool

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LOOKS = (8, 4), (16, 8)
"""Directions that a bin is held against them in, at first and where these do not tell; and how many functions, the
newest, it is held against then.
"""
MOST = LOOKS[-1][1]
"""Functions of a lattice: of more the oldest are forgotten."""
LEFT_IN_COEFFICIENTS = 0.5
"""Of the energy that a fit leaves over, what may lie in the coefficients."""
ROUNDING = 2.0**-20
"""Of what is learned from, what is no more than rounded off."""
WORTH_LEARNING = 0.02
"""Of the energy that is new, what a further function must have."""
SEEN = 0.1
"""Of its root mean square over the lattice, what every sum of functions must at least have where it is looked at: the
amount of one that is not seen there is unknown.
"""


class LightFunctions:
    """Orthonormal functions of each of n lattices over D directions; zeros where there is none."""

    def __init__(self, pool: Pool, home: Array) -> None:
        """Over the lattice of a pool; `home` [n,K,K]: from coefficients on it before it is turned to those that are
        wanted.
        """
        n, (size, count) = len(home), pool.harmonics.shape
        self._pool, self.frames = pool, home
        self.picked = np.zeros((n, LOOKS[-1][0]), np.int64)
        """Directions [n,F] that bins are held against them in: where the first of them are told apart, and between."""
        self.values = np.zeros((n, size, MOST))
        """[n,D,R], the newest first"""
        self.known = np.zeros(n, np.int64)
        """How many there are."""
        self._coefficients, self._rough = np.zeros((n, count, MOST)), np.zeros((n, MOST, MOST))
        self._fits = [np.zeros((n, most, directions)) for directions, most in LOOKS]
        self._units = [np.full(n, LEFT_IN_COEFFICIENTS * 4.0 * np.pi / count) for _look in LOOKS]

    def fitted(self, rows: Index, values: Array, look: int) -> tuple[Array, Array]:
        """Amounts [M,R,3] of the functions of these lattices [M] in values [M,F,3], and the variance [M], mean over K
        and channels, of coefficients that are made of these.
        """
        directions, most = LOOKS[look]
        seen = values[:, :directions]
        amounts = self._fits[look][rows] @ seen
        functions = self.values[rows[:, None], self.picked[rows, :directions], :most]
        left = ((seen - functions @ amounts) ** 2).sum(axis=1).mean(axis=1)
        freedom = directions - np.minimum(self.known[rows], most)
        return amounts, (left / freedom + ROUNDING**2 * (seen**2).mean(axis=(1, 2))) * self._units[look][rows]

    def coefficients(self, rows: Index, amounts: Array) -> Array:
        """Of such amounts [M,r,3] of the newest functions: [M,K·3]."""
        found = self._coefficients[rows, :, : amounts.shape[1]] @ amounts
        return found.reshape(len(rows), self._coefficients.shape[1] * 3)

    def roughness(self, rows: Index, amounts: Array) -> Array:
        """What a fit of harmonics leaves over of such amounts, mean square [M] per degree of freedom."""
        most = amounts.shape[1]
        return np.asarray(np.einsum("mrc,mrs,msc->m", amounts, self._rough[rows, :most, :most], amounts) / 3.0)

    def home(self, rows: Index, plain: Array) -> Array:
        """Coefficients [M,K·3] as they are wanted, from those on the lattice before it is turned [M,K,3]."""
        return (self.frames[rows] @ plain).reshape(len(rows), plain.shape[1] * 3)

    def learn(self, rows: Index, values: Array) -> None:
        """Takes in what is new in values [m,D,3], a set for each of these lattices, which may come several times."""
        for row, found in zip(rows, values, strict=True):
            old = self.values[row]
            sides, sizes, _channels = np.linalg.svd(found - old @ (old.T @ found), full_matrices=False)
            new = sides[:, sizes**2 > max(WORTH_LEARNING * (sizes**2).sum(), ROUNDING**2 * (found**2).sum())]
            self.values[row] = np.column_stack([new, old])[:, :MOST]
            self.known[row] = min(self.known[row] + new.shape[1], MOST)
        self._prepare(np.unique(rows))

    def look_for(self, rows: Index) -> None:
        """Settles anew where the functions of these lattices are looked for."""
        for row in rows:
            functions = self.values[row, :, : self.known[row]]
            self.picked[row] = _where_to_look(functions, self._pool.directions)
        self._prepare(rows)

    def _prepare(self, rows: Index) -> None:
        functions, (size, count) = self.values[rows], self._pool.harmonics.shape
        plain = self._pool.weights @ functions
        self._coefficients[rows] = self.frames[rows] @ plain
        left = functions - self._pool.harmonics @ plain
        self._rough[rows] = left.transpose(0, 2, 1) @ left / (size - count)
        for (directions, most), fits, units in zip(LOOKS, self._fits, self._units, strict=True):
            picked = np.take_along_axis(functions[:, :, :most], self.picked[rows, :directions, None], axis=1)
            sizes = np.linalg.svd(picked, compute_uv=False)
            wanted = np.minimum(self.known[rows], most)
            least = np.take_along_axis(sizes, np.maximum(wanted - 1, 0)[:, None], axis=1)[:, 0]
            fits[rows] = np.linalg.pinv(picked, rcond=1e-6)
            wobble = ((self._coefficients[rows, :, :most] @ fits[rows]) ** 2).sum(axis=(1, 2))
            told = (wanted == 0) | (least >= SEEN * np.sqrt(directions / size))
            units[rows] = np.where(told, (LEFT_IN_COEFFICIENTS * 4.0 * np.pi + wobble) / count, np.inf)


def _where_to_look(functions: Array, directions: Array) -> Index:
    """Numbers of F of the directions [D,3]: those that tell functions [D,R] apart, and others far from these."""
    picked = np.empty(LOOKS[-1][0], np.int64)
    first = min(functions.shape[1], LOOKS[0][1])
    if first:
        picked[:first] = qr(functions[:, :first].T, mode="r", pivoting=True)[1][:first]
    else:
        picked[0], first = 0, 1
    nearest = (directions @ directions[picked[:first]].T).max(axis=1)
    for place in range(first, len(picked)):
        picked[place] = int(np.argmin(nearest))
        nearest = np.maximum(nearest, directions @ directions[picked[place]])
    return picked
