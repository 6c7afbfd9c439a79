"""The path of a view ray through the meshes of a clear object and of the bodies inside it.

What is seen in a clear object depends on every interface that the ray meets. At each it is refracted or, beyond the
critical angle, totally reflected: it takes the way that most of the light takes. It ends where hardly anything is seen
through the media any more. Where a ray misses a thin body, or an edge, another thing is seen; the path is therefore
found in the meshes themselves, by Embree, and not in the network's coarse grids.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from prt_bake.jit.threads import in_threads
from prt_bake.network.features.inner_bodies import STEPS
from prt_bake.network.features.interior import Interior
from prt_bake.network.settings import NetworkSettings

Array = NDArray[np.float64]


class PathSamples(NamedTuple):
    """Points of N view rays from where light comes towards the eye, equally probable.

    Attributes:
        lengths: of the path at the points [N,K], in box sides.
        points: [N,K,3], in box sides from the box's corner.
        opacity: probability [N] that light comes from the path at all.
        leaving: direction [N,3] in which the path first leaves the object; that of its begin if it does not.
    """

    lengths: Tensor
    points: Tensor
    opacity: Tensor
    leaving: Tensor

    def packed(self) -> Tensor:
        """All numbers of each path in a row [N, 4 K + 4]."""
        return torch.cat((self.lengths, self.points.flatten(1), self.opacity[:, None], self.leaving), dim=1)

    @staticmethod
    def unpacked(rows: Tensor) -> "PathSamples":
        """The inverse of `packed`."""
        samples = (rows.shape[1] - 4) // 4
        lengths, points, opacity, leaving = torch.split(rows, [samples, 3 * samples, 1, 3], dim=1)
        return PathSamples(lengths, points.reshape(-1, samples, 3), opacity[:, 0], leaving)


PathTracer = Callable[[Tensor, Tensor], PathSamples]
"""Positions [N,3] in box sides and directions back to the eye [N,3] → the paths."""


def known_paths(rows: Tensor) -> PathTracer | None:
    """The paths [N,·] that `PathSamples.packed` gave, whatever is asked; None if the rows are empty."""
    return None if rows.shape[1] == 0 else lambda x, back: PathSamples.unpacked(rows)


class Tables(NamedTuple):
    """What kernels know of F faces: body [F], face normals [F,3] and normals at the corners [F,3,3]; of media, that
    outside first: index of refraction and attenuation per box side.
    """

    bodies: NDArray[np.int64]
    normals: Array
    corners: Array
    eta: Array
    attenuation: Array


class Body(NamedTuple):
    """A closed mesh in box sides from the box's corner: positions [V,3], faces [F,3] and normals at corners [F,3,3]."""

    positions: Array
    faces: NDArray[np.int64]
    corners: Array

    @staticmethod
    def flat(positions: Array, faces: NDArray[Any]) -> "Body":
        """A body with the normals of its faces."""
        faces = faces.astype(np.int64)
        return Body(positions, faces, np.repeat(face_normals(positions, faces)[:, None], 3, axis=1))


class ViewPath:
    """Finds the paths of view rays through an object and bodies inside it."""

    def __init__(
        self, bodies: Sequence[Body], eta: Sequence[float], attenuation: Sequence[float], samples: int, most: int
    ) -> None:
        """The object, then what it contains, a body after the one that contains it, with the index of refraction and
        the attenuation per box side of each. Paths have `samples` points and meet at most `most` interfaces.
        """
        self._arguments = tuple(bodies), tuple(eta), tuple(attenuation), samples, most
        firsts = np.cumsum([0, *(len(body.positions) for body in bodies)])
        self._positions = np.concatenate([body.positions for body in bodies])
        self._faces = np.concatenate([body.faces + first for body, first in zip(bodies, firsts, strict=False)])
        numbers = np.repeat(np.arange(len(bodies)), [len(body.faces) for body in bodies])
        corners = np.ascontiguousarray(np.concatenate([body.corners for body in bodies]), np.float64)
        outside = np.array([1.0, *eta]), np.array([0.0, *attenuation])
        self._tables = Tables(numbers, face_normals(self._positions, self._faces), corners, *outside)
        self._samples, self._most = samples, most

    @cached_property
    def _scene(self) -> Any:
        from prt_bake.geometry.embree import TriangleScene

        return TriangleScene(self._positions.astype(np.float32), self._faces.astype(np.uint32))

    def __call__(self, x: Tensor, back: Tensor) -> PathSamples:
        """The paths of rays from x [N,3] along −back [N,3]; both on any device, found by the processor."""
        from prt_bake.geometry.embree import intersect_address
        from prt_bake.network.features.path_kernel import path_rows

        starts, towards = (np.ascontiguousarray(rows.double().cpu().numpy()) for rows in (x, -back))
        count, samples = len(starts), self._samples
        found = [np.empty(shape, np.float32) for shape in ((count, samples), (count, samples, 3), count, (count, 3))]
        fixed = intersect_address(), self._scene.handle, tuple(self._tables), self._most
        in_threads(path_rows, count, *fixed, starts, towards, *found, least=64)
        return PathSamples._make(torch.from_numpy(rows).to(x.device) for rows in found)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the meshes alone."""
        return ViewPath, self._arguments

    def __deepcopy__(self, memo: dict[int, Any]) -> "ViewPath":
        """Itself, since it is immutable."""
        return self


def path_through(outer: Body, interior: Interior, settings: NetworkSettings) -> ViewPath:
    """The paths through an object of which the network has the interior."""
    inner = [Body.flat(body.places / STEPS, body.faces) for body in interior.inner]
    eta = interior.eta, *(body.eta for body in interior.inner)
    return ViewPath([outer, *inner], eta, interior.attenuation, settings.ray_samples, settings.ray_turns)


def face_normals(positions: Array, faces: NDArray[np.int64]) -> Array:
    """Unit normals [F,3] of faces [F,3], which are counter-clockwise seen from outside; 0 for faces without area."""
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))
