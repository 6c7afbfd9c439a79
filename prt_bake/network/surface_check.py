"""Checks that a mesh is the surface of the object that a network was trained on.

Ŝ of a network is meaningless elsewhere, even inside its box. The grid of the network's interior has the signed
distances to its own surface, to a third of the grid's spacing.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError, warn
from formats.mesh import Mesh, inward_sentence
from prt_bake.network.features.interior import LEVELS, REACH, Interior

Array = NDArray[np.float64]

TOLERANCE = 1.0
"""Largest distance of a vertex on the surface, in spacings. Vertices of the training mesh are within 0.35."""
MOST_OFF = 0.1
"""Share of vertices off the surface from which the mesh is another object; down to `FEW_OFF` it is a variant."""
FEW_OFF = 0.01
_MATCHES = 0.95
"""Share of vertices that a transformation must bring onto the surface to be named as the cause."""
_UNKNOWN = "bake the mesh of the model's own scene, or train a model on this mesh"
_ROUGHLY = (
    "it follows that surface, but too roughly, as after simplifying it too far, smoothing it or turning it a little: "
    "bake the model's own mesh, or one with more vertices"
)
_TESTED = 500
_LEAST_SIZE = 10.0
"""Diagonal, in spacings, of a mesh that a cause makes smaller."""
_FACTORS = {
    2.0: "",
    0.5: "",
    10.0: "",
    0.1: "",
    100.0: "centimetres in place of metres",
    0.01: "metres in place of centimetres",
    1000.0: "millimetres in place of metres",
    0.001: "metres in place of millimetres",
    39.3700787: "inches in place of metres",
    0.0254: "metres in place of inches",
    2.54: "centimetres in place of inches",
    0.3937008: "inches in place of centimetres",
    25.4: "millimetres in place of inches",
    0.03937008: "inches in place of millimetres",
    0.3048: "metres in place of feet",
    3.2808399: "feet in place of metres",
}
"""The mesh's size over the object's, and the units that are often confused."""


@dataclass(frozen=True)
class OwnSurface:
    """The surface that a network was trained on: its interior, and the corner [3] and side of its box."""

    interior: Interior
    corner: Array
    side: float

    @property
    def spacing(self) -> float:
        """The spacing of the grid, in scene units."""
        return self.interior.spacing * self.side

    @cached_property
    def _levels(self) -> Any:
        from scipy.interpolate import RegularGridInterpolator

        levels = self.interior.levels[0].astype(np.float64)
        starts = zip(self.interior.corner, levels.shape, strict=True)
        axes = [start + self.interior.spacing * np.arange(n) for start, n in starts]
        return RegularGridInterpolator(axes, levels, bounds_error=False, fill_value=-LEVELS)

    def distances(self, positions: Array) -> Array:
        """Distances [N] of positions [N,3] to the surface, in spacings, at most REACH."""
        return np.abs(self._signed(positions))

    def _signed(self, positions: Array) -> Array:
        """Signed distances [N], positive inside, in spacings, at most REACH."""
        return np.asarray(self._levels((positions - self.corner) / self.side) * (REACH / LEVELS))

    def bounds(self) -> Array:
        """The bounding box [2,3], to half a spacing, in scene units."""
        levels = self.interior.levels[0]
        inside = np.argwhere(levels > (0 if levels.max() > 0 else -LEVELS))  # sheets lie between the nodes
        nodes = np.stack([inside.min(axis=0) - 0.5, inside.max(axis=0) + 0.5])
        return np.asarray(self.corner + self.side * (self.interior.corner + self.interior.spacing * nodes))

    def refuse_foreign(self, mesh: Mesh) -> None:
        """Raise QueryError if most vertices are off the surface, or face its inside; warn of some.

        The sentence has their number, the farthest distance and the cause.
        """
        distances = self.distances(mesh.positions)
        off = distances > TOLERANCE
        farthest = float(distances.max())
        beyond = farthest >= REACH - 1e-6
        if off.mean() <= FEW_OFF and not beyond:
            self._refuse_inward(mesh, off)
            return
        reach = "more than " if beyond else ""
        found = (
            f"mesh: {off.sum()} of {len(off)} vertices are not on the surface that the model was trained on; "
            f"the farthest is {reach}{farthest * self.spacing:.3g} scene units away"
        )
        if off.mean() <= MOST_OFF:
            warn(f"{found}; the result is wrong there: train a model on this mesh")
            self._refuse_inward(mesh, off)
            return
        cause = self._cause(mesh.positions) or (_UNKNOWN if beyond else _ROUGHLY)
        if cause is _ROUGHLY and off.mean() <= 0.5:
            warn(f"{found}; {cause}")
            self._refuse_inward(mesh, off)
            return
        raise QueryError(f"{found}; {cause}")

    def _refuse_inward(self, mesh: Mesh, off: NDArray[np.bool_]) -> None:
        """Raise QueryError if most normals point into the object, and warn if more than a few on the surface do.

        Those of an open mesh, or of a shell, may agree with its faces. Those of vertices `off` the surface [V] tell
        nothing of its side.
        """
        ahead, behind = (self._signed(mesh.positions + side * self.spacing * mesh.normals) for side in (1.0, -1.0))
        inward = ahead > behind
        if inward.mean() > 0.5:
            raise QueryError(
                f"mesh: {inward.sum()} of {len(inward)} vertex normals point into the object that the model was "
                f"trained on: the faces are wound inside out; flip the mesh's normals in an editor, and save it again"
            )
        inward &= ~off
        if inward.mean() > FEW_OFF:
            warn(inward_sentence(mesh, np.flatnonzero(inward), "that the model was trained on"))

    def _cause(self, positions: Array) -> str:
        """The transformation that brings the vertices onto the surface, as a sentence; empty if none is found."""
        some = positions[:: -(-len(positions) // _TESTED)]
        own, found = self.bounds(), np.stack([positions.min(axis=0), positions.max(axis=0)])
        sizes = np.sort(found[1] - found[0]), np.sort(own[1] - own[0])
        factors = [1.0, *_FACTORS, float(np.median(sizes[0] / sizes[1]))]
        middle = own.mean(axis=0)
        # A mesh that shrinks to a point fits anywhere.
        most = float(np.linalg.norm(sizes[0])) / (_LEAST_SIZE * self.spacing)
        for axes, factor in itertools.product(_axis_changes(), [factor for factor in factors if factor < most]):
            turned = some[:, list(axes.order)] * axes.signs / factor
            centre = found.mean(axis=0)[list(axes.order)] * axes.signs / factor
            for shift, shifted in (
                (np.zeros(3), ""),
                (middle - centre, "moved"),
                (middle * (1.0 - 1.0 / factor), "scaled about its middle"),
            ):
                if (self.distances(turned + shift) <= TOLERANCE).mean() >= _MATCHES:
                    return _sentence(axes, factor, shifted)
        return ""


@dataclass(frozen=True)
class _AxisChange:
    """A rotation by right angles: coordinate k of the object is signs[k] times coordinate order[k] of the mesh."""

    order: tuple[int, ...]
    signs: tuple[int, ...]

    @property
    def is_identity(self) -> bool:
        return self.order == (0, 1, 2) and self.signs == (1, 1, 1)

    def __str__(self) -> str:
        return ", ".join(
            ("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(self.order, self.signs, strict=True)
        )


def _axis_changes() -> list[_AxisChange]:
    """The 24 rotations and 24 reflections of the axes, those with the fewest changes first."""
    every = [
        _AxisChange(order, signs)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    return sorted(
        every, key=lambda change: (sum(a != b for a, b in zip(change.order, range(3), strict=True)), -sum(change.signs))
    )


def _sentence(axes: _AxisChange, factor: float, shifted: str) -> str:
    """Say what differs; empty if nothing but a rounding of the size does."""
    causes = []
    if not np.isclose(factor, 1.0, rtol=2e-2):
        known = next((name for size, name in _FACTORS.items() if name and np.isclose(factor, size, rtol=2e-2)), "")
        causes.append(f"it is {factor:.4g} times as large" + (f" ({known})" if known else ""))
    if not axes.is_identity:
        causes.append(f"its axes are swapped (the object's x, y, z are its {axes})")
    if shifted == "moved":
        causes.append("it is moved")
    if not causes:
        return ""
    return f"{' and '.join(causes)}: export it with the size, axes and origin of the model's own mesh"
