"""The path of a view ray through the meshes of a clear object and of the bodies inside it.

What is seen in a clear object depends on every interface that the ray meets. At each one the path splits into a
refracted and a reflected branch with the shares of the light that Fresnel's equations give. A branch ends where hardly
anything is seen through the media any more. A ray that narrowly misses a body, or an edge, sees something else. Paths
are therefore found in the meshes themselves, by Embree, and not in the network's coarse grids.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.mesh.geometry import face_normals, vertex_normals
from prt_bake.jit.threads import in_threads
from prt_bake.network.features.interior import Interior
from prt_bake.network.settings import NetworkSettings

Array = NDArray[np.float64]
_LEAST_A_THREAD = 4096
"""Paths per thread at least: callers with fewer run in threads of their own."""


class PathSamples(NamedTuple):
    """Points of N view rays from where light comes towards the eye, equally probable.

    Attributes:
        lengths: of the path at the points [N,K], in box sides.
        points: [N,K,3], in box sides from the box's corner; first those of the branch that keeps the larger part of the
            light at every interface.
        opacity: probability [N] that light comes from the path at all.
        leaving: direction [N,3] in which that branch leaves the object for good; that of its begin if it does not.
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
    """What kernels know: of F faces the body [F], the normals [F,3] and those at the corners [F,3,3]; the medium at a
    point in the bodies of a bit mask; of media, that outside first, the index of refraction and the attenuation per box
    side.
    """

    bodies: NDArray[np.int64]
    normals: Array
    corners: Array
    media: NDArray[np.int64]
    eta: Array
    attenuation: Array


class Body(NamedTuple):
    """A closed mesh with a medium.

    Attributes:
        positions, faces: [V,3] in box sides from the box's corner, and [F,3] counter-clockwise seen from outside.
        corners: normals [F,3,3] at the corners by which rays are bent; None for the normals of the faces.
        parent: number of the body that contains it; −1 for the object.
        eta, attenuation: index of refraction, and attenuation per box side.
    """

    positions: Array
    faces: NDArray[np.int64]
    corners: Array | None = None
    parent: int = -1
    eta: float = 1.0
    attenuation: float = 0.0


class ViewPath:
    """Finds the paths of view rays through an object and bodies inside it."""

    def __init__(self, bodies: Sequence[Body], samples: int, most: int, branches: int = 1) -> None:
        """The object, then what it contains, a body after the one that contains it. Paths have `samples` points, are
        bent or reflected at most `most` times, and split into at most `branches`; with 1 they are refracted unless they
        are totally reflected.
        """
        from prt_bake.geometry.embree import TriangleScene

        self._arguments = tuple(bodies), samples, most, branches
        firsts = np.cumsum([0, *(len(body.positions) for body in bodies)])
        positions = np.concatenate([body.positions for body in bodies])
        faces = np.concatenate([body.faces + first for body, first in zip(bodies, firsts, strict=False)])
        numbers = np.repeat(np.arange(len(bodies)), [len(body.faces) for body in bodies])
        flat = [np.repeat(face_normals(body.positions, body.faces)[:, None], 3, axis=1) for body in bodies]
        corners = [own if body.corners is None else body.corners for own, body in zip(flat, bodies, strict=True)]
        self._tables = Tables(
            numbers,
            face_normals(positions, faces),
            np.ascontiguousarray(np.concatenate(corners), np.float64),
            media_of_masks([body.parent for body in bodies]),
            np.array([1.0, *(body.eta for body in bodies)]),
            np.array([0.0, *(body.attenuation for body in bodies)]),
        )
        self._samples, self._most = samples, (most, branches)
        self._scene = TriangleScene(positions.astype(np.float32), faces.astype(np.uint32))

    def __call__(self, x: Tensor, back: Tensor) -> PathSamples:
        """The paths of rays from x [N,3] along −back [N,3]; both on any device, found by the processor."""
        from prt_bake.geometry.embree import intersect_address
        from prt_bake.network.features.path_kernel import path_rows

        starts, towards = (np.ascontiguousarray(rows.double().cpu().numpy()) for rows in (x, -back))
        count, samples = len(starts), self._samples
        found = [np.empty(shape, np.float32) for shape in ((count, samples), (count, samples, 3), count, (count, 3))]
        fixed = intersect_address(), self._scene.handle, tuple(self._tables), self._most
        in_threads(path_rows, count, *fixed, starts, towards, *found, least=_LEAST_A_THREAD)
        return PathSamples._make(torch.from_numpy(rows).to(x.device) for rows in found)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the meshes alone."""
        return ViewPath, self._arguments

    def __deepcopy__(self, memo: dict[int, Any]) -> "ViewPath":
        """Itself, since it is immutable."""
        return self


def path_through(outer: Body, interior: Interior, settings: NetworkSettings) -> ViewPath:
    """The paths through an object of which the network has the interior."""
    bodies = [outer._replace(eta=interior.eta, attenuation=interior.attenuation[0])]
    for body, attenuation in zip(interior.inner, interior.attenuation[1:], strict=True):
        positions, faces = body.positions, body.faces.astype(np.int64)
        corners = vertex_normals(positions, faces)[0][faces] if body.smooth else None
        bodies.append(Body(positions, faces, corners, body.parent, body.eta, attenuation))
    return ViewPath(bodies, settings.ray_samples, settings.interfaces, settings.branches)


def media_of_masks(parents: Sequence[int]) -> NDArray[np.int64]:
    """The medium [2ᴮ] at a point in the bodies of a bit mask: 0 outside, else the number of the last body, from 1, that
    counts. A body counts only where all bodies that contain it do, as in scenes.
    """
    chains: list[int] = []
    for number, parent in enumerate(parents):
        chains.append(1 << number | (chains[parent] if parent >= 0 else 0))
    counting = [[k + 1 for k, chain in enumerate(chains) if mask & chain == chain] for mask in range(1 << len(parents))]
    return np.array([max(numbers, default=0) for numbers in counting])
